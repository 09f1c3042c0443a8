"""Making sure that a CANopen node is a drive for this drill, and setting it up; everything written is read back."""

import math
import struct

from drivers.errors import DeviceFaultError
from drivers.spindle import cia402_profile as profile
from drivers.spindle.canopen_node import (
    HOST_NODE_ID,
    NMT_ENTER_PRE_OPERATIONAL,
    RPDO1_ID,
    TPDO1_ID,
    CanOpenNode,
    Entry,
)

REPORT_LAYOUT = struct.Struct("<Hih")
"""TPDO1: statusword, actual speed in rpm, torque in per mille of the rated torque."""
COMMAND_LAYOUT = struct.Struct("<Hi")
"""RPDO1: controlword, target speed in rpm."""

_REPORT_OBJECTS = (0x6041_00_10, 0x606C_00_20, 0x6077_00_10)
_COMMAND_OBJECTS = (0x6040_00_10, 0x60FF_00_20)
_PDO_OFF = 1 << 31
_PDO_NO_REMOTE = 1 << 30
_AT_EACH_SYNC = 1
_AT_ONCE = 255

_START_UP_S = 3.0
_MODE_CHANGE_S = 1.0
_RUN_UP_S = 0.5
"""From standstill to the greatest speed."""
_QUICK_STOP_S = 0.1


def set_up_drive(node: CanOpenNode, max_speed_rpm: float, heartbeat_s: float) -> tuple[str, float]:
    """Stop the drill by SDO, check and configure the drive; its identity and the greatest speed it allows.

    The node is left pre-operational, so that PDOs wait for the caller's NMT start.

    Raises:
        DeviceTimeoutError: no drive answers.
        DeviceFaultError: it is no drive for this, or does not take its settings.
    """
    node.command(NMT_ENTER_PRE_OPERATIONAL)
    node.wait_for_life(_START_UP_S)
    node.boot_ups = 0
    device_type = node.read(profile.DEVICE_TYPE)
    if device_type & 0xFFFF != profile.DRIVE_PROFILE:
        raise DeviceFaultError(
            f"{node.name}: device type {device_type:#010x} is no CiA 402 drive; check [spindle] node_id"
        )
    node.write(profile.CONTROLWORD, profile.QUICK_STOP)
    identity = _read_identity(node)
    max_speed_rpm = min(max_speed_rpm, _speed_limit(node))
    _set_up_velocity(node, max_speed_rpm)
    _set_up_safety(node, heartbeat_s)
    _set_up_pdos(node)
    node.expect_report_bytes(REPORT_LAYOUT.size)
    return identity, max_speed_rpm


def _read_identity(node: CanOpenNode) -> str:
    name = node.read_text(0x1008, "device name")
    numbers = [
        (entry.name, node.read_if_present(entry))
        for entry in (profile.VENDOR, profile.PRODUCT, profile.REVISION, profile.SERIAL)
    ]
    return ", ".join(
        [name or "CiA 402 drive", *(f"{word} {number:#x}" for word, number in numbers if number is not None)]
    )


def _speed_limit(node: CanOpenNode) -> float:
    limits = (node.read_if_present(profile.MAX_MOTOR_SPEED), node.read_if_present(profile.MAX_PROFILE_VELOCITY))
    return min((limit for limit in limits if limit is not None), default=math.inf)


def _set_up_velocity(node: CanOpenNode, max_speed_rpm: float) -> None:
    if not node.read(profile.SUPPORTED_MODES) & profile.PROFILE_VELOCITY_SUPPORTED:
        raise DeviceFaultError(f"{node.name}: has no profile velocity mode ({profile.SUPPORTED_MODES})")
    unit = node.read_if_present(profile.VELOCITY_UNIT)
    if unit not in (None, profile.RPM):
        raise DeviceFaultError(
            f"{node.name}: {profile.VELOCITY_UNIT} is {unit:#010x}, allowed {profile.RPM:#010x} (rpm); "
            "set it with the maker's tool"
        )
    node.write(profile.MODE, profile.PROFILE_VELOCITY)
    if not node.wait(lambda: node.read(profile.MODE_DISPLAY) == profile.PROFILE_VELOCITY, _MODE_CHANGE_S):
        found = node.read(profile.MODE_DISPLAY)
        raise DeviceFaultError(f"{node.name}: {profile.MODE_DISPLAY} stays {found}, not {profile.PROFILE_VELOCITY}")
    run_up = math.ceil(max_speed_rpm / _RUN_UP_S)
    node.write_checked(profile.ACCELERATION, run_up)
    node.write_checked(profile.DECELERATION, run_up)
    node.write_checked(profile.QUICK_STOP_DECELERATION, math.ceil(max_speed_rpm / _QUICK_STOP_S))


def _set_up_safety(node: CanOpenNode, heartbeat_s: float) -> None:
    node.write_checked(profile.ABORT_OPTION, profile.ABORT_BY_QUICK_STOP)
    for entry, value in (
        (profile.QUICK_STOP_OPTION, profile.QUICK_STOP_THEN_DISABLED),
        (profile.ERROR_BEHAVIOUR, profile.STAY_OPERATIONAL),
    ):
        if node.read_if_present(entry) is not None:
            node.write_checked(entry, value)
    node.write_checked(profile.PRODUCER_HEARTBEAT, round(heartbeat_s * 500))
    watch_host(node, heartbeat_s)


def watch_host(node: CanOpenNode, heartbeat_s: float | None) -> None:
    """Let the drive watch the host from the host's next heartbeat on; None ends the watch."""
    value = 0 if heartbeat_s is None else HOST_NODE_ID << 16 | round(heartbeat_s * 1000)
    node.write_checked(profile.CONSUMER_HEARTBEAT, value)


def _set_up_pdos(node: CanOpenNode) -> None:
    for other in range(1, 4):
        link = Entry(0x1800 + other, 1, "I", f"TPDO{other + 1} identifier")
        found = node.read_if_present(link)
        if found is not None and not found & _PDO_OFF:
            node.write(link, found | _PDO_OFF)
    _set_up_pdo(node, "TPDO1", 0x1800, TPDO1_ID, _AT_EACH_SYNC, _REPORT_OBJECTS)
    _set_up_pdo(node, "RPDO1", 0x1400, RPDO1_ID, _AT_ONCE, _COMMAND_OBJECTS)


def _set_up_pdo(node: CanOpenNode, name: str, index: int, can_id: int, kind: int, objects: tuple[int, ...]) -> None:
    # CiA 301: switch the PDO off, clear the map, fill it, set its length, switch the PDO on.
    link = Entry(index, 1, "I", f"{name} identifier")
    count = Entry(index + 0x200, 0, "B", f"{name} map")
    used = node.read(link) & _PDO_NO_REMOTE | can_id + node.node_id
    node.write(link, used | _PDO_OFF)
    node.write_checked(Entry(index, 2, "B", f"{name} transmission type"), kind)
    node.write(count, 0)
    for place, mapped in enumerate(objects, start=1):
        node.write_checked(Entry(index + 0x200, place, "I", f"{name} map"), mapped)
    node.write_checked(count, len(objects))
    node.write_checked(link, used)
