"""Studies: they go on where they stopped, and their intervals cover."""

import json
import multiprocessing
import threading
from contextlib import contextmanager

import numpy as np
import pytest
from distributed import LocalCluster

from drivers.errors import ConfigError
from studies import trials
from studies.trials import rms_interval, run_trials, share_of

CALLS = "calls"


def trial(folder, number):
    """Leaves a mark for each time it is run."""
    with (folder / f"{CALLS}-{number}").open("a") as file:
        file.write("x")
    return {"square": number**2}


def endless(number):
    """Ends only where it is number 1."""
    if number > 1:
        threading.Event().wait()
    return {"number": number}


@contextmanager
def other_process():
    """A child that is no trial's."""
    process = multiprocessing.get_context("spawn").Process(target=endless, args=(2,))
    process.start()
    try:
        yield process
    finally:
        process.kill()
        process.join()


def arguments(folder, numbers=(1, 2, 3)):
    return {f"trial-{number}": (folder, number) for number in numbers}


def silent(done, total):
    pass


def test_a_study_goes_on_and_runs_nothing_twice(tmp_path):
    out = tmp_path / "out"
    run_trials(trial, arguments(tmp_path, (1, 2)), out, workers=2, progress=silent)
    told = []
    found = run_trials(trial, arguments(tmp_path), out, workers=2, progress=lambda *step: told.append(step))
    assert found == {"trial-1": {"square": 1}, "trial-2": {"square": 4}, "trial-3": {"square": 9}}
    assert told == [(2, 3), (3, 3)]
    assert [len((tmp_path / f"{CALLS}-{number}").read_text()) for number in (1, 2, 3)] == [1, 1, 1]


def test_a_failure_keeps_what_is_done_and_leaves_nothing_half_written(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(TypeError):
        run_trials(trial, {**arguments(tmp_path, (1,)), "wrong": (tmp_path, "x")}, out, workers=1, progress=silent)
    assert sorted(file.name for file in out.iterdir()) == ["trial-1.json"]


@pytest.fixture(scope="module")
def cluster():
    """Address of a scheduler with one worker process."""
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None, scheduler_port=0) as found:
        yield found.scheduler_address


def test_a_cluster_runs_the_same_trials(cluster, tmp_path):
    shares = {"trial-1": ("rate", 3, 4), "trial-2": ("rate", 0, 9)}
    here = run_trials(share_of, shares, tmp_path / "here", workers=1, progress=silent)
    there = run_trials(share_of, shares, tmp_path / "there", workers=1, progress=silent, cluster=cluster)
    assert there == here
    assert sorted(file.name for file in (tmp_path / "there").iterdir()) == ["trial-1.json", "trial-2.json"]


def test_a_trial_that_falls_on_a_cluster_is_told_and_not_run_again(cluster, tmp_path):
    with pytest.raises(TypeError):
        run_trials(share_of, {"wrong": ("rate", "x", 1)}, tmp_path, workers=1, progress=silent, cluster=cluster)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere"])
def test_a_cluster_that_is_not_there_is_named(address, tmp_path, monkeypatch):
    monkeypatch.setattr(trials, "CLUSTER_START_S", 0.5)
    with pytest.raises(ConfigError, match=f"cluster {address}: no Dask scheduler answers there"):
        run_trials(share_of, {"t": ("rate", 1, 2)}, tmp_path, workers=1, progress=silent, cluster=address)


def test_workers_with_another_version_are_refused(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(trials, "version", lambda _: "99.0")
    with pytest.raises(ConfigError, match=r"other versions of mill on workers.*needs 99\.0"):
        run_trials(share_of, {"t": ("rate", 1, 2)}, tmp_path, workers=1, progress=silent, cluster=cluster)


@pytest.mark.parametrize("text", ["{", "[1]", "{}", '{"made_by": {"tip.onnx": "other"}}'])
def test_a_damaged_trial_or_one_of_another_make_is_named(text, tmp_path):
    (tmp_path / "trial-1.json").write_text(text)
    with pytest.raises(ConfigError, match=r"trial-1\.json: (is no trial|was made by).*remove it"):
        run_trials(trial, arguments(tmp_path, (1,)), tmp_path, workers=1, progress=silent)


def test_what_json_cannot_hold_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        run_trials(not_a_number, {"one": ()}, tmp_path, workers=1, progress=silent)
    assert not any(tmp_path.iterdir())


def not_a_number():
    return {"rmse_mm": float("nan")}


def test_the_interval_covers_the_true_rms_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(100):
        value, low, high = rms_interval(rng.uniform(0.5, 1.5, 30))
        assert low <= value <= high
        covered += low <= np.sqrt(13 / 12) <= high
    assert 85 <= covered <= 100


def test_one_trial_has_no_interval():
    assert rms_interval([0.3]) == (pytest.approx(0.3),) * 3
    assert json.dumps(rms_interval([0.3, 0.3]))


def test_an_interrupt_waits_for_no_trial_and_leaves_no_process_but_those_of_others(tmp_path):
    def interrupt(done, _total):
        if done == 1:
            raise KeyboardInterrupt

    with other_process() as other:
        before = multiprocessing.active_children()
        with pytest.raises(KeyboardInterrupt):
            run_trials(endless, {f"t-{n}": (n,) for n in (1, 2, 3, 4)}, tmp_path, workers=2, progress=interrupt)
        assert other.is_alive()
        assert set(multiprocessing.active_children()) == set(before)
    assert [file.name for file in tmp_path.iterdir()] == ["t-1.json"]
