"""What a capture device is asked in: structures of <linux/videodev2.h> on 64-bit Linux, and the names of its ioctls."""

from ctypes import Structure, Union, c_int32, c_int64, c_uint8, c_uint32, c_uint64

CAPTURE = 1
MMAP = 1
FIELD_NONE = 1
CAP_CAPTURE, CAP_METADATA, CAP_STREAMING, CAP_DEVICE_CAPS = 0x1, 0x00800000, 0x04000000, 0x80000000
CAP_TIMEPERFRAME = 0x1000
BUFFER_MAPPED, BUFFER_QUEUED, BUFFER_DONE = 0x1, 0x2, 0x4
STAMPED_MONOTONIC, STAMPED_AT_START_OF_EXPOSURE = 0x2000, 0x10000

GAIN = 0x00980913
WHITE_BALANCE_AUTO = 0x0098090C
WHITE_BALANCE_K = 0x0098091A
EXPOSURE_AUTO = 0x009A0901
EXPOSURE = 0x009A0902
EXPOSURE_MANUAL, EXPOSURE_APERTURE_PRIORITY = 1, 3


class Capability(Structure):
    _fields_ = (
        ("driver", c_uint8 * 16),
        ("card", c_uint8 * 32),
        ("bus_info", c_uint8 * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FormatDescription(Structure):
    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_uint8 * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class PixelFormat(Structure):
    _fields_ = tuple(
        (name, c_uint32)
        for name in (
            "width",
            "height",
            "pixelformat",
            "field",
            "bytesperline",
            "sizeimage",
            "colorspace",
            "priv",
            "flags",
            "ycbcr_enc",
            "quantization",
            "xfer_func",
        )
    )


class _FormatUnion(Union):
    _fields_ = (("pix", PixelFormat), ("raw", c_uint8 * 200), ("_pointer", c_uint64))


class Format(Structure):
    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class StreamParameters(Structure):
    _fields_ = (
        ("type", c_uint32),
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("numerator", c_uint32),
        ("denominator", c_uint32),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("rest", c_uint8 * 176),
    )


class RequestBuffers(Structure):
    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags_and_reserved", c_uint32),
    )


class Buffer(Structure):
    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("seconds", c_int64),
        ("microseconds", c_int64),
        ("timecode", c_uint32 * 4),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("offset", c_uint64),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class QueryControl(Structure):
    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_uint8 * 32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )


class Control(Structure):
    _fields_ = (("id", c_uint32), ("value", c_int32))


class Number(Structure):
    _fields_ = (("value", c_int32),)


IOCTLS: dict[int, tuple[str, type[Structure]]] = {
    0: ("querycap", Capability),
    2: ("enum_fmt", FormatDescription),
    4: ("g_fmt", Format),
    5: ("s_fmt", Format),
    8: ("reqbufs", RequestBuffers),
    9: ("querybuf", Buffer),
    15: ("qbuf", Buffer),
    17: ("dqbuf", Buffer),
    18: ("streamon", Number),
    19: ("streamoff", Number),
    21: ("g_parm", StreamParameters),
    22: ("s_parm", StreamParameters),
    27: ("g_ctrl", Control),
    28: ("s_ctrl", Control),
    36: ("queryctrl", QueryControl),
    38: ("g_input", Number),
    39: ("s_input", Number),
}
"""By number within the group 'V': the name of the call, and what its argument is."""


def fourcc(text: str) -> int:
    return int.from_bytes(text.encode("ascii"), "little")
