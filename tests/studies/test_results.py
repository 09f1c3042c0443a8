"""The page of results says what its inputs say."""

import pytest

from studies.results import page, wilson
from studies.virtual_runs import seeds_of


def test_wilson_matches_the_published_interval_of_six_of_seven() -> None:
    low, high = wilson(6, 7)
    assert (low, high) == (pytest.approx(0.487, abs=0.001), pytest.approx(0.974, abs=0.001))


TRUTH = {"success": True, "flap_free": True, "membrane_touched": False, "heat_rise_c": 8.0}


def test_a_held_run_is_no_success_even_with_a_free_flap() -> None:
    runs: list[dict[str, object]] = [
        {"command": "run", "seed": seed, "outcome": outcome, "milling_time_s": 150.0, "truth": TRUTH}
        for seed, outcome in enumerate(("complete", "held"))
    ]
    runs.append({**runs[0], "command": "virtual run", "seed": 7})
    text = page({"tip.onnx": {"held_out": {"tip_rmse_px": 0.4}}}, runs)
    assert "1 of 2" in text
    assert "1 of 1" in text.partition("virtual clock")[2]
    assert "| tip_rmse_px | 0.4 |" in text
    assert "simulation" in text


def test_an_experiment_tells_its_command_its_count_and_its_intervals() -> None:
    ours = {"trials": 9, "failed": 0, "height_rmse_mm": 0.02, "height_rmse_mm_low": 0.015, "height_rmse_mm_high": 0.025}
    result = {
        "command": "experiment surface",
        "seed": 3,
        "recipes": ["default", "paper"],
        "default": {**ours, "within_2_sigma": 0.9},
        "paper": {"trials": 9, "failed": 9},
        "published": {"height_rmse_mm": 0.1},
        "trials": [{"seed": seed} for seed in range(3, 12)],
    }
    text = page({}, [result])
    assert "mill experiment surface --specimens-count 9 --seed 3" in text
    assert "| failed | 0 | 9 |  |" in text
    assert "| height_rmse_mm | 0.02 (0.015 to 0.025) | - | 0.1 |" in text


def test_a_section_of_which_nothing_is_given_stays_as_it_was() -> None:
    runs: list[dict[str, object]] = [
        {"command": "run", "seed": seed, "outcome": "held", "milling_time_s": 150.0, "truth": TRUTH} for seed in (3, 4)
    ]
    latency = {"command": "stop latency", "alarms": 7, "hogs": 6}
    latency |= {
        f"{who}_{q}_ms": 1.5 for who in ("supervisor", "told", "shared_interpreter") for q in ("p50", "p99", "max")
    }
    both = page({}, [latency, runs[0]])
    again = page({}, [runs[1]], both)
    assert "--alarms 7" in again
    assert "| 4 | held" in again
    assert "| 3 | held" not in again
    assert page({}, [latency], again) == again
    assert [line for line in again.splitlines() if line.startswith("#")] == [
        line for line in both.splitlines() if line.startswith("#")
    ]


def test_seeds_are_named_by_ranges() -> None:
    assert seeds_of("0-3,7") == [0, 1, 2, 3, 7]


def test_mice_are_told_with_what_was_asked_of_them() -> None:
    result = {
        "command": "experiment milling",
        "seed": 0,
        "recipes": ["default", "paper"],
        "asked": ["--statistical", "--fault vision.low=0.7:all"],
        "default": {"trials": 2, "success_rate": 0.5, "wilson_95": [0.1, 0.9]},
        "paper": {"trials": 2, "success_rate": 0.0, "wilson_95": [0.0, 0.7]},
        "published": {"success_rate": 6 / 7},
        "trials": [{"seed": 0}, {"seed": 1}],
    }
    text = page({}, [result])
    asked = "--trials 2 --seed 0 --policy default --policy paper --statistical --fault vision.low=0.7:all --out"
    assert f"mill experiment milling {asked}" in text
    assert "| success_rate | 0.5 | 0 | 0.8571 |" in text
    assert "wilson_95" not in text


def test_the_stop_is_told_beside_its_reference() -> None:
    latencies = {"supervisor": 2.0, "told": 2.5, "shared_interpreter": 90.0}
    labels = {f"{name}_{label}_ms": value for name, value in latencies.items() for label in ("p50", "p99", "max")}
    text = page({}, [{"command": "stop latency", "alarms": 2000.0, "hogs": 6.0, **labels}])
    assert "python -m benchmarks.stop_latency --alarms 2000 --hogs 6" in text
    assert "| supervisor process, told by its pipe | 2.5 | 2.5 | 2.5 |" in text
    assert "EMCY frame on the wire | 2.0 | 2.0 | 2.0 |" in text


def test_kills_faults_and_the_doctor_have_their_sections() -> None:
    row = {
        "fault": "camera.off", "branches": 12, "complete": 0, "held": 9, "aborted": 3, "membranes_touched": 0,
        "false_completes": 0, "latched_after_s": [2.0, 8.4], "safe_after_latch_s": 0.52, "lower_after_latch_um": 1.0,
        "overrun_um": 2.0, "command_overrun_um": 1.0,
    }  # fmt: skip
    kills = {
        "kills": 60, "standstill_s_worst": 0.115,
        "lower_um_worst": 59.0, "overrun_um_worst": 3.0,
        "spindle_off_s_worst": 0.25,
        "spindle_stands_s_worst": 0.56, "events_lost_most": 1, "resumed": 40, "refused": 20,
        "complete_and_free_of_resumed": 0.5, "complete_and_free_of_resumed_low": 0.35,
        "complete_and_free_of_resumed_high": 0.65, "ended_otherwise": ["finish it by hand"], "membranes_touched": 0,
    }  # fmt: skip
    victim = {
        "kills": 20, "standstill_s_worst": 0.08, "lower_mm_worst": 0.0, "lifted_mm_least": 1.5,
        "spindle_off_s_worst": 0.25, "spindle_stands_s_worst": 0.5,
    }  # fmt: skip
    doctor = {"examinations": 40, "false_alarms": 0, "computer_busy": 3}
    text = page(
        {},
        [
            {"command": "fault table", "seeds": [1, 2], "phases": {"entry": 12}, "rows": [row]},
            {"command": "killed runs", "seeds": [1], "asked_kills": 60, **kills},
            {"command": "killed processes", "kills": 20, "program": victim},
            {
                "command": "doctor trials", "seeds": [0, 1], "well": doctor,
                "faults": {"disk.full": {"examinations": 3, "found": 3}},
            },
        ],
    )  # fmt: skip
    assert "| camera.off | 12 | 0 | 9 | 3 | 0 | 2.00 to 8.40 | 0.52 | 1 | 1 | 2 |" in text
    assert "| the tip stands after | 115 ms |" in text
    assert "| of the resumed: complete with a free flap | 50 % (35-65 %) |" in text
    assert "finish it by hand." in text
    assert "| program | 20 | 80 | 0 | 1.50 | 250 | 500 |" in text
    assert "| disk.full | 3 | 3 |" in text
