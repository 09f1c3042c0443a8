"""The page that lists the decisions."""

from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parent.parent / "docs/decisions"

HEAD: Final = """\
# Decisions

Why things are as they are: one page each, with its context, the decision and what follows from it.

"""


def page() -> str:
    """Titles, with links, in the order of their numbers."""
    lines = [f"- [{_title(path)}](../decisions/{path.name})" for path in sorted(FOLDER.glob("*.md"))]
    return HEAD + "\n".join(lines) + "\n"


def _title(path: Path) -> str:
    return path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
