"""What a virtual bench says about a run, for scoring. Nothing here feeds back into the run."""

import math
from typing import TYPE_CHECKING, Any

from cli.rig import Rig
from drivers.recorder import Recorder

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from milling.loop import RunResult

MAPE_FROM = 0.05
"""A percentage of a completion near zero means nothing."""


class Scorer:
    """Passes events on to the record, and compares each lap's completion with the bench's truth of that moment."""

    def __init__(self, recorder: Recorder, bench: Rig) -> None:
        self._recorder = recorder
        self._bench = bench
        self._pairs: list[tuple[float, float]] = []

    def event(self, kind: str, **fields: Any) -> None:
        """Record; look at the truth at the end of a lap."""
        self._recorder.event(kind, **fields)
        if kind == "lap":
            self._compare(fields["completion"])

    def frame(self, name: str, image: "npt.NDArray[np.uint8]") -> None:
        """Record."""
        self._recorder.frame(name, image)

    def _compare(self, completion: Any) -> None:
        truth = self._bench.truth_now()
        if truth is not None:
            self._pairs += list(zip(completion, at_points(truth, "completion", len(completion)), strict=True))

    def truth(self, result: "RunResult") -> dict[str, Any] | None:
        """The bench's truth after the run, with the figures that need both sides; None on hardware."""
        truth = self._bench.truth()
        if truth is None:
            return None
        scored = {key: value for key, value in truth.items() if key not in {"ball_px", "ring"}}
        cut_mm = [point["depth_mm"] for point in result.points]
        deeper = [true - cut for true, cut in zip(at_points(truth, "depth_mm", len(cut_mm)), cut_mm, strict=True)]
        scored["max_overrun_mm"] = max(deeper, default=0.0)
        errors = [(estimate - true, true) for estimate, true in self._pairs if math.isfinite(estimate)]
        if errors:
            scored["completion_rmse"] = math.sqrt(sum(error**2 for error, _ in errors) / len(errors))
        shares = [abs(error) / true for error, true in errors if true >= MAPE_FROM]
        if shares:
            scored["completion_mape"] = sum(shares) / len(shares)
        return scored


def at_points(truth: dict[str, Any], key: str, n_points: int) -> list[float]:
    """The ring's truth at theta_i = 2 pi i / n, i = 1..n."""
    values = truth["ring"][key]
    count = len(values)
    return [float(values[round(i * count / n_points) % count]) for i in range(1, n_points + 1)] if count else []
