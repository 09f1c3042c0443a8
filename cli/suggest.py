"""A rig file from what is plugged in: ready to be read by `mill`, with a comment wherever a person must look."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import tomlkit

from cli.output import one_line

if TYPE_CHECKING:
    from drivers.discovery import FoundDevice
    from drivers.identify import Identified

_ABSENT = "none was found: plug it in, and correct this name"


def rig_suggestion(found: Sequence["FoundDevice"], who: Mapping[str, "Identified"]) -> str:
    """The text of a rig file.

    Args:
        found: what is plugged in.
        who: by path, what those said that were asked.
    """
    motion = [device for device in found if device.path in who and who[device.path].role == "motion"]
    spindle = [device for device in found if device.path in who and who[device.path].role == "spindle"]
    # A bus on which nobody beats his heart is a bus still; one that was heard is the better guess.
    spindle += [device for device in found if device.kind == "can" and device not in spindle]
    cameras = [device for device in found if device.kind == "camera"]
    left, right = (cameras[index].name if len(cameras) > index else f"/dev/mill-{side}"
                   for index, side in enumerate(("left", "right")))  # fmt: skip
    lines = [
        "# Written by `mill devices --suggest`. What it could not know says so; docs/rig.md tells what each key means.",
        "schema = 1",
        'name = "bench"                          # the calibration file is called after it',
        "",
        "[motion]",
        *_motion(motion, who),
        "",
        "[spindle]",
        *_spindle(spindle, who),
        "",
        "[camera]",
        'backend = "opencv"',
        *(
            []
            if len(cameras) >= 2
            else [f"# {len(cameras)} of 2 cameras found: plug in what is missing, and correct its name"]
        ),
        "# The first camera found is called left, the second right: `mill doctor` finds out whether they are swapped.",
        f"left = {_text(left)}",
        f"right = {_text(right)}",
        *_others(cameras[2:], who),
        *_exposure(left, right),
        "",
        "[tool]",
        "ball_radius_mm = 0.5                    # could not be known: measure the drill",
        "",
        "[bench]",
        "park_mm = [-2.0, -2.0, -2.0]            # could not be known: where the drill is out of both pictures, in {R}",
        *_left_over(found, [*motion, *spindle, *cameras], who),
    ]
    return "\n".join(lines) + "\n"


def _motion(motion: Sequence["FoundDevice"], who: Mapping[str, "Identified"]) -> Iterable[str]:
    make = who[motion[0].path].make if motion else "grbl"
    yield f'backend = "{make}"'
    yield f"# {_about(motion[0], who) if motion else _ABSENT}"
    if make == "bcap":
        host, _, port = motion[0].path.rpartition(":")
        yield f"host = {_text(host)}"
        yield f"port = {port}"
        yield "# could not be known: where {R} is in the robot's frame, how the tool stands, the box it may move in"
        yield "origin_mm = [0.0, 0.0, 0.0]"
        yield "orientation_deg = [180.0, 0.0, 180.0]"
        yield "travel_low_mm = [-10.0, -30.0, -8.0]"
        yield "travel_high_mm = [24.0, 9.0, 19.0]"
    else:
        yield f"port = {_text(motion[0].name if motion else '/dev/mill-motion')}"
        if motion and (firmware := who[motion[0].path].firmware):
            yield f"firmware = {_text(firmware)}"
        yield "# could not be known: machine coordinates of {R}'s origin; with zeros {R} is the machine's own frame"
        yield "origin_mm = [0.0, 0.0, 0.0]"
    yield from _others(motion[1:], who)


def _spindle(spindle: Sequence["FoundDevice"], who: Mapping[str, "Identified"]) -> Iterable[str]:
    inverter = who.get(spindle[0].path) if spindle else None
    if inverter is not None and inverter.make == "modbus":
        yield 'backend = "modbus"'
        yield f"# {_about(spindle[0], who)}"
        yield f"port = {_text(spindle[0].name)}"
        for key, value in inverter.asked_at.items():
            yield f"{key} = {_text(value) if isinstance(value, str) else value}"
        yield "rated_current_a = 3.0                   # could not be known: the motor's name plate"
    else:
        yield from _on_can(spindle, who)
    yield "speed_rpm = 45000                       # could not be known: milling speed of this drill"
    yield "max_speed_rpm = 60000                   # could not be known: what drill and drive can bear"
    yield from _others(spindle[1:], who)


def _on_can(spindle: Sequence["FoundDevice"], who: Mapping[str, "Identified"]) -> Iterable[str]:
    is_can = bool(spindle) and spindle[0].kind == "can"
    yield 'backend = "cia402"'
    yield f'interface = "{"socketcan" if is_can else "slcan"}"'
    yield f"# {_about(spindle[0], who) if spindle else _ABSENT}"
    yield f"channel = {_text(spindle[0].name if spindle else '/dev/mill-spindle')}"
    nodes = who[spindle[0].path].node_ids if spindle and spindle[0].path in who else ()
    yield "bitrate = 1000000                       # could not be known: as the drive is set"
    if nodes:
        heard = ", ".join(map(str, nodes))
        yield f"node_id = {nodes[0]:<31}# heard on the bus: {heard}"
    else:
        yield "node_id = 1                             # could not be known: as the drive is set"


def _exposure(left: str, right: str) -> Iterable[str]:
    if "://" not in left or "://" not in right:
        yield "# could not be known: fixed, in the camera's own unit; `v4l2-ctl -d DEVICE --list-ctrls` tells its range"
        yield "exposure = 150"


def _others(devices: Iterable["FoundDevice"], who: Mapping[str, "Identified"]) -> Iterable[str]:
    return (f"# also found: {device.name}, {_about(device, who)}" for device in devices)


def _left_over(
    found: Iterable["FoundDevice"], used: Sequence["FoundDevice"], who: Mapping[str, "Identified"]
) -> Iterable[str]:
    rest = [device for device in found if device not in used]
    return ["", "# Not used:", *(f"# {device.name}: {_about(device, who)}" for device in rest)] if rest else []


def _about(device: "FoundDevice", who: Mapping[str, "Identified"]) -> str:
    said = who[device.path].words if device.path in who else ""
    if device.held_by:
        said = f"not asked, held by {device.held_by}"
    about = (said, device.product, device.usb_id, device.serial_number, device.driver, device.problem)
    words = one_line(", ".join(text for text in about if text)) or "nothing known of it"
    # What a device says of itself may hold anything; TOML takes no control characters, not even in a comment.
    return "".join(letter if letter.isprintable() else "?" for letter in words)


def _text(value: str) -> str:
    return tomlkit.string(value).as_string()
