"""`mpmcli completion`."""

import click


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def command(shell: str) -> None:
    """Print the script that completes mpmcli in SHELL.

    For bash: `mpmcli completion bash >> ~/.bashrc`.
    """
    from click.shell_completion import get_completion_class

    from mpmcli.cli.program import program

    script = get_completion_class(shell)
    assert script is not None
    click.echo(script(program, {}, "mpmcli", "_MPMCLI_COMPLETE").source())
