"""Both eyes by themselves: rate, jitter, drops, age, skew, light and sharpness."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from doctor.check import Check, Patient, at_least, at_most, percentile, within

PAIRS = 60
SKEW_MS = 5.0
JITTER_SHARE = 0.5
DROPPED_SHARE = 0.1
SHARP = 0.6
"""Of the detail, against the certificate."""
CHANGED = 0.25
"""Of the brightness, against the certificate: another exposure, another lamp."""


def examine(patient: Patient) -> Iterator[Check]:
    """Nothing moves."""
    clock, earlier = patient.clock, patient.earlier
    with patient.open_camera() as camera:
        yield Check("camera: identity", camera.identity, "", "both open", True)
        if earlier is not None:
            same = camera.identity == earlier.camera
            yield Check("camera: cameras as certified", camera.identity, "", earlier.camera, same)
        patient.doing("looking")
        first = camera.capture()
        patient.recorder.frame("left", first.left)
        patient.recorder.frame("right", first.right)
        ages_ms, stamps, skews_ms, light = [], [], [], []
        for _ in range(PAIRS):
            frame = camera.capture()
            ages_ms.append((clock.now_s() - frame.exposed_at_s) * 1e3)
            stamps.append(frame.exposed_at_s)
            skews_ms.append(max(abs(frame.skew_s), frame.lag_s) * 1e3)
            light.append((float(frame.left.mean()), float(frame.right.mean())))
        gaps_s = np.diff(stamps)
        period_s = float(np.median(gaps_s))
        rate = 1.0 / period_s
        yield at_least("camera: pairs per second", rate, 5.0, "/s")
        yield at_most("camera: jitter, p99", percentile(list(abs(gaps_s - period_s)), 0.99) / period_s,
                      1.0 + JITTER_SHARE, "periods")  # fmt: skip
        dropped = float((gaps_s > 1.5 * period_s).mean())
        yield at_most(
            "camera: pairs dropped", 100.0 * dropped, 100.0 * DROPPED_SHARE, "%", "another camera on its bus?"
        )
        limit_ms = patient.limits.frame_age_ms
        yield at_most("camera: age at delivery, median", percentile(ages_ms, 0.5), limit_ms, "ms")
        yield at_most("camera: age at delivery, p99", percentile(ages_ms, 0.99), 2.5 * limit_ms, "ms")
        yield at_most("camera: skew of left and right, median", percentile(skews_ms, 0.5), SKEW_MS, "ms",
                      "trigger both cameras together")  # fmt: skip
        for side, image, values in (
            ("left", frame.left, [value for value, _ in light]),
            ("right", frame.right, [value for _, value in light]),
        ):
            yield from _picture(patient, side, image, values)


def _picture(patient: Patient, side: str, image: npt.NDArray[np.uint8], light: list[float]) -> Iterator[Check]:
    mean = float(np.mean(light))
    yield within(f"camera: {side} brightness", mean, 20.0, 235.0, "dn", "exposure or lamp")
    yield at_most(f"camera: {side} saturated", float((image >= 254).mean() * 100.0), 10.0, "%", "shorten the exposure")
    yield at_most(f"camera: {side} flicker", float(np.std(light)) / mean * 100.0, 2.0, "%", "a lamp on mains current?")
    detail = float(abs(np.diff(image.astype(np.int16), axis=1)).mean())
    yield at_least(f"camera: {side} detail", detail, 0.5, "dn", "out of focus, or the lens is covered")
    if patient.earlier is not None and (before := patient.earlier.figures.get(f"camera: {side} brightness")):
        change = abs(mean / before - 1.0) * 100.0
        detail_before = patient.earlier.figures.get(f"camera: {side} detail")
        if detail_before:
            left_percent = 100.0 * detail / detail_before
            advice = "out of focus, or the lens is dirty; focus it, and calibrate anew"
            yield at_least(f"camera: {side} focus as certified", left_percent, 100.0 * SHARP, "%", advice)
        advice = "another exposure or lamp than when it was certified; set it back, or calibrate and --recertify"
        yield at_most(f"camera: {side} exposure as certified", change, 100.0 * CHANGED, "%", advice)
