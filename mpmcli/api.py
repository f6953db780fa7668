"""mpmcli in Python: `run`, `load_scene`, `sweep` and `open`, which are names of the package."""

import warnings
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from mpmcli.cli.progress import ProgressBar, SimulateProgress
from mpmcli.dataset import Dataset
from mpmcli.dataset import open as open_dataset
from mpmcli.dataset.dataset import is_dataset
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.dataset.sweep_run import SweepSettings, run_sweep
from mpmcli.errors import InputError, RunError
from mpmcli.materials.registry import load_plugins
from mpmcli.output import Result, open_result
from mpmcli.scene import LoadedScene, parse_scene
from mpmcli.scene import load_scene as read_scene
from mpmcli.scene.examples import example_path
from mpmcli.scene.toml_file import value_text
from mpmcli.simulation.settings import RunSettings
from mpmcli.simulation.simulate import simulate
from mpmcli.solver.machine.backend import Arch, stop_backend

SceneSource = str | PathLike[str] | Mapping[str, Any] | LoadedScene


def load_scene(scene: SceneSource, *, plugins: Sequence[str | PathLike[str]] = (), **overrides: object) -> LoadedScene:
    """Load and validate a scene.

    Args:
        scene: a TOML file, the name of an example, or what `tomllib` reads from a scene.
        plugins: Python files with further constitutive laws.
        overrides: values by key, as of `--set`: `title="a drop"`, and `**{"time.end": 0.5}` for a key with dots.

    Returns:
        The scene, as `scene`, and `notes` on what was chosen.

    Raises:
        InputError: a sentence for every fault.
    """
    if isinstance(scene, LoadedScene):
        if overrides:
            raise InputError("the scene is loaded already: give its overrides to load_scene.")
        return scene
    laws, changes = load_plugins(tuple(map(Path, plugins))), _as_set(overrides)
    if isinstance(scene, Mapping):
        return parse_scene(dict(scene), laws=laws, overrides=changes)
    return read_scene(example_path(Path(scene)), changes, laws=laws)


def run(
    scene: SceneSource,
    output: str | PathLike[str] | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
    arch: Arch = "auto",
    threads: int | None = None,
    plugins: Sequence[str | PathLike[str]] = (),
    progress: bool = True,
    **overrides: object,
) -> Result:
    """Run a scene as `mpmcli simulate` does, and open its result.

    Args:
        scene, plugins, overrides: as of `load_scene`; a loaded scene takes no overrides.
        output: directory of the result, by default results/ and the name of the scene's file.
        overwrite: whether an earlier result there is replaced. resume: whether it is continued.
        arch, threads: as of the options of `mpmcli simulate`.
        progress: whether a bar is shown on stderr.

    Returns:
        The result. What `mpmcli check` finds in it beyond notes comes as warnings.

    Raises:
        InputError: as of `load_scene`, or the scene cannot be run; nothing is written.
        RunError: the run ended early; the frames before that are in `output`.
        KeyboardInterrupt: likewise.
    """
    loaded = load_scene(scene, plugins=plugins, **overrides)
    if output is None and not Path(loaded.source).is_file():
        raise InputError("the scene comes from no file that could name its result: give output, a directory.")
    directory = Path("results") / Path(loaded.source).stem if output is None else Path(output)
    settings = RunSettings(directory, arch=arch, threads=threads, overwrite=overwrite, resume=resume)
    # Taichi frees the fields of an earlier run only with its backend.
    stop_backend()
    with SimulateProgress(loaded.scene.time.end, loaded.scene.time.frames + 1, quiet=not progress) as bar:
        summary = simulate(loaded, settings, bar.start, bar.advance)
    if summary.status == "interrupted":
        raise KeyboardInterrupt(summary.message)
    if summary.status != "finished":
        raise RunError(summary.message)
    for finding in summary.check.findings if summary.check else ():
        if finding.severity != "note":
            warnings.warn(finding.line, stacklevel=2)
    return open_result(directory)


def sweep(
    file: str | PathLike[str],
    output: str | PathLike[str] | None = None,
    *,
    count: int | None = None,
    workers: int | None = None,
    threads: int = 1,
    overwrite: bool = False,
    resume: bool = False,
    arch: Arch = "auto",
    plugins: Sequence[str | PathLike[str]] = (),
    progress: bool = True,
    **overrides: object,
) -> Dataset:
    """Compute a dataset as `mpmcli sweep` does, and open it.

    Workers are processes that import the calling script: it must call `sweep` below `if __name__ == "__main__":`.

    Args:
        file: the TOML file of the sweep.
        output: directory of the dataset, by default datasets/ and the name of the file.
        count: number of trajectories, in place of that of the file.
        workers: number of processes, by default as many as cores have threads for.
        threads: CPU threads of each, for trajectories of 20,000 particles and more.
        overwrite, resume, arch, plugins, progress: as of `run`.
        overrides: values of the base scene by key, for all trajectories.

    Returns:
        The dataset, without the trajectories that were left out.

    Raises:
        InputError: the sweep cannot be run, or no trajectory was stable.
    """
    files = tuple(map(Path, plugins))
    loaded = load_sweep(Path(file), laws=load_plugins(files), count=count, overrides=_as_set(overrides))
    directory = Path("datasets") / Path(file).stem if output is None else Path(output)
    options = {"workers": workers, "threads": threads, "overwrite": overwrite, "resume": resume, "arch": arch}
    with ProgressBar(loaded.count, "trajectories", quiet=not progress) as bar:
        state = run_sweep(
            loaded,
            SweepSettings(directory, **options, plugins=files),
            lambda state: bar.show(state.done, "", ""),
            lambda: False,
        )
    if state.status == "interrupted":
        raise KeyboardInterrupt
    return open_dataset(directory)


def open(path: str | PathLike[str]) -> Result | Dataset:
    """Open the result of a run, or a dataset, for reading; InputError: there is none."""
    path = Path(path)
    return open_dataset(path) if is_dataset(path) else open_result(path)


def _as_set(overrides: Mapping[str, object]) -> tuple[str, ...]:
    """Return overrides as `--set` takes them."""
    values = {key: value.tolist() if hasattr(value, "tolist") else value for key, value in overrides.items()}
    return tuple(f"{key}={value_text(value)}" for key, value in values.items())
