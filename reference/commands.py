"""The page about the commands, from the commands themselves."""

import inspect
from collections.abc import Iterator
from typing import Final

import click

from cli.main import mill

HEAD: Final = """\
# Commands

`mill COMMAND --help` says the same at the terminal. Exit codes: 0 done, 1 ended otherwise than asked, 2 wrong input
and nothing moved, 3 a device failed, 130 interrupted; [Errors](../errors.md) says more.

"""


def page() -> str:
    """Commands in the order of work, each with its usage and its options."""
    return HEAD + "".join(_section(words, command) for words, command in commands())


def commands(
    command: click.Command = mill, words: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Every command with the words that call it, outer before inner."""
    if words:
        yield words, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            inner = command.get_command(context, name)
            if inner is not None and not inner.hidden:
                yield from commands(inner, (*words, name))


def _section(words: tuple[str, ...], command: click.Command) -> str:
    name = " ".join(("mill", *words))
    context = click.Context(command, info_name=name)
    usage = " ".join([name, *command.collect_usage_pieces(context)])
    level = "#" * (len(words) + 1)
    about = inspect.cleandoc(command.help or "").replace("\f", "")
    text = f"{level} {name} {{ #{'-'.join(('mill', *words))} }}\n\n{about}\n\n```text\n{usage}\n```\n\n"
    rows = [_row(option, context) for option in command.params if isinstance(option, click.Option)]
    return text + ("| option | what it does |\n|---|---|\n" + "".join(rows) + "\n" if rows else "")


def _row(option: click.Option, context: click.Context) -> str:
    """Its names and words as `--help` has them."""
    said = option.get_help_record(context)
    if said is None:
        return ""
    names, words = said
    return f"| `{names}` | {words.replace('|', '&#124;')} |\n"
