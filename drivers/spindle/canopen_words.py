"""What a CAN frame means in CANopen, in words: CiA 301, and the two PDOs as ``cia402_setup`` maps them."""

import struct

from canopen import SdoAbortedError

from drivers.spindle import cia402_profile as profile
from drivers.spindle import emergency
from drivers.spindle.canopen_node import Entry
from drivers.spindle.cia402_setup import COMMAND_LAYOUT, REPORT_LAYOUT

_NMT_COMMANDS = {1: "start", 2: "stop", 0x80: "enter pre-operational", 0x81: "reset node", 0x82: "reset communication"}
_NMT_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 0x7F: "pre-operational"}
_NAMES = {(entry.index, entry.subindex): entry.name for entry in vars(profile).values() if isinstance(entry, Entry)}
_EXPEDITED, _SIZED = 2, 1


def meaning(can_id: int, data: bytes) -> str:
    """One frame with an 11-bit identifier in words; empty for one that CANopen's predefined connections do not know."""
    function, node = can_id & 0x780, can_id & 0x7F
    try:
        if can_id == 0x000:
            return f"NMT {_NMT_COMMANDS.get(data[0], f'command {data[0]:#x}')} node {data[1] or 'all'}"
        if can_id == 0x080:
            return "SYNC"
        if function == 0x080:
            return f"EMCY node {node}: {_emergency(data)}"
        if function == 0x580:
            return f"SDO node {node} -> host: {_sdo_reply(data)}"
        if function == 0x600:
            return f"SDO host -> node {node}: {_sdo_request(data)}"
        if function == 0x700:
            return f"heartbeat node {node}: {_NMT_STATES.get(data[0], f'state {data[0]:#x}')}"
        if function == 0x180 and len(data) == REPORT_LAYOUT.size:
            statusword, speed_rpm, torque = REPORT_LAYOUT.unpack(data)
            state = profile.DriveState.of(statusword) or f"statusword {statusword:04X}h"
            return f"TPDO1 node {node}: {state}, {speed_rpm} rpm, torque {torque / 10:g} %"
        if function == 0x200 and len(data) == COMMAND_LAYOUT.size:
            control, target_rpm = COMMAND_LAYOUT.unpack(data)
            return f"RPDO1 node {node}: controlword {control:04X}h, target {target_rpm} rpm"
    except (IndexError, struct.error):
        return "too short for CANopen"
    # TPDO1 and RPDO1 take turns from 180h to 500h.
    if 0x180 <= function <= 0x500:
        direction = "R" if function & 0x80 == 0 else "T"
        return f"{direction}PDO{((function - 0x180) >> 8) + 1} node {node}"
    return ""


def _emergency(data: bytes) -> str:
    (code,) = struct.unpack_from("<H", data)
    return "errors are gone" if emergency.is_reset(code) else emergency.words(code)


def _sdo_request(data: bytes) -> str:
    command = data[0] >> 5
    if command == 1:
        return f"write {_object(data)}{_value(data)}"
    if command == 2:
        return f"read {_object(data)}"
    if command == 4:
        return f"abort {_object(data)}, {_abort_code(data)}"
    return {0: "next segment", 3: "asks for the next segment"}.get(command, f"command {command}")


def _sdo_reply(data: bytes) -> str:
    command = data[0] >> 5
    if command == 2:
        return f"{_object(data)}{_value(data)}"
    if command == 3:
        return f"{_object(data)} written"
    if command == 4:
        return f"refuses {_object(data)}, {_abort_code(data)}"
    if command == 0:
        return f"segment {data[1:8]!r}"
    return "segment taken" if command == 1 else f"command {command}"


def _object(data: bytes) -> str:
    index, subindex = struct.unpack_from("<HB", data, 1)
    name = _NAMES.get((index, subindex))
    return f"{index:04X}h:{subindex:02X}h" + (f" ({name})" if name else "")


def _value(data: bytes) -> str:
    """The value of an expedited transfer; a segmented one tells its length."""
    if not data[0] & _EXPEDITED:
        return f", {struct.unpack_from('<I', data, 4)[0]} bytes in segments"
    size = 4 - (data[0] >> 2 & 3) if data[0] & _SIZED else 4
    number = int.from_bytes(data[4 : 4 + size], "little")
    return f" = {number:#x}"


def _abort_code(data: bytes) -> str:
    (code,) = struct.unpack_from("<I", data, 4)
    return str(SdoAbortedError(code))
