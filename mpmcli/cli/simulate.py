"""`mpmcli simulate` and `mpmcli warm`."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mpmcli.cli import options
from mpmcli.cli.error_bars import plan_for, study_result
from mpmcli.cli.interrupt import interrupt_came, interrupted_code, interrupts_wait
from mpmcli.cli.options import COUNT, SCENE, json_option, quiet_option
from mpmcli.cli.streams import print_answer, print_error, print_json, print_note, print_text
from mpmcli.cli.supervisor import announce
from mpmcli.errors import RunError

if TYPE_CHECKING:
    from mpmcli.error_bars.study import StudyPlan
    from mpmcli.scene import LoadedScene
    from mpmcli.simulation.summary import RunSummary


@click.command("simulate", epilog="Example: mpmcli simulate drop.toml -o results/drop --set time.end=2")
@click.argument("scene", type=SCENE)
@options.output_option("Directory of the result; results/<name of the scene> by default.", name="directory")
@options.set_option
@options.plugin_option
@options.arch_option("Where to compute")
@click.option("--threads", type=COUNT, help="CPU threads; by default one for each 2,500 particles.")
@click.option("--precision", type=click.Choice(["f32", "f64"]), help="Replaces solver.precision of the scene.")
@options.choice_option(
    "--format form", ["vtkhdf", "vtk"], "vtkhdf", "One temporal VTKHDF file; vtk: also a .vtu series with a .pvd."
)
@click.option("--compress", is_flag=True, help="Compress the stored file with gzip.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier result in the output directory.")
@click.option("--resume", is_flag=True, help="Continue the run in the output directory from its newest checkpoint.")
@click.option(
    "--checkpoint",
    "checkpoint_every",
    type=click.FloatRange(min=0),
    metavar="SECONDS",
    help="Wall time between two checkpoints; by default they take less than 1 % of it.",
)
@click.option(
    "--force", is_flag=True, help="Run although `mpmcli check` finds errors, and take time.step above the stable step."
)
@click.option("--error-bars", is_flag=True, help="Then compute it on two coarser grids: how wrong is it?")
@options.time_option("End the run, with the result packed, before this wall time: 2h, 90m, 45s, 1h30m or 1:30:00.")
@click.option(
    "--max-memory",
    type=options.size,
    metavar="SIZE",
    help="End the run before it uses more memory of this machine: 8GB, 500MB or 8GiB.",
)
@quiet_option
@json_option
def simulate_command(
    scene: Path, precision: str | None, quiet: bool, as_json: bool, error_bars: bool, **run: Any
) -> int:
    """Run SCENE and store its particles for ParaView, h5py and training code.

    SCENE is a TOML file, or the name of an example, which `mpmcli new` lists.
    """
    from mpmcli.cli.progress import SimulateProgress
    from mpmcli.materials.registry import load_plugins
    from mpmcli.output.directory import ERROR_BARS
    from mpmcli.scene import load_scene
    from mpmcli.simulation.settings import Limits
    from mpmcli.simulation.simulate import RunSettings, simulate

    overrides = run.pop("overrides")
    overrides += (f'solver.precision="{precision}"',) if precision else ()
    overrides += ("output.compress=true",) if run.pop("compress") else ()
    loaded = load_scene(scene, overrides, laws=load_plugins(run.pop("plugins")))
    limits = Limits(run.pop("max_time"), run.pop("max_memory"))
    run["directory"] = run["directory"] or Path("results") / scene.stem
    settings = RunSettings(**run, limits=limits, command=["mpmcli", *sys.argv[1:]])
    wants_bars = error_bars or loaded.scene.error_bars is not None
    plan = plan_for(loaded, settings.directory / ERROR_BARS, run) if wants_bars else None
    announce(settings.directory, loaded.inputs)
    progress = SimulateProgress(loaded.scene.time.end, loaded.scene.time.frames + 1, quiet=quiet)
    with progress, interrupts_wait():
        summary = simulate(loaded, settings, progress.start, progress.advance, interrupt_came)
    if summary.message:
        print_error(f"error: {summary.message}")
    if summary.status in ("interrupted", "stopped") and summary.frames:
        again = [word for word in sys.argv[1:] if word not in ("--overwrite", "--resume")]
        print_note(f"To go on: {shlex.join(['mpmcli', *again, '--resume'])}")
    if plan is None or summary.status != "finished":
        print_answer(summary, as_json, quiet=quiet)
        return {"finished": 0, "interrupted": interrupted_code()}.get(summary.status, 1)
    return _with_bars(loaded, summary, plan, as_json, quiet)


def _with_bars(loaded: "LoadedScene", summary: "RunSummary", plan: "StudyPlan", as_json: bool, quiet: bool) -> int:
    """Compute the error bars of a finished run, and print them after its summary."""
    from mpmcli.error_bars.report import as_dict, text
    from mpmcli.output import open_result

    if not as_json:
        print_answer(summary, as_json, quiet=quiet)
    try:
        study = study_result(loaded, open_result(summary.directory), plan, quiet=quiet)
    except KeyboardInterrupt:
        print_note(f"interrupted; the run and the siblings that are done are kept: mpmcli validate {summary.directory}")
        return interrupted_code()
    except RunError as error:
        print_error(f"error: {error}")
        if as_json:
            print_json({**summary.as_dict(), "error_bars": None})
        return 1
    if as_json:
        print_json({**summary.as_dict(), "error_bars": as_dict(study)})
    elif not quiet:
        print_text(text(study))
    return 0


@click.command("warm", epilog="Example: mpmcli warm drop.toml dam_break_2d")
@click.argument("scenes", type=SCENE, nargs=-1, required=True)
@options.arch_option("Where they will be computed")
@click.option("--threads", type=COUNT, help="CPU threads; by default as many as `mpmcli simulate` takes.")
@click.option("--jobs", type=COUNT, help="Number of processes; one per core by default.")
@json_option
def warm_command(scenes: tuple[Path, ...], arch: str, threads: int | None, jobs: int | None, as_json: bool) -> int:
    """Compile the kernels of SCENES, TOML files, so that their runs on this machine start without compilation.

    Use it after an installation, in CI jobs that keep the folder of compiled kernels, and on the nodes of a cluster.
    The exit code is 1 if a scene could not be compiled.
    """
    from mpmcli.cores import available_cores
    from mpmcli.materials.registry import parameter_models
    from mpmcli.scene import load_scene
    from mpmcli.simulation.engine import backend_for, warm

    for path in scenes:
        backend_for(load_scene(path, laws=parameter_models()).scene, arch, threads)
    found = []
    for one in warm(scenes, jobs or available_cores(), arch, threads, stop=interrupt_came):
        found.append(one)
        if not as_json:
            done = "was there" if one.stored else "compiled"
            print_text(f"{one.scene}: {one.fault or f'{done}, {one.seconds:.1f} s'}")
    if as_json:
        known = {str(one.scene): {"stored": one.stored, "seconds": one.seconds, "fault": one.fault} for one in found}
        print_json({"ok": not any(one.fault for one in found), "scenes": known})
    return 1 if any(one.fault for one in found) else 0
