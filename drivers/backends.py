"""Backends by name: the built-in ones, and those of third parties by entry points of the group ``mill.drivers``.

An entry point is called "motion.NAME", "spindle.NAME" or "camera.NAME" and leads to a factory: called with the device's
table of the rig file (without ``backend``) and a clock, it returns the open device. The built-in names lead to the
classes themselves. Nothing is imported before it is asked for.
"""

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Literal

from drivers.errors import ConfigError

Kind = Literal["motion", "spindle", "camera"]

ENTRY_POINT_GROUP = "mill.drivers"
BUILT_IN: dict[str, str] = {
    "motion.bcap": "drivers.motion.bcap.driver:BcapController",
    "motion.grbl": "drivers.motion.grbl.driver:GrblController",
    "motion.tinyg": "drivers.motion.tinyg.driver:TinyGController",
    "spindle.cia402": "drivers.spindle.cia402:Cia402Spindle",
    "spindle.grbl": "drivers.spindle.grbl:GrblSpindle",
    "spindle.modbus": "drivers.spindle.modbus:ModbusSpindle",
    "camera.opencv": "drivers.camera.stereo:StereoPair",
}


def backend_names(kind: Kind) -> list[str]:
    """The known backends of one kind of device, sorted."""
    names = {*BUILT_IN, *(point.name for point in entry_points(group=ENTRY_POINT_GROUP))}
    return sorted(name.removeprefix(f"{kind}.") for name in names if name.startswith(f"{kind}."))


def load_backend(kind: Kind, name: str) -> Callable[..., Any]:
    """Import one backend's class or factory.

    Raises:
        ConfigError: no such backend; the message lists the known ones.
    """
    key = f"{kind}.{name}"
    if key in BUILT_IN:
        module, _, attribute = BUILT_IN[key].partition(":")
        return getattr(import_module(module), attribute)  # type: ignore[no-any-return]
    for point in entry_points(group=ENTRY_POINT_GROUP, name=key):
        try:
            return point.load()  # type: ignore[no-any-return]
        except (ImportError, AttributeError) as error:
            package = point.dist.name if point.dist else "an unknown package"
            raise ConfigError(
                f"[{kind}] backend = {name!r}: {point.value} of {package} cannot be imported ({error}); reinstall it"
            ) from error
    raise ConfigError(
        f"[{kind}] backend = {name!r} is unknown; known are {', '.join(map(repr, backend_names(kind)))}; "
        f"a package adds more by entry points {ENTRY_POINT_GROUP!r}"
    )
