"""Pages from the templates beside this file."""

from pathlib import Path
from typing import Any


def filled(template: str, **values: Any) -> str:
    """The page that ``template`` makes of ``values``; one that is missing is an error, and text is never markup."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(values)
