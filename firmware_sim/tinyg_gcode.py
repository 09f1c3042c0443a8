"""The G-code of the emulated g2core board: one block read and checked, with what it asks for.

Left out: inches, arcs, offsets, probing, tools, dwells, spindle and coolant words, which are refused as not supported.
"""

import re
from dataclasses import dataclass, field

MALFORMED, BAD_NUMBER = 101, 102
CHECKSUM_MISMATCH, CHECKSUM_WITHOUT_NUMBER = 118, 120
G_UNSUPPORTED, M_UNSUPPORTED, MODAL_VIOLATION, AXIS_MISSING, NO_FEED, G53_ALONE = 131, 132, 133, 134, 142, 145

_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))")
_MODAL = {"G17", "G21", "G40", "G49", "G54", "G61", "G64", "G80", "G94"}
_MOTION = {"G0", "G1"}
_DISTANCE = {"G90", "G91"}
_ACTIONS = {"G28.2"}
_ENDS = {"M2", "M30"}


class BlockError(Exception):
    """The status code with which a block is refused."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


@dataclass(frozen=True)
class Block:
    """What a block says; axis words in mm."""

    number: int | None = None
    motion: str | None = None
    absolute: bool | None = None
    in_machine_coordinates: bool = False
    homes: bool = False
    ends: bool = False
    feed: float | None = None
    axes: dict[str, float] = field(default_factory=dict)


def verified(text: str) -> str:
    """The block without its checksum.

    Raises:
        BlockError: the checksum does not match, or there is one without a line number.
    """
    block, asterisk, told = text.partition("*")
    if not asterisk:
        return text
    checksum = 0
    for byte in block.encode("latin-1"):
        checksum ^= byte
    digits = re.match(r"\s*\d+", told)
    if (int(digits[0]) if digits else 0) != checksum:
        raise BlockError(CHECKSUM_MISMATCH)
    if not block.startswith("N"):
        raise BlockError(CHECKSUM_WITHOUT_NUMBER)
    return block


def is_end(text: str) -> bool:
    """M2 and M30 end an alarm."""
    return re.sub(r"\s", "", text).upper() in _ENDS


def read_block(text: str) -> Block:
    """One block without its checksum.

    Raises:
        BlockError: it is refused as a whole.
    """
    plain = re.sub(r"\(.*?\)|;.*|\(.*|\s", "", text).upper()
    if plain.startswith("%"):
        plain = ""
    words = _WORD.findall(plain)
    if "".join(letter + number for letter, number in words) != plain:
        raise BlockError(BAD_NUMBER if plain[:1].isalpha() else MALFORMED)
    number: int | None = None
    feed: float | None = None
    axes: dict[str, float] = {}
    codes: list[str] = []
    for letter, digits in words:
        value = float(digits)
        if letter in "GM":
            codes.append(f"{letter}{value:g}")
        elif letter == "N":
            number = int(value)
        elif letter == "F":
            feed = value
        elif letter in "XYZ":
            if letter in axes:
                raise BlockError(MALFORMED)
            axes[letter] = value
        else:
            raise BlockError(MALFORMED)
    return _checked(codes, Block(number=number, feed=feed, axes=axes))


def _checked(codes: list[str], block: Block) -> Block:
    motions = [code for code in codes if code in _MOTION | _ACTIONS]
    distances = [code for code in codes if code in _DISTANCE]
    if len(motions) > 1 or len(distances) > 1:
        raise BlockError(MODAL_VIOLATION)
    for code in codes:
        if code not in _MODAL | _MOTION | _DISTANCE | _ACTIONS | _ENDS | {"G53"}:
            raise BlockError(M_UNSUPPORTED if code.startswith("M") else G_UNSUPPORTED)
    motion = next((code for code in motions if code in _MOTION), None)
    if motion is not None and not block.axes:
        raise BlockError(AXIS_MISSING)
    return Block(
        number=block.number,
        motion=motion,
        absolute=distances == ["G90"] if distances else None,
        in_machine_coordinates="G53" in codes,
        homes="G28.2" in codes,
        ends=any(code in _ENDS for code in codes),
        feed=block.feed,
        axes=block.axes,
    )
