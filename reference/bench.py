"""The page that says what the virtual bench leaves out, in the words of its modules."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parent.parent / "firmware_sim"
_MARK: Final = re.compile(r"\bLeft\s+out:\s+(.*)", re.DOTALL)

HEAD: Final = """\
# What the virtual bench leaves out

The virtual bench is one world that every emulated board, drive and camera shares: the drill really cuts a height
field, the cameras really see it, and each device speaks its protocol on a wire that another process opens. The driver
at the other end is the one that runs on hardware. That is what it is good for: protocols, timing, stops, faults,
geometry, what the pictures show, and the decisions that follow from them.

**It is no tissue.** No milling forces of mouse skulls are published, so the bench's are chosen; so are the strength
of the membrane (a ball that reaches its plane has damaged it) and much of how bone looks while it thins. A rate of
success on the bench says that the program does what it should under what the bench contains. It is never a figure
beside the paper's, nor a promise about an animal.

`--seed` draws a specimen and a rig; [the specimen file](specimen.md) says otherwise where it is written;
[faults](faults.md) are planted by name.

## Module by module

Taken from the modules of `firmware_sim` themselves.

| of | left out |
|---|---|
"""


def page() -> str:
    """What each module says that it leaves out."""
    return HEAD + "\n".join(f"| {about} (`{name}`) | {words} |" for name, about, words in left_out()) + "\n"


def left_out() -> Iterator[tuple[str, str, str]]:
    """Module, what it is, and what it leaves out."""
    for path in sorted(FOLDER.glob("*.py")):
        says = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        if found := _MARK.search(says):
            words = " ".join(found[1].partition("\n\n")[0].split())
            yield path.stem, says.partition("\n")[0].rstrip(".").replace("|", "/"), words
