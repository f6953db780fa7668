"""The group of all commands, which are loaded on use, and the handling of errors common to all."""

import errno
import importlib
import os
import sys
import traceback
from typing import Any, NoReturn

import click

from mpmcli import __version__
from mpmcli.cli.interrupt import catch_interrupts, interrupt_came, interrupted_code
from mpmcli.cli.streams import flush_streams, print_error
from mpmcli.cli.supervisor import may_supervise, supervise
from mpmcli.errors import InputError, MpmcliError

# By group: name of each command, the module with its NAME_command, and its help line, so that help loads no modules.
GROUPS = {
    "Start": {
        "new": ("materials", "List the example scenes, or copy one."),
        "check": ("inspection", "Say which step is safe and why, or whether a result is stable."),
        "simulate": ("simulate", "Run a scene and store its particles."),
        "materials": ("materials", "List laws, presets, their parameters and knobs."),
    },
    "Look": {
        "info": ("inspection", "Say what a result or a scene holds, and whether it has changed."),
        "render": ("pictures", "Draw frames of a result: pictures, films, montages."),
        "plot": ("pictures", "Draw the ledger of a result: energies, momentum, steps, ..."),
    },
    "Datasets": {
        "sweep": ("dataset", "Compute a dataset of many varied runs."),
        "dataset": ("dataset", "Count, verify and merge datasets."),
        "export": ("dataset", "Write a dataset or a result for learning, NumPy or ParaView."),
        "score": ("dataset", "Score predicted trajectories against those of a dataset."),
    },
    "Trust": {
        "validate": ("validate", "Measure speed against error on problems with known answers."),
        "bench": ("validate", "Compare speed with the MPM examples that Taichi ships."),
    },
    "Maintenance": {
        "doctor": ("inspection", "Say whether everything that mpmcli needs works here."),
        "warm": ("simulate", "Compile the kernels of scenes ahead."),
        "schema": ("materials", "Print the JSON Schema of scenes, for editors."),
        "completion": ("program", "Print the script that completes commands in a shell."),
    },
}
COMMANDS = {name: told for group in GROUPS.values() for name, told in group.items()}

# Faults of the disk that any file may meet.
DISK_FAULTS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)


class LazyGroup(click.Group):
    """A group whose commands are imported on use."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"mpmcli.cli.{COMMANDS[cmd_name][0]}")
        return getattr(module, f"{cmd_name}_command")

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            from difflib import get_close_matches

            near = get_close_matches(args[0], COMMANDS, n=1)
            hint = f' did you mean "{near[0]}"?' if near else f" the commands are {', '.join(COMMANDS)}."
            raise click.UsageError(f'there is no command "{args[0]}";{hint}', ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = max(map(len, COMMANDS))
        for group, commands in GROUPS.items():
            with formatter.section(group):
                formatter.write_dl([(f"{name:<{width}}", line) for name, (_, line) in commands.items()])


@click.group(cls=LazyGroup, invoke_without_command=True, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
@click.version_option(__version__, prog_name="mpmcli")
@click.pass_context
def program(context: click.Context, debug: bool) -> None:
    """Turn a TOML scene into a reproducible particle dataset with the Material Point Method.

    Answers go to stdout; progress, warnings and errors go to stderr. Exit codes: 0 done; 1 done, with a finding; 2 bad
    input or usage; 130 interrupted; 143 ended by SIGTERM or SIGHUP.
    """
    context.obj = debug
    if context.invoked_subcommand is None:
        click.echo(context.get_help(), err=True)
        context.exit(2)


@click.command("completion", epilog="Example: mpmcli completion bash >> ~/.bashrc")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion_command(shell: str) -> None:
    """Print the script that completes mpmcli in SHELL."""
    from click.shell_completion import get_completion_class

    script = get_completion_class(shell)
    assert script is not None
    click.echo(script(program, {}, "mpmcli", "_MPMCLI_COMPLETE").source())


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line, `sys.argv` by default, and exit with its code."""
    words = sys.argv[1:] if arguments is None else arguments
    code = supervise(lambda: run(words)) if may_supervise(words) else run(words)
    flush_streams()
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run the command line and return its exit code; only --debug shows a traceback."""
    catch_interrupts()
    debug = "--debug" in arguments
    # Also accepted after the command.
    arguments = (["--debug"] if debug else []) + [word for word in arguments if word != "--debug"]
    try:
        for word in arguments:
            if any("\ud800" <= letter <= "\udfff" for letter in word):
                raise InputError(f"{os.fsencode(word)!r} is not UTF-8: rename the file or directory.")
        result = program.main(arguments, prog_name="mpmcli", standalone_mode=False)
        return result if isinstance(result, int) else 0
    except click.ClickException as error:
        said = error.format_message()
        said = said[:1].lower() + said[1:] + ("" if said.endswith((".", "?")) else ".")
        context = getattr(error, "ctx", None)
        print_error(f"error: {said}" + (f" See {context.command_path} --help." if context else ""))
        return 2
    except (click.Abort, KeyboardInterrupt):
        print_error("interrupted")
        return interrupted_code()
    except MpmcliError as error:
        if debug:
            traceback.print_exc()
        print_error(f"error: {error}")
        return error.exit_code
    except (BrokenPipeError, SystemExit):
        # The reader of stdout or stderr has closed it, as in `mpmcli materials | head -1`; click and rich then exit.
        return 0
    except Exception as error:
        if interrupt_came():
            print_error("interrupted")
            return interrupted_code()
        if debug:
            traceback.print_exc()
        if isinstance(error, OSError) and error.errno in DISK_FAULTS:
            place = f"{error.filename} could not be written" if error.filename else "a file could not be written"
            print_error(f"error: {place} ({error.strerror}); what was written before it is kept.")
            return 1
        if isinstance(error, FileNotFoundError) and _directory_is_gone():
            print_error("error: the working directory no longer exists: go to another one.")
            return 2
        kind = type(error).__name__
        # On a bare machine a system library that a package loads may be missing.
        of_system = isinstance(error, ImportError) and not (error.name or "").startswith("mpmcli")
        whose = "mpmcli doctor says what is missing" if of_system else "a fault of mpmcli"
        print_error(f"error: {kind}: {error} ({whose}; --debug shows where)")
        return 1


def _directory_is_gone() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False
