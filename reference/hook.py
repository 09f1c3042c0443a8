"""MkDocs asks here for the pages that are written from the code, and for those that its navigation does not name."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from reference import bench, commands, decisions, files, outputs, records

PAGES: Final[dict[str, Callable[[], str]]] = {
    "reference/commands.md": commands.page,
    "reference/rig-file.md": files.rig_page,
    "reference/specimen-file.md": files.specimen_page,
    "reference/json.md": outputs.page,
    "reference/records.md": records.page,
    "reference/decisions.md": decisions.page,
    "virtual-bench.md": bench.page,
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are written from the code."""
    for name, page in PAGES.items():
        files.append(File.generated(config, name, content=page()))
    return files


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Name every page of docs/ in the navigation: what nobody named, under How-to."""
    folder = Path(config.docs_dir)
    sections = {title: pages for entry in config.nav or [] for title, pages in entry.items()}
    named = set(_names(config.nav))
    sections["How-to"] += [path.name for path in sorted(folder.glob("*.md")) if path.name not in named]
    return config


def _names(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    return [name for item in (nav.values() if isinstance(nav, dict) else nav or []) for name in _names(item)]
