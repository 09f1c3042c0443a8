"""Who is at the other end of a wire, asked where asking is harmless: nothing moves, nothing is reset.

A serial port is asked GRBL's ``?``, which any state answers (GRBL 1.1 interface document, "Real-time commands"), and
``$I`` only where it stands; then LAWICEL's ``V`` and ``N`` (CANUSB manual); then g2core's build (g2core wiki). Never
an end of line before a report has come: it would complete what a dead host left half said. On a CAN bus nothing is
sent: a node is known by its heartbeat (CiA 301, 7.2.8.3.2). A robot at an address is connected to and left again,
without taking its arm. An inverter is asked for two of its parameters, at the speed that a rig file names: its frames
mean nothing at another one.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import can

from drivers.clock import Clock
from drivers.errors import DeviceError
from drivers.motion.grbl import protocol
from drivers.motion.transport import SerialLine
from drivers.trace import TracedBus, TracedDatagrams, TracedLine
from drivers.trace_file import Trace

BAUD = 115_200
ANSWER_S = 0.5
START_S = 1.5
"""A board that starts anew when its port is opened says its banner some 2 s later, the questions' time included."""
_LARGEST_ANSWER = 8192
_AT_REST = {"Idle", "Alarm"}
"""The states in which 1.1h takes ``$I``."""
_NODE_IDS = range(1, 128)
_VERSION = re.compile(rb"(V[0-9A-F]{4}|[ -~]*[Cc][Aa][Nn][ -~]*)\r")
"""LAWICEL's own answer, or the free text of others, such as CANable's."""
_BUILD = re.compile(rb'"fb" ?: ?(\d+\.\d+)')
_FOOTER = re.compile(rb'\{"r":\{.*\},"f":\[\d+,\d+,\d+\]\}\n')
_SERIAL_NUMBER = re.compile(rb"N([0-9A-Za-z]{4})\r")


@dataclass(frozen=True)
class Identified:
    """What was understood of the answers."""

    role: Literal["motion", "spindle"] | None
    """What it can be used for; None where nothing was understood."""
    words: str
    """For people: who it is, or that nobody answered."""
    firmware: str = ""
    """The version or build as a rig file names it, "1.1h"."""
    make: Literal["grbl", "tinyg", "bcap", "cia402", "modbus"] = "grbl"
    """Of what it can be used for: its backend in a rig file."""
    node_ids: tuple[int, ...] = ()
    """The nodes heard on a CAN bus."""
    asked_at: Mapping[str, int | str] = field(default_factory=dict)
    """The keys of a rig file by which it was reached."""


def identify_port(port: str, clock: Clock, *, trace: Trace | None = None) -> Identified:
    """Ask at a serial port that nobody holds; it is locked meanwhile and given back as it was found."""
    from drivers.motion.serial_line import borrowed_serial

    try:
        with borrowed_serial(port, BAUD) as line:
            return identify_line(line if trace is None else TracedLine(line, trace, port), clock)
    except DeviceError as error:
        return Identified(None, str(error))


def identify_line(line: SerialLine, clock: Clock) -> Identified:
    """Ask GRBL's questions, then an SLCAN adapter's.

    Raises:
        ConnectionLostError: the other side is gone.
    """
    line.write(protocol.STATUS)
    heard = _heard(line, clock, ANSWER_S, lambda data: b">" in data or b"Grbl" in data)
    state = re.search(rb"<([A-Z][a-z]+)", heard)
    if state is None and b"grbl" not in heard.lower():
        if found := _slcan(line, clock) or _g2core(line, clock):
            return found
        heard = _heard(line, clock, START_S, lambda data: b"help]" in data)
        if b"grbl" not in heard.lower():
            return Identified(None, f"nobody answered at {BAUD} baud: neither GRBL, g2core nor an SLCAN adapter")
    if state is not None and state[1].decode() not in _AT_REST:
        return Identified("motion", f"GRBL, busy ({state[1].decode()})")
    line.write(b"$I\n")
    said = _heard(line, clock, ANSWER_S, lambda data: b"ok" in data or b"error:" in data)
    feedback = [message for message in protocol.Parser().feed(said) if isinstance(message, protocol.Feedback)]
    try:
        info = protocol.build_info(feedback)
    except DeviceError as error:
        return Identified("motion", f"GRBL, but {error}")
    version = re.match(r"\d+\.\d+\w?", info.version)
    return Identified("motion", info.identity, firmware=version[0] if version else "")


