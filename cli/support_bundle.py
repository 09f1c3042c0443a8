"""`mill support-bundle`: what a maintainer needs to help, in one file and without personal data."""

import json
import platform
import re
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import click

from cli.anonymous import anonymous
from cli.devices import found_devices
from cli.options import rig_option
from drivers.checked_lines import checked
from drivers.errors import ConfigError
from milling.record import CHAIN, read_run

PACKAGES = (
    "canopen", "click", "numba", "numpy", "onnxruntime", "open3d", "opencv-contrib-python-headless", "pydantic",
    "pyserial", "python-can", "scipy", "torch",
)  # fmt: skip

_OPERATOR = re.compile(r"""(\boperator"?\s*[:=]\s*)("(?:[^"\\\n]|\\.)*"|'[^'\n]*')""")
"""In TOML and in JSON."""


@dataclass(frozen=True)
class Item:
    """One file of the bundle."""

    name: str
    text: str
    source: str
    """Where it is from, for people."""


@click.command("support-bundle")
@rig_option
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="ZIP",
    help="File to write. [default: support-DATE.zip]",
)
def support_bundle(rig: Path | None, out: Path | None) -> None:
    """Pack what a maintainer needs to help: versions, rig file, devices, certificate, last run, traces.

    Works on the folder it is called in: certificates/, runs/, and traces here and in traces/. Names of users and of
    this computer, home folders, passwords and pictures are left out, and so are serial numbers of devices that the rig
    file does not name. Look into the file before you send it.
    """
    out = out or Path(datetime.now().astimezone().strftime("support-%Y-%m-%d_%H-%M-%S.zip"))
    if out.exists():
        raise ConfigError(f"{out}: exists already and is kept; name another --out file")
    items = [_versions(), *_rig(rig), _devices(rig), *_certificate(), *_last_run(), *_traces()]
    try:
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file:
            for item in items:
                file.writestr(anonymous(item.name), _clean(item))
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}); name another --out file") from error
    for item in items:
        click.echo(f"in   {item.name:<32} {item.source}")
    for words in _missing(items, rig):
        click.echo(f"out  {words}")
    click.echo(f"{out}: look into it before you send it")


def _versions() -> Item:
    def installed(name: str) -> str:
        try:
            return version(name)
        except PackageNotFoundError:
            return "not installed"

    told = {
        "mill": version("micromill"),
        "python": sys.version,
        "packages": {name: installed(name) for name in PACKAGES},
        "system": {"kernel": f"{platform.system()} {platform.release()}", "machine": platform.machine()},
    }
    return Item("versions.json", json.dumps(told, indent=1), "mill, Python, packages, kernel")


def _rig(rig: Path | None) -> Iterator[Item]:
    if rig is not None:
        try:
            yield Item("rig.toml", rig.read_text(encoding="utf-8"), str(rig))
        except OSError as error:
            raise ConfigError(f"{rig}: cannot be read ({error.strerror}); name the rig file") from error


def _devices(rig: Path | None) -> Item:
    named = "" if rig is None else rig.read_text(encoding="utf-8")
    rows = []
    for device in found_devices(rig):
        row = asdict(device)
        if not any(f'"{name}"' in named for name in (device.path, *device.stable_paths)):
            # What the rig does not use may be anything: a telephone, or the camera of a laptop.
            row |= {"serial_number": None, "stable_paths": []}
        rows.append(row)
    return Item("devices.json", json.dumps(rows, indent=1), "as `mill devices` lists them")


def _certificate() -> Iterator[Item]:
    from cli.doctor import CERTIFICATES

    for ending in (".json", ".html"):
        newest = _newest(CERTIFICATES.glob(f"*{ending}"))
        if newest is not None:
            yield _file(f"certificate/{newest.name}", newest)


def _last_run() -> Iterator[Item]:
    from cli.runs import RUNS

    newest = _newest(RUNS.glob("*/header.json"))
    if newest is not None:
        names = ("header.json", "events.jsonl", "result.json", "calibration.toml")
        for path in (newest.parent / name for name in names):
            if path.is_file():
                item = _file(f"run/{path.name}", path)
                yield replace(item, text=_unchained(item.text, newest.parent)) if path.name == "events.jsonl" else item


def _unchained(text: str, folder: Path) -> str:
    """Events with sums in place of links, which do not survive what is taken out; of a damaged record, as they are."""
    try:
        chain = read_run(folder).chain
    except ConfigError:
        return text
    n, lines = 0 if chain is None else chain.lines, text.split("\n")
    summed = (checked(line.partition(" ")[2].encode()).decode().rstrip("\n") for line in lines[:n])
    return "\n".join([*summed, *lines[n:]])


def _traces() -> Iterator[Item]:
    from drivers.trace_file import read_trace

    for path in sorted([*Path().glob("*.jsonl"), *Path("traces").glob("*.jsonl")]):
        try:
            read_trace(path)
        except ConfigError:
            continue
        yield _file(f"traces/{path.name}", path)


def _file(name: str, path: Path) -> Item:
    return Item(name, path.read_text(encoding="utf-8", errors="replace"), str(path))


def _newest(paths: Iterator[Path]) -> Path | None:
    return max(paths, key=lambda path: path.stat().st_mtime, default=None)


def _clean(item: Item) -> str:
    """The text without personal data; lines that carry a checksum get the one of what is left."""
    cleaned = _OPERATOR.sub(r'\1"OPERATOR"', anonymous(item.text))
    if item.name == "run/result.json":
        return _without_chain(cleaned)
    if not item.name.endswith(".jsonl"):
        return cleaned
    pairs = zip(item.text.split("\n"), cleaned.split("\n"), strict=True)
    return "\n".join(_checked_anew(was, now) for was, now in pairs)


def _without_chain(text: str) -> str:
    # Its events are no chain any more.
    try:
        result = json.loads(text)
        del result[CHAIN]
    except (ValueError, TypeError, KeyError):
        return text
    return json.dumps(result, indent=1)


def _checked_anew(was: str, now: str) -> str:
    # A torn line must not become a whole one.
    is_whole = checked(was.partition(" ")[2].encode()).decode() == was + "\n"
    return checked(now.partition(" ")[2].encode()).decode().rstrip("\n") if is_whole else now


def _missing(items: list[Item], rig: Path | None) -> Iterator[str]:
    """What could have been there, and what never is."""
    names = {item.name.partition("/")[0] for item in items}
    if rig is None:
        yield "rig file: none named; give --rig FILE"
    for name, words in (
        ("certificate", "certificate and report of the doctor: none in certificates/; `mill doctor --rig FILE`"),
        ("run", "record of a run: none in runs/"),
        ("traces", "traces: none here or in traces/; --trace FILE writes one"),
    ):
        if name not in names:
            yield words
    yield "pictures, and the run's report, which shows them"
    yield "names of users and of this computer, home folders, passwords in URLs"
    yield "serial numbers of devices that the rig file does not name"
