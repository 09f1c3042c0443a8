"""What every stereo camera promises, on every implementation; the rig's own with ``--rig FILE``."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from camera_benches import MAX_SKEW_S, CameraBench, in_process_bench, mjpeg_bench, read_scene, rig_file_bench

from drivers.camera.interface import StereoFrame
from drivers.errors import DeviceError, DeviceTimeoutError

EMULATED: dict[str, Any] = {"in-process": in_process_bench, "mjpeg": mjpeg_bench}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "camera_bench" in metafunc.fixturenames:
        makers = dict(EMULATED)
        rig_file = metafunc.config.getoption("--rig")
        if rig_file is not None:
            makers["hardware"] = partial(rig_file_bench, rig_file)
        metafunc.parametrize("camera_bench", makers.values(), ids=makers.keys(), indirect=True)


@pytest.fixture
def camera_bench(request: pytest.FixtureRequest) -> Iterator[CameraBench]:
    with request.param() as bench:
        yield bench


def check_against_scene(bench: CameraBench, frame: StereoFrame) -> None:
    """The time it says is the time at which the older of the two pictures was exposed."""
    if bench.scene is None:
        return
    (left, left_side), (right, right_side) = read_scene(frame.left), read_scene(frame.right)
    assert (left_side, right_side) == (0, 1)
    times_s = [bench.scene.exposed_at_s[number] for number in (left, right)]
    assert frame.exposed_at_s == pytest.approx(min(times_s), abs=1e-5)
    assert abs(times_s[0] - times_s[1]) <= MAX_SKEW_S


def test_pictures_of_the_promised_size_in_rgb(camera_bench: CameraBench) -> None:
    width, height = camera_bench.camera.size_px
    frame = camera_bench.camera.capture(5.0)
    for image in (frame.left, frame.right):
        assert image.shape == (height, width, 3)
        assert image.dtype == np.uint8
    if camera_bench.scene is not None:
        red, green, blue = frame.left[60:].reshape(-1, 3).mean(axis=0)
        assert red > 150
        assert max(green, blue) < 100
    assert camera_bench.camera.identity.startswith("left ")


def test_every_exposure_begins_after_the_call(camera_bench: CameraBench) -> None:
    indices = []
    for pause_s in (0.0, 0.003, 0.011, 0.2, 0.0):
        camera_bench.clock.sleep_s(pause_s)
        called_at_s = camera_bench.clock.now_s()
        frame = camera_bench.camera.capture(5.0)
        assert called_at_s < frame.exposed_at_s <= camera_bench.clock.now_s()
        check_against_scene(camera_bench, frame)
        indices.append(frame.index)
    assert indices == sorted(set(indices))


def test_the_latest_pair_is_true_and_fresh(camera_bench: CameraBench) -> None:
    camera_bench.camera.capture(5.0)
    last_s = 0.0
    for _ in range(20):
        camera_bench.clock.sleep_s(0.015)
        frame = camera_bench.camera.latest()
        assert frame is not None
        assert frame.exposed_at_s >= last_s
        assert camera_bench.clock.now_s() - frame.exposed_at_s < 1.0
        check_against_scene(camera_bench, frame)
        last_s = frame.exposed_at_s


def test_a_time_limit_too_short_for_any_camera(camera_bench: CameraBench) -> None:
    with pytest.raises(DeviceTimeoutError, match="left camera"):
        camera_bench.camera.capture(1e-4)
    camera_bench.camera.capture(5.0)


def test_closing_twice_and_no_picture_afterwards(camera_bench: CameraBench) -> None:
    camera_bench.camera.capture(5.0)
    camera_bench.camera.close()
    camera_bench.camera.close()
    with pytest.raises(DeviceError, match="closed"):
        camera_bench.camera.capture(1.0)


def test_a_camera_that_stops_is_told_in_time_and_nothing_old_is_handed_out() -> None:
    with mjpeg_bench() as bench:
        bench.camera.capture(5.0)
        bench.stop()
        bench.clock.sleep_s(0.05)
        called_at_s = bench.clock.now_s()
        with pytest.raises(DeviceTimeoutError, match=r"left camera .* \(the newest is 0\.\d+ s old\)"):
            bench.camera.capture(0.1)
        assert bench.clock.now_s() - called_at_s < 0.5
