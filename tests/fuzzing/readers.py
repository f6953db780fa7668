"""Commands of the fuzzer's own: readers that a command of mpmcli would call after minutes of other work."""

from pathlib import Path

import click

from mpmcli.cli.program import program
from mpmcli.dataset.dataset import open_dataset
from mpmcli.dataset.draw import draw
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.materials.registry import parameter_models
from mpmcli.output import open_result
from mpmcli.output.checkpoints import read_checkpoints
from mpmcli.plot.history import read_history
from mpmcli.render.render_scene import render_scene_of
from mpmcli.render.request import Request, plan_render


@click.command("read")
@click.argument("path", type=click.Path(path_type=Path))
def read(path: Path) -> None:
    """Read all that plot and render read of a result."""
    result = open_result(path)
    for k in range(result.frame_count):
        _ = result.present_frame(k)
    _ = result.colliders
    read_history(result)
    render_scene_of(result)
    plan_render(result, Request(output=path / "picture.png"))


@click.command("trajectories")
@click.argument("path", type=click.Path(path_type=Path))
def trajectories(path: Path) -> None:
    """Read all trajectories of a dataset."""
    for one in open_dataset(path):
        for name in ("position", "velocity", "body", "material", *one.field_names):
            one.read(name)
        _ = one.ledger, one.colliders, one.layout()


@click.command("load-sweep")
@click.argument("path", type=click.Path(path_type=Path))
def sweep(path: Path) -> None:
    """Load a sweep and draw its first trajectories, as a dry run does."""
    laws = parameter_models()
    loaded = load_sweep(path, laws=laws)
    for number in range(min(2, loaded.count)):
        draw(loaded, number).scene(laws)


@click.command("checkpoints")
@click.argument("path", type=click.Path(path_type=Path))
def checkpoints(path: Path) -> None:
    """Read the checkpoints of a run."""
    for point in read_checkpoints(path):
        print(point.frame <= 2, point.step, point.time, sum(array.nbytes for array in point.arrays.values()))


OWN = {command.name: command for command in (read, trajectories, sweep, checkpoints)}


def command_of(words: list[str]) -> tuple[click.Command, list[str]]:
    """Return the command that is named by the first of some words, and what it is given."""
    return (OWN[words[0]], words[1:]) if words[0] in OWN else (program, words)
