"""What became of one input: a command of mpmcli in this process, with unexpected exceptions as they are."""

import io
import traceback
import warnings
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import click

from mpmcli.cli.program import program
from mpmcli.cli.streams import print_note
from mpmcli.dataset.draw import draw
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.errors import MpmcliError
from mpmcli.materials.registry import parameter_models

MOST_OUTPUT = 2**22


@click.command("load-sweep")
@click.argument("path", type=click.Path(path_type=Path))
def load(path: Path) -> None:
    """Load a sweep and draw its first trajectories, as a dry run does before minutes of other work."""
    laws = parameter_models()
    loaded = load_sweep(path, laws=laws)
    for number in range(min(2, loaded.count)):
        draw(loaded, number).scene(laws)


OWN = {load.name: load}


@dataclass(frozen=True)
class Fault:
    """A forbidden outcome.

    Attributes:
        kind: type and place of the exception, the same for all inputs with one cause; "hang" or "crash" otherwise.
        detail: the traceback, or what is known.
    """

    kind: str
    detail: str


def fault_of(words: Sequence[object]) -> Fault | None:
    """Run a command of mpmcli, and return what is forbidden about its end; None where it ended as it should.

    A result, a sentence and a usage error are allowed; any other exception is not, nor is a control character of the
    input on the terminal, nor more than 4 MiB of text.
    """
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            own = OWN.get(str(words[0]))
            arguments = [str(word) for word in (words[1:] if own else words)]
            (own or program).main(arguments, prog_name="mpmcli", standalone_mode=False)
        except (MpmcliError, click.ClickException) as error:
            print_note(str(error))
        except (click.exceptions.Exit, SystemExit):
            pass
        except Exception as error:
            return Fault(_kind(error), traceback.format_exc(limit=-40))
    text = out.getvalue() + err.getvalue()
    if len(text) > MOST_OUTPUT:
        return Fault("output", f"{len(text)} characters of output")
    if "\x1b" in text or "\x07" in text:
        at = min(k for k in (text.find("\x1b"), text.find("\x07")) if k >= 0)
        return Fault("control character", repr(text[max(0, at - 200) : at + 100]))
    return None


def _kind(error: BaseException) -> str:
    """Name the exception and the innermost line of mpmcli that it passed."""
    ours = [f for f in traceback.extract_tb(error.__traceback__) if "/mpmcli/" in f.filename]
    place = f"{Path(ours[-1].filename).name}:{ours[-1].name}" if ours else "?"
    return f"{type(error).__name__} in {place}"
