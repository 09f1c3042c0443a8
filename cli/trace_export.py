"""Traces for other tools: MCAP for Foxglove, pcap for Wireshark."""

import json
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.errors import ConfigError
from drivers.trace_file import TraceLog, frame_of

if TYPE_CHECKING:
    from drivers.trace_file import Entry

PCAP_HEADER = struct.Struct("<IHHiIII")
"""Magic, version 2.4, correction to UTC, accuracy (both unused), longest packet, link type
(draft-ietf-opsawg-pcap, section 4). The magic tells the byte order, and that times are in microseconds."""
PCAP_PACKET = struct.Struct("<IIII")
"""Seconds, microseconds, bytes kept, bytes that there were (section 5)."""
CAN_FRAME = struct.Struct(">IB3x8s")
"""Identifier with its flags, big-endian, length, padding, data filled up to eight bytes."""
PCAP_MAGIC = 0xA1B2C3D4
LINKTYPE_CAN_SOCKETCAN = 227

_TEXT = {"type": "string"}
_SCHEMAS: dict[str, dict[str, Any]] = {
    "wire": {
        "t": {"type": "number", "description": "seconds of the trace"},
        "kind": {**_TEXT, "description": "out, in, call or error"},
        "data": {"description": "as in the trace"},
        "words": {**_TEXT, "description": "the same for people"},
    },
    "decision": {
        "t": {"type": "number", "description": "seconds of the trace"},
        "kind": {**_TEXT, "description": "kind of the event"},
        "data": {"type": "object", "description": "its fields"},
    },
}


def write_mcap(log: TraceLog, path: Path) -> int:
    """Write a topic ``/WIRE`` of JSON messages for each wire, ``/run`` for decisions; how many messages.

    Raises:
        ConfigError: the file cannot be written.
    """
    from mcap.writer import Writer

    began_ns = round(log.began.timestamp() * 1e9)
    try:
        file = path.open("wb")
    except OSError as error:
        raise _unwritable(path, error) from error
    with file:
        writer = Writer(file)
        writer.start(profile="", library="micromill")
        writer.add_metadata("trace", {key: json.dumps(value) for key, value in log.header.items()})
        schemas = {
            name: writer.register_schema(
                f"mill.{name}", "jsonschema", json.dumps({"type": "object", "properties": properties}).encode()
            )
            for name, properties in _SCHEMAS.items()
        }
        channels: dict[str, int] = {}
        for entry in log.entries:
            if entry.wire not in channels:
                schema = schemas["decision" if entry.wire == "run" else "wire"]
                channels[entry.wire] = writer.register_channel(f"/{entry.wire}", "json", schema)
            at_ns = began_ns + round(entry.t_s * 1e9)
            writer.add_message(channels[entry.wire], at_ns, _message(entry), at_ns, sequence=entry.number)
        writer.finish()  # type: ignore[no-untyped-call]
    return len(log.entries)


def _message(entry: "Entry") -> bytes:
    from cli.trace import words

    if entry.wire == "run":
        told = {key: value for key, value in entry.data.items() if key != "kind"}
        return json.dumps({"t": entry.t_s, "kind": entry.data["kind"], "data": told}).encode()
    told = {"t": entry.t_s, "kind": entry.kind, "data": entry.data, "words": words(entry).strip()}
    return json.dumps(told).encode()


def write_pcap(log: TraceLog, path: Path) -> int:
    """Write the CAN frames of both directions, which pcap does not tell apart; how many.

    Raises:
        ConfigError: the trace has none, or the file cannot be written.
    """
    frames = [entry for entry in log.entries if entry.wire == "spindle" and entry.kind in ("in", "out")]
    if not frames:
        raise ConfigError(f"{path}: not written: the trace holds no CAN frame; trace a session that opens the spindle")
    began_us = round(log.began.timestamp() * 1e6)
    packets = [PCAP_HEADER.pack(PCAP_MAGIC, 2, 4, 0, 0, 65_535, LINKTYPE_CAN_SOCKETCAN)]
    for entry in frames:
        can_id, flags, data = frame_of(entry.data)
        seconds, us = divmod(began_us + round(entry.t_s * 1e6), 1_000_000)
        packets.append(PCAP_PACKET.pack(seconds, us, CAN_FRAME.size, CAN_FRAME.size))
        packets.append(CAN_FRAME.pack(can_id | flags, len(data), data))
    try:
        path.write_bytes(b"".join(packets))
    except OSError as error:
        raise _unwritable(path, error) from error
    return len(frames)


def _unwritable(path: Path, error: OSError) -> ConfigError:
    return ConfigError(f"{path}: cannot be written ({error.strerror}); name another file")
