"""The pairing of two eyes, on in-memory sources and a clock that the test moves."""

import math

import numpy as np
import pytest

from drivers.camera.interface import Image
from drivers.camera.stereo import StereoPair
from drivers.errors import ConfigError, DeviceFaultError, DeviceTimeoutError

SIZE_PX = (8, 6)


class HandClock:
    def __init__(self) -> None:
        self.time_s = 100.0

    def now_s(self) -> float:
        return self.time_s

    def sleep_s(self, duration_s: float) -> None:
        self.time_s += max(0.0, duration_s)


def picture(number: int) -> Image:
    return np.random.default_rng(number).integers(0, 256, (SIZE_PX[1], SIZE_PX[0], 3), dtype=np.uint8)


class ScriptedSource:
    """Plays pictures at the times of a script; each arrives ``latency_s`` after its exposure began."""

    def __init__(self, clock: HandClock, name: str, exposures_s: list[float], latency_s: float = 0.02) -> None:
        self.clock = clock
        self.identity = name
        self.latency_s = latency_s
        self.frames = [(picture(1000 * ord(name[0]) + number), time_s) for number, time_s in enumerate(exposures_s)]
        self.closed = 0

    def newest(self) -> tuple[Image, float] | None:
        arrived = [frame for frame in self.frames if frame[1] + self.latency_s <= self.clock.time_s]
        return arrived[-1] if arrived else None

    def wait_newer(self, exposed_after_s: float, timeout_s: float) -> tuple[Image, float]:
        deadline_s = self.clock.time_s + timeout_s
        while True:
            frame = self.newest()
            if frame is not None and frame[1] > exposed_after_s:
                return frame
            coming = [s + self.latency_s for _, s in self.frames if s + self.latency_s > self.clock.time_s]
            if not coming or coming[0] > deadline_s:
                self.clock.time_s = deadline_s
                raise DeviceTimeoutError(f"{self.identity}: script is over")
            self.clock.time_s = coming[0]

    def close(self) -> None:
        self.closed += 1


def pair_of(
    left_s: list[float], right_s: list[float], max_skew_s: float = 0.01
) -> tuple[StereoPair, HandClock, ScriptedSource, ScriptedSource]:
    clock = HandClock()
    left, right = ScriptedSource(clock, "L", left_s), ScriptedSource(clock, "R", right_s)
    return StereoPair(left, right, clock, size_px=SIZE_PX, max_skew_s=max_skew_s), clock, left, right


def test_a_pair_was_exposed_after_the_call_and_never_before() -> None:
    pair, _, _, _ = pair_of([99.98, 100.03, 100.06], [99.981, 100.031, 100.061])
    frame = pair.capture()
    assert frame.exposed_at_s == 100.03
    assert frame.index == 0
    assert frame.left.shape == (6, 8, 3)


def test_a_picture_in_flight_at_the_call_does_not_count() -> None:
    """Exposed just before the call, arriving just after it."""
    pair, _, _, _ = pair_of([99.999, 100.032], [99.999, 100.032])
    assert pair.capture().exposed_at_s == 100.032


def test_one_eye_exposed_before_the_call_does_not_make_a_pair() -> None:
    pair, _, _, _ = pair_of([99.999, 100.032], [100.001, 100.034])
    assert pair.capture().exposed_at_s == 100.032


def test_each_capture_is_newer_than_the_last_and_numbered() -> None:
    times_s = [100.0 + 0.033 * n for n in range(1, 8)]
    pair, _, _, _ = pair_of(times_s, [t + 0.002 for t in times_s])
    frames = [pair.capture() for _ in range(3)]
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert frames[0].exposed_at_s < frames[1].exposed_at_s < frames[2].exposed_at_s


def test_a_lost_picture_of_one_eye_delays_the_pair_and_mixes_nothing() -> None:
    pair, _, left, right = pair_of([100.033, 100.066, 100.099], [100.066, 100.099])
    frame = pair.capture()
    assert frame.exposed_at_s == 100.066
    np.testing.assert_array_equal(frame.left, left.frames[1][0])
    np.testing.assert_array_equal(frame.right, right.frames[0][0])


