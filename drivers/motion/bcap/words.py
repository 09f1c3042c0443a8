"""A b-CAP datagram in words, for whoever reads a trace."""

from drivers.errors import ProtocolError
from drivers.motion.bcap import session
from drivers.motion.bcap.packet import Packet, Value, decode
from drivers.motion.bcap.results import S_OK, WORDS, failed, result_words

_FUNCTIONS = {
    value: name
    for name, value in vars(session).items()
    if name.startswith(("SERVICE_", "CONTROLLER_", "ROBOT_", "VARIABLE_"))
}


def meaning(data: bytes, *, asked: bool) -> str | None:
    """What was asked, or answered; None for what is no b-CAP packet."""
    try:
        packet = decode(data)
    except ProtocolError:
        return None
    again = f" again, first {packet.reserve}" if packet.reserve else ""
    values = ", ".join(_shown(each) for each in packet.arguments)
    what = _FUNCTIONS.get(packet.code, f"function {packet.code}") if asked else _result(packet)
    return f"{packet.serial}{again}: {what} {values}".rstrip()


def _result(packet: Packet) -> str:
    if packet.code == S_OK:
        return "ok"
    return result_words(packet.code) if failed(packet.code) else WORDS.get(packet.code, f"{packet.code:#010x}")


def _shown(value: Value) -> str:
    if isinstance(value, float):
        return f"{value:.4f}"
    if isinstance(value, tuple):
        return "(" + ", ".join(_shown(each) for each in value) + ")"
    return repr(value)
