"""What goes from the process that mills to the one that shows it: packets of one letter and a body.

    E JSON                       an event, as the record keeps it
    P eye, t, region, JPEG       a picture: 0 or 1 for left or right, when it was given, and which part of the whole
    H JSON                       the run's header
    S                            one file descriptor comes with it: the supervisor's pipe
    Q                            the run has ended; nothing follows

The socket is of the kind that keeps packets whole (SOCK_SEQPACKET): one fits, or it does not.
"""

import struct

EVENT, PICTURE, HEADER, STOP_END, END = b"E", b"P", b"H", b"S", b"Q"
MOST_BYTES = 160_000
"""Of one packet; Linux lets a socket hold 212,992 unless told otherwise."""

_PICTURE = struct.Struct("<Bd4H")

Region = tuple[int, int, int, int]
"""Left, top, right and bottom edge, in pixels of the camera."""


def picture_body(eye: int, t: float, region: Region, jpeg: bytes) -> bytes:
    """The body of a picture, which goes to the viewers as it is."""
    return _PICTURE.pack(eye, t, *region) + jpeg


def eye_of(body: bytes) -> int:
    """Which eye a picture's body is of."""
    return int(body[0])


def time_of(body: bytes) -> float:
    """When it was given, on the clock of the events."""
    return float(_PICTURE.unpack_from(body)[1])
