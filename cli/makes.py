"""Each built-in make of device, opened on the wire that its table in the rig file names."""

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from cli.config import (
    BcapMotion,
    Cia402SpindleTable,
    GrblMotion,
    ModbusSpindleTable,
    OpenCvCamera,
    TinyGMotion,
)
from drivers.camera.interface import StereoCamera
from drivers.clock import Clock
from drivers.motion.interface import MotionController
from drivers.motion.transport import SerialLine
from drivers.spindle.interface import Spindle
from drivers.trace_file import Trace

if TYPE_CHECKING:
    from drivers.motion.grbl.driver import GrblController

Board = TypeVar("Board", bound=MotionController)


def open_grbl(table: GrblMotion, clock: Clock, trace: Trace | None = None) -> "GrblController":
    """GRBL on its serial port."""
    from drivers.motion.grbl.driver import GrblController

    return _open_board(GrblController, table, clock, trace)


def open_tinyg(table: TinyGMotion, clock: Clock, trace: Trace | None = None) -> MotionController:
    """A g2core board on its serial port."""
    from drivers.motion.tinyg.driver import TinyGController

    return _open_board(TinyGController, table, clock, trace)


def _open_board(
    make: Callable[..., Board], table: GrblMotion | TinyGMotion, clock: Clock, trace: Trace | None
) -> Board:
    line = _serial_line(table.port, table.baud, trace)
    try:
        return make(
            line,
            clock,
            origin_mm=table.origin_mm,
            max_feed_mm_per_s=table.max_feed_mm_s,
            expected_settings=table.settings,
            expected_firmware=table.firmware,
            reply_s=table.reply_s,
        )
    except BaseException:
        line.close()
        raise


def open_bcap(table: BcapMotion, clock: Clock, trace: Trace | None = None, *, silence_s: float) -> MotionController:
    """A DENSO robot at its address, fed by a process of its own."""
    from drivers.motion.bcap.fed import FedRobot
    from drivers.motion.interface import Travel

    def noted(time_s: float, kind: str, datagram: bytes) -> None:
        assert trace is not None
        number, _ = trace.mark()
        trace.note((number, trace.seconds(time_s)), "motion", kind, datagram.decode("latin-1"))

    return FedRobot(
        table.host,
        table.port,
        clock,
        origin_mm=table.origin_mm,
        orientation_deg=table.orientation_deg,
        travel=Travel(table.travel_low_mm, table.travel_high_mm),
        max_feed_mm_per_s=table.max_feed_mm_s,
        reply_s=table.reply_s,
        silence_s=silence_s,
        noted=None if trace is None else noted,
    )


def _serial_line(
    port: str, baud: int, trace: Trace | None, *, wire: str = "motion", framing: str = "8N1"
) -> SerialLine:
    """A serial port, with a trace of what passes if one is asked for."""
    from drivers.motion.serial_line import open_serial

    line = open_serial(port, baud, framing=framing)
    if trace is None:
        return line
    from drivers.trace import TracedLine

    return TracedLine(line, trace, wire)


def open_cia402(table: Cia402SpindleTable, clock: Clock, trace: Trace | None = None) -> Spindle:
    """A CiA 402 drive on its bus."""
    from drivers.spindle.canbus import open_bus
    from drivers.spindle.cia402 import Cia402Spindle

    bus = open_bus(table.interface, table.channel, table.bitrate)
    if trace is not None:
        from drivers.trace import TracedBus

        bus = TracedBus(bus, trace, "spindle")
    try:
        return Cia402Spindle(
            bus, clock, node_id=table.node_id, max_speed_rpm=table.max_speed_rpm, heartbeat_s=table.heartbeat_s
        )
    except BaseException:
        bus.shutdown()
        raise


def open_modbus(table: ModbusSpindleTable, clock: Clock, trace: Trace | None = None) -> Spindle:
    """A Delta VFD on its serial line."""
    from drivers.spindle.modbus import ModbusSpindle

    return ModbusSpindle(
        _serial_line(table.port, table.baud, trace, wire="spindle", framing=table.framing),
        clock,
        station=table.station,
        baud=table.baud,
        max_speed_rpm=table.max_speed_rpm,
        rated_current_a=table.rated_current_a,
        poles=table.poles,
        frequency_unit_hz=10.0**-table.frequency_decimals,
        heartbeat_s=table.heartbeat_s,
    )


def open_opencv(table: OpenCvCamera, clock: Clock, trace: Trace | None = None) -> StereoCamera:
    """Two OpenCV sources as one stereo pair."""
    from drivers.camera.opencv import OpenCvSource
    from drivers.camera.stereo import FrameSource, StereoPair

    def source(device: str, wire: str) -> FrameSource:
        opened = OpenCvSource(
            device,
            clock,
            size_px=table.size_px,
            fps=table.fps,
            exposure=table.exposure,
            gain=table.gain,
            white_balance_k=table.white_balance_k,
        )
        if trace is None:
            return opened
        from drivers.trace import TracedSource

        return TracedSource(opened, trace, wire)

    left = source(table.left, "left")
    try:
        right = source(table.right, "right")
    except BaseException:
        left.close()
        raise
    return StereoPair(left, right, clock, size_px=table.size_px, max_skew_s=table.max_skew_s)
