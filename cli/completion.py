"""`mill completion`."""

import click
from click.shell_completion import get_completion_class


@click.command()
@click.argument("shell", metavar="SHELL", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print the completion script of SHELL: bash, zsh or fish.

    In bash, for example: eval "$(mill completion bash)"
    """
    maker = get_completion_class(shell)
    assert maker is not None, "click knows each of these shells"
    click.echo(maker(ctx.find_root().command, {}, "mill", "_MILL_COMPLETE").source())
