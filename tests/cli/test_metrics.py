"""`mill metrics`: figures of the newest record, for Prometheus, and to nobody who comes under another name."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from http.client import HTTPConnection
from pathlib import Path
from wsgiref.simple_server import WSGIServer, make_server

import pytest
from mill_command import mill
from prometheus_client.parser import text_string_to_metric_families
from study_record import N, study_record

from cli.metrics import Answers
from cli.run_metrics import RunMetrics
from firmware_sim.clock import SimClock
from milling.record import RunRecorder

DOCS = Path(__file__).parent.parent.parent / "docs/records.md"


def figures(metrics: RunMetrics) -> dict[str, float]:
    """By name and labels."""
    found = {}
    for family in text_string_to_metric_families(metrics.text().decode()):
        for sample in family.samples:
            labels = ",".join(f"{key}={value}" for key, value in sorted(sample.labels.items()))
            found[f"{sample.name}{{{labels}}}" if labels else sample.name] = sample.value
    return found


def test_a_finished_run(tmp_path: Path) -> None:
    study_record(tmp_path / "a")
    with RunMetrics(tmp_path) as metrics:
        found = figures(metrics)
    assert found["mill_run_active"] == 0
    assert found["mill_run_info{operator=AK,protocol=P-7,rig=bench 7,run=a,specimen_id=M12,version=0.1.0}"] == 1
    assert found["mill_outcome{outcome=complete}"] == found["mill_runs_total{outcome=complete}"] == 1
    assert found["mill_points{state=done}"] == N - 1
    assert found["mill_points{state=stopped}"] == 1
    assert found["mill_permissions_total{answer=granted}"] == 2 * N - 1
    assert found["mill_permissions_total{answer=no fresh frame}"] == 1
    assert found["mill_torque_share"] == 0.2
    assert found["mill_tip_height_mm"] == -2.5
    assert found["mill_depth_mm{of=max}"] == pytest.approx(0.3)
    assert found["mill_loop_period_seconds_count"] == 2 * N - 1
    assert found["mill_loop_period_seconds_sum"] == pytest.approx(0.04 * (2 * N - 1))
    assert found["mill_frame_age_seconds_count"] == 2 * N


@pytest.fixture
def opened() -> Iterator[Callable[..., RunMetrics]]:
    with ExitStack() as all_of_them:
        yield lambda *words, **more: all_of_them.enter_context(RunMetrics(*words, **more))


def test_a_growing_record_and_the_run_after_it(tmp_path: Path, opened: Callable[..., RunMetrics]) -> None:
    """Counters go on from run to run, gauges are the newest one's."""
    clock, now_s = SimClock(), [0.0]
    metrics = opened(tmp_path, now_s=lambda: now_s[0])
    assert figures(metrics)["mill_run_active"] == 0
    with RunRecorder(tmp_path / "a", {}, clock) as first:
        now_s[0] = (tmp_path / "a/events.jsonl").stat().st_mtime
        first.event("state", state="milling", lap=0)
        found = figures(metrics)
        assert (found["mill_run_active"], found["mill_state{state=milling}"]) == (1, 1)
        first.event("state", state="paused", reason="no fresh frame")
        first.event("late", silent_s=0.2)
        first.event("latched", reaction="RETRACT", reason="x")
        found = figures(metrics)
        assert "mill_state{state=milling}" not in found
        assert found["mill_pauses_total"] == found["mill_faults_total{kind=latched}"] == 1
        assert found["mill_loop_late_seconds_total"] == 0.2
        now_s[0] += 100.0
        found = figures(metrics)
        assert (found["mill_run_active"], found["mill_record_quiet_seconds"] >= 99) == (0, True)
    with RunRecorder(tmp_path / "b", {}, clock) as second:
        second.event("state", state="paused", reason="no fresh frame")
        found = figures(metrics)
        assert found["mill_pauses_total"] == 2
        assert sum(name.startswith("mill_run_info") for name in found) == 1
        assert next(name for name in found if name.startswith("mill_run_info")).find("run=b") > 0


def test_a_damaged_record_is_told_and_the_next_one_is_read(tmp_path: Path, opened: Callable[..., RunMetrics]) -> None:
    metrics = opened(tmp_path)
    events = study_record(tmp_path / "a") / "events.jsonl"
    events.write_bytes(events.read_bytes()[3:])
    assert figures(metrics)["mill_record_damaged"] == 1
    study_record(tmp_path / "b")
    found = figures(metrics)
    assert (found["mill_record_damaged"], found["mill_runs_total{outcome=complete}"]) == (0, 1)


@pytest.fixture
def served(tmp_path: Path) -> WSGIServer:
    server = make_server("127.0.0.1", 0, lambda *_: [])
    server.set_app(Answers(RunMetrics(tmp_path), server.server_port))
    return server


@pytest.mark.parametrize(
    ("method", "path", "host", "status"),
    [
        ("GET", "/metrics", "127.0.0.1:{}", 200),
        ("GET", "/metrics", "localhost:{}", 200),
        ("GET", "/metrics", "evil.example:{}", 421),
        ("GET", "/metrics", "127.0.0.1", 421),
        ("GET", "/metrics", "127.0.0.1.evil.example:{}", 421),
        ("POST", "/metrics", "127.0.0.1:{}", 405),
        ("GET", "/../header.json", "127.0.0.1:{}", 404),
        ("GET", "/", "127.0.0.1:{}", 404),
    ],
)
def test_who_is_answered(served: WSGIServer, method: str, path: str, host: str, status: int) -> None:
    with served:
        asking = threading.Thread(target=served.handle_request)
        asking.start()
        line = HTTPConnection("127.0.0.1", served.server_port, timeout=10)
        line.request(method, path, headers={"Host": host.format(served.server_port)})
        answer = line.getresponse()
        body = answer.read()
        line.close()
        asking.join()
    assert answer.status == status
    assert (b"mill_run_active" in body) == (status == 200)


def test_a_port_that_is_taken_is_one_line(served: WSGIServer, capsys: pytest.CaptureFixture[str]) -> None:
    with served:
        assert mill("metrics", "--port", str(served.server_port)) == 2
    said = capsys.readouterr().err
    assert f"port {served.server_port}: " in said
    assert said.count("\n") == 1


def test_every_metric_is_documented_and_nothing_else(tmp_path: Path) -> None:
    text = DOCS.read_text(encoding="utf-8").partition("## Metrics")[2]
    told = {line.split("`")[1] for line in text.splitlines() if line.startswith("| `mill_")}
    families = text_string_to_metric_families(RunMetrics(tmp_path).text().decode())
    names = {each.name + ("_total" if each.type == "counter" else "") for each in families}
    assert told == {name for name in names if not name.endswith("_created")}
