"""A device in front of another hides nothing of it: what it does not pass on is answered by the interface's default."""

import pytest

from drivers.device import Device
from drivers.motion.bcap.driver import BcapController
from drivers.motion.bcap.fed import FedRobot
from drivers.motion.interface import MotionController
from drivers.spindle.interface import Spindle
from drivers.traced_devices import TracedMotion, TracedSpindle
from milling.guarded_motion import GuardedMotion


@pytest.mark.parametrize(
    ("wrapper", "interface", "wrapped"),
    [
        (TracedMotion, MotionController, MotionController),
        (GuardedMotion, MotionController, MotionController),
        (TracedSpindle, Spindle, Spindle),
        (FedRobot, MotionController, BcapController),
    ],
    ids=["TracedMotion", "GuardedMotion", "TracedSpindle", "FedRobot"],
)
def test_a_wrapper_passes_everything_on(wrapper: type[Device], interface: type[Device], wrapped: type[Device]) -> None:
    """All of the interface that the wrapped class defines itself."""
    promised = {name for name in vars(interface) if not name.startswith("_")}
    assert "identity" in promised
    passed_on = {name for each in wrapper.__mro__ if each not in interface.__mro__ for name in vars(each)}
    assert promised & set(vars(wrapped)) - passed_on == set()
