"""How long one decision takes: all evidence of a ring weighed anew, bite, permission, the next vertex of the path.

    python -m benchmarks.planner_step

The reference of the ratio is the period of the loop, 50 ms at 20 Hz. A decision that follows no new evidence reuses
the last estimate; both kinds are told.
"""

import argparse
import json
from time import perf_counter

import numpy as np

from milling.job import Job
from milling.permission import Ledger
from milling.planner import policy_for
from milling.spline import periodic_spline
from milling.thickness import Thickness

PERIOD_S = 0.05


def measure(n_points: int, rounds: int, *, seed: int = 0) -> dict[str, float]:
    """Milliseconds of a decision with new evidence and without, median and 99th percentile."""
    rng = np.random.default_rng(seed)
    job = Job(n_points=n_points)
    policy = policy_for(job)
    pitch_mm = job.circumference_mm / n_points
    ledger = Ledger(n_points, job.limits, Thickness(n_points, job.limits, pitch_mm=pitch_mm))
    now_s = 0.0
    for index in range(n_points):
        ledger.touched(index)
        ledger.recall(index, depth_mm=0.2, ratio=1.0)
    knots_mm = np.arange(n_points, dtype=np.float64) * pitch_mm
    fresh: list[float] = []
    reused: list[float] = []
    for number in range(rounds):
        index = number % n_points
        for _ in range(6):
            now_s += 0.001
            for each in range(n_points):
                completion = float(np.clip(rng.normal(0.55, 0.05), 0.0, 1.0))
                ledger.seen(each, completion=completion, upper=min(1.0, completion + 0.1), exposed_at_s=now_s)
        ledger.felt(index, ratio=float(rng.normal(1.0, 0.07)), above_idle=True)
        for times in (fresh, reused):
            start_s = perf_counter()
            bite_mm = policy.bite_mm(ledger.completion(index), depth_mm=ledger.cut_mm(index))
            ledger.ask(index, bite_mm=bite_mm, now_s=now_s + 0.05, frame_at_s=now_s)
            depth_mm = np.array([ledger.cut_mm(each) for each in range(n_points)], dtype=np.float64)
            float(periodic_spline(knots_mm, -depth_mm, n_points * pitch_mm)(knots_mm[index] + pitch_mm / 3))
            times.append(1000.0 * (perf_counter() - start_s))
        ledger.void(index)
    figures: dict[str, float] = {"points": n_points, "rounds": rounds}
    for name, times in (("new_evidence", fresh), ("none", reused)):
        figures |= {f"{name}_ms_{q}": float(np.percentile(times, q)) for q in (50, 99)}
    return figures | {"share_of_the_period_p99": figures["new_evidence_ms_99"] / (1000.0 * PERIOD_S)}


def main() -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=32)
    parser.add_argument("--rounds", type=int, default=2000)
    given = parser.parse_args()
    print(json.dumps(measure(given.points, given.rounds), indent=1))


if __name__ == "__main__":
    main()
