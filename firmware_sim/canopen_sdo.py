"""The server of service data objects (CiA 301, 7.2.4): expedited and segmented transfers, aborts."""

from collections.abc import Callable
from dataclasses import dataclass

from firmware_sim.canopen_dictionary import Abort, Key, SdoAbort

_SEGMENT = 7


@dataclass
class _Transfer:
    key: Key
    upload: bool
    data: bytes
    toggle: int = 0
    announced: int | None = None


class SdoServer:
    """Answers one request of eight bytes at a time; a new initiation ends an unfinished transfer."""

    def __init__(self, read: Callable[[Key], bytes], write: Callable[[Key, bytes], None]) -> None:
        self._read = read
        self._write = write
        self._transfer: _Transfer | None = None

    def reset(self) -> None:
        """Forget an unfinished transfer."""
        self._transfer = None

    def answer(self, request: bytes) -> list[bytes]:
        """The reply to a request; none to an abort."""
        command = request[0] >> 5
        key = (int.from_bytes(request[1:3], "little"), request[3])
        if command == 4:
            self._transfer = None
            return []
        if command in (0, 3) and self._transfer is not None:
            key = self._transfer.key
        try:
            match command:
                case 0:
                    return [self._download_segment(request)]
                case 1:
                    return [self._begin_download(key, request)]
                case 2:
                    return [self._begin_upload(key, request)]
                case 3:
                    return [self._upload_segment(request)]
            raise SdoAbort(Abort.UNKNOWN_COMMAND)
        except SdoAbort as abort:
            self._transfer = None
            return [_message(0x80, key) + abort.code.to_bytes(4, "little")]

    def _begin_upload(self, key: Key, request: bytes) -> bytes:
        self._transfer = None
        data = self._read(key)
        if 1 <= len(data) <= 4:
            return _message(0x43 | (4 - len(data)) << 2, request) + data.ljust(4, b"\x00")
        self._transfer = _Transfer(key, upload=True, data=data)
        return _message(0x41, request) + len(data).to_bytes(4, "little")

    def _upload_segment(self, request: bytes) -> bytes:
        transfer = self._continue(request, upload=True)
        part, transfer.data = transfer.data[:_SEGMENT], transfer.data[_SEGMENT:]
        last = not transfer.data
        head = request[0] & 0x10 | (_SEGMENT - len(part)) << 1 | last
        if last:
            self._transfer = None
        return bytes((head,)) + part.ljust(_SEGMENT, b"\x00")

    def _begin_download(self, key: Key, request: bytes) -> bytes:
        self._transfer = None
        expedited, sized = request[0] & 0x02, request[0] & 0x01
        if expedited:
            # Without a size the object's own length counts.
            size = 4 - (request[0] >> 2 & 3) if sized else len(self._read(key))
            self._write(key, request[4 : 4 + size])
        else:
            announced = int.from_bytes(request[4:8], "little") if sized else None
            self._transfer = _Transfer(key, upload=False, data=b"", announced=announced)
        return _message(0x60, request) + bytes(4)

    def _download_segment(self, request: bytes) -> bytes:
        transfer = self._continue(request, upload=False)
        transfer.data += request[1 : 8 - (request[0] >> 1 & 7)]
        if request[0] & 0x01:
            self._transfer = None
            if transfer.announced is not None and transfer.announced != len(transfer.data):
                raise SdoAbort(Abort.WRONG_LENGTH)
            self._write(transfer.key, transfer.data)
        return bytes((0x20 | request[0] & 0x10,)) + bytes(7)

    def _continue(self, request: bytes, *, upload: bool) -> _Transfer:
        transfer = self._transfer
        if transfer is None or transfer.upload is not upload:
            raise SdoAbort(Abort.UNKNOWN_COMMAND)
        if request[0] >> 4 & 1 != transfer.toggle:
            raise SdoAbort(Abort.TOGGLE)
        transfer.toggle ^= 1
        return transfer


def _message(command: int, target: Key | bytes) -> bytes:
    """The first four bytes: command, and the object as named by a key or by a request."""
    if isinstance(target, bytes):
        return bytes((command,)) + target[1:4]
    return bytes((command,)) + target[0].to_bytes(2, "little") + bytes((target[1],))