def test_skew_at_its_bound_passes_and_beyond_it_is_refused_by_name() -> None:
    times_s = [100.0 + 0.25 * n for n in range(1, 9)]
    pair, _, _, _ = pair_of(times_s, [t + 0.0625 for t in times_s], max_skew_s=0.0625)
    assert pair.capture().exposed_at_s == 100.25
    pair, _, _, _ = pair_of(times_s, [t + 0.125 for t in times_s], max_skew_s=0.0625)
    with pytest.raises(DeviceFaultError, match=r"125\.0 ms apart, allowed 62\.5 ms \(\[camera\] max_skew_s\)"):
        pair.capture(1.5)


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_message_names_the_late_side_and_the_age_of_its_newest(side: str) -> None:
    alive = [100.0 + 0.033 * n for n in range(1, 40)]
    late = [99.5]
    pair, clock, _, _ = pair_of(*((late, alive) if side == "left" else (alive, late)))
    pair.latest()
    with pytest.raises(
        DeviceTimeoutError, match=rf"within 0\.5 s from {side} camera . \(the newest is 1\.0\d\d s old\)"
    ):
        pair.capture(0.5)
    assert clock.time_s >= 100.5


def test_both_sides_late() -> None:
    pair, _, _, _ = pair_of([], [])
    with pytest.raises(DeviceTimeoutError, match=r"left camera L \(none ever came\) and right camera R \(none ever"):
        pair.capture(0.5)


def test_a_wrong_size_is_refused() -> None:
    pair, _, left, _ = pair_of([100.03], [100.03])
    left.frames = [(np.zeros((4, 8, 3), np.uint8), 100.03)]
    with pytest.raises(DeviceFaultError, match=r"left camera L: .*\(4, 8, 3\) uint8, expected \(6, 8, 3\)"):
        pair.capture()


def test_a_frozen_picture_with_fresh_stamps_is_a_fault() -> None:
    pair, _, _, right = pair_of([100.03, 100.06, 100.09], [100.03, 100.06, 100.09])
    right.frames = [(right.frames[0][0].copy(), time_s) for _, time_s in right.frames]
    pair.capture()
    with pytest.raises(DeviceFaultError, match="right camera R: sent the same bytes twice"):
        pair.capture()


@pytest.mark.parametrize("stamp_s", [math.nan, math.inf, 5000.0])
def test_a_stamp_from_another_clock_is_a_fault(stamp_s: float) -> None:
    pair, _, left, _ = pair_of([100.03], [100.03])
    left.newest = lambda: (picture(1), stamp_s)  # type: ignore[method-assign]
    with pytest.raises(DeviceFaultError, match="CLOCK_MONOTONIC"):
        pair.latest()


def test_a_source_that_hands_out_an_old_picture_is_a_fault() -> None:
    pair, _, left, _ = pair_of([100.03], [100.03])
    left.wait_newer = lambda after_s, timeout_s: (picture(1), after_s)  # type: ignore[method-assign]
    with pytest.raises(DeviceFaultError, match="cannot be trusted"):
        pair.capture()


def test_latest_waits_for_nothing_and_keeps_the_last_pair() -> None:
    pair, clock, _, _ = pair_of([100.033, 100.066], [100.034])
    assert pair.latest() is None
    clock.time_s = 100.06
    first = pair.latest()
    assert first is not None
    assert first.exposed_at_s == 100.033
    clock.time_s = 100.09  # the left eye has a newer picture without a partner
    assert pair.latest() is first
    assert clock.time_s == 100.09


def test_latest_finds_the_partner_of_a_picture_that_came_late() -> None:
    pair, clock, _, right = pair_of([100.033, 100.066], [100.033, 100.066])
    right.latency_s = 0.05
    clock.time_s = 100.055
    assert pair.latest() is None
    clock.time_s = 100.085
    frame = pair.latest()
    assert frame is not None
    assert frame.exposed_at_s == 100.033


def test_one_device_is_no_pair() -> None:
    clock = HandClock()
    left, right = ScriptedSource(clock, "one", []), ScriptedSource(clock, "one", [])
    with pytest.raises(ConfigError, match="the same device, one"):
        StereoPair(left, right, clock, size_px=SIZE_PX, max_skew_s=0.01)
    assert left.closed == right.closed == 1


def test_closing_closes_both_eyes_even_when_the_first_one_hangs() -> None:
    pair, _, left, right = pair_of([], [])

    def hang() -> None:
        raise DeviceTimeoutError("L: does not let go")

    left.close = hang  # type: ignore[method-assign]
    with pytest.raises(DeviceTimeoutError, match="does not let go"):
        pair.close()
    assert right.closed == 1