def identify_inverter(
    port: str, clock: Clock, *, baud: int, framing: str, station: int, trace: Trace | None = None
) -> Identified:
    """Ask a Delta VFD for its identity code and its firmware; nothing is written to it, and its watch is not begun."""
    from drivers.motion.serial_line import borrowed_serial
    from drivers.spindle.modbus_wire import ModbusWire

    try:
        with borrowed_serial(port, baud, framing=framing) as line:
            traced = line if trace is None else TracedLine(line, trace, port)
            words = ModbusWire(traced, clock, station=station, baud=baud).who(ANSWER_S)
    except DeviceError as error:
        return Identified(None, str(error))
    asked_at: dict[str, int | str] = {"baud": baud, "framing": framing, "station": station}
    return Identified("spindle", words, make="modbus", asked_at=asked_at)


def identify_robot(address: str, clock: Clock, *, trace: Trace | None = None) -> Identified:
    """Ask a DENSO controller at HOST:PORT, which nobody speaks to, for its version."""
    from drivers.motion.bcap.robot import VERSION, Robot
    from drivers.motion.bcap.session import BcapSession
    from drivers.motion.udp_line import open_udp

    host, _, port = address.rpartition(":")
    try:
        line = open_udp(host, int(port))
        session = BcapSession(line if trace is None else TracedDatagrams(line, trace, address), clock)
        try:
            robot = Robot(session)
            robot.connect()
            version = str(robot.read(VERSION))
            robot.disconnect()
        finally:
            session.close()
    except DeviceError as error:
        return Identified(None, str(error))
    return Identified("motion", f"DENSO b-CAP {version}", make="bcap")


def identify_can(channel: str, clock: Clock, *, listen_s: float = 2.0, trace: Trace | None = None) -> Identified:
    """Listen at a SocketCAN interface for heartbeats; nothing is sent."""
    try:
        with can.Bus(interface="socketcan", channel=channel) as bus:
            traced = bus if trace is None else TracedBus(bus, trace, channel)
            return identify_bus(traced, clock, listen_s=listen_s)
    except (OSError, can.CanError) as error:
        return Identified(None, f"CAN interface {channel}: cannot be listened to ({error}); is it up?")


def identify_bus(bus: can.BusABC, clock: Clock, *, listen_s: float) -> Identified:
    """The nodes whose heartbeats are heard within ``listen_s``."""
    nodes, deadline_s = set(), clock.now_s() + listen_s
    while (remaining_s := deadline_s - clock.now_s()) > 0:
        message = bus.recv(remaining_s)
        if message is not None and len(message.data) == 1 and message.arbitration_id - 0x700 in _NODE_IDS:
            nodes.add(message.arbitration_id - 0x700)
    found = tuple(sorted(nodes))
    words = f"CANopen node {', '.join(map(str, found))}" if found else f"no heartbeat within {listen_s:g} s"
    return Identified("spindle" if found else None, words, make="cia402", node_ids=found)


def _slcan(line: SerialLine, clock: Clock) -> Identified | None:
    # The first CR ends what was said before. Some firmware acknowledges nothing, so that silence passes.
    line.write(b"\rV\r")
    if not (version := _VERSION.search(_heard(line, clock, ANSWER_S, lambda data: bool(_VERSION.search(data))))):
        return None
    line.write(b"N\r")
    number = _SERIAL_NUMBER.search(_heard(line, clock, ANSWER_S, lambda data: bool(_SERIAL_NUMBER.search(data))))
    words = f"SLCAN adapter {version[1].decode('ascii', 'replace')}"
    return Identified("spindle", f"{words}, serial number {number[1].decode()}" if number else words, make="cia402")


def _g2core(line: SerialLine, clock: Clock) -> Identified | None:
    """Known by the footer of its replies; what stands in them depends on how it is set, which is not changed here."""
    line.write(b'{"fb":null}\n')
    # Replies to the questions before may still come.
    said = _heard(line, clock, ANSWER_S, lambda data: bool(_BUILD.search(data)))
    if not _FOOTER.search(said):
        return None
    if (build := _BUILD.search(said)) is None:
        return Identified("motion", "g2core or TinyG, set to tell its build only when it is opened", make="tinyg")
    return Identified("motion", f"g2core {build[1].decode()}", firmware=build[1].decode(), make="tinyg")


def _heard(line: SerialLine, clock: Clock, wait_s: float, whole: Callable[[bytes], bool]) -> bytes:
    """What comes until it is whole or the time is over."""
    data, deadline_s = b"", clock.now_s() + wait_s
    while not whole(data) and len(data) < _LARGEST_ANSWER and (remaining_s := deadline_s - clock.now_s()) > 0:
        data += line.read(remaining_s)
    return data
