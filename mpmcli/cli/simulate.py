"""`mpmcli simulate`."""

import sys
from pathlib import Path

import click

from mpmcli.cli.interrupt import interrupt_came, interrupted_code, interrupts_wait
from mpmcli.cli.limit_types import Duration, Size
from mpmcli.cli.options import json_option, plugin_option, quiet_option, set_option
from mpmcli.cli.streams import print_json, print_text
from mpmcli.cli.supervisor import announce


@click.command("simulate")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Where the result goes; results/<name of the scene> by default.",
)
@set_option
@plugin_option
@click.option(
    "--arch",
    type=click.Choice(["auto", "cpu", "cuda", "vulkan", "metal"]),
    default="auto",
    show_default=True,
    help="Where to compute; auto takes CUDA or Metal where they are, and else the CPU.",
)
@click.option("--threads", type=click.IntRange(min=1), help="CPU threads; by default one for each 2,500 particles.")
@click.option("--precision", type=click.Choice(["f32", "f64"]), help="Replaces solver.precision of the scene.")
@click.option(
    "--format",
    "form",
    type=click.Choice(["vtkhdf", "vtk"]),
    default="vtkhdf",
    show_default=True,
    help="One temporal VTKHDF file, or a .vtu series with a .pvd.",
)
@click.option("--compress", is_flag=True, help="Compress the stored file with gzip.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier result in the output directory.")
@click.option("--resume", is_flag=True, help="Go on with the run in the output directory, from its newest checkpoint.")
@click.option(
    "--checkpoint",
    "checkpoint_every",
    type=click.FloatRange(min=0),
    metavar="SECONDS",
    help="Wall time between two checkpoints; by default as often as takes less than 1 % of it.",
)
@click.option(
    "--force", is_flag=True, help="Run although `mpmcli check` finds errors, and take time.step above the stable step."
)
@click.option(
    "--max-time",
    type=Duration(),
    help="End the run, with the result packed, before this wall time: 2h, 90m, 45s, 1h30m or 1:30:00.",
)
@click.option(
    "--max-memory",
    type=Size(),
    help="End the run before it takes more memory of this machine: 8GB, 500MB or 8GiB.",
)
@quiet_option
@json_option
def command(
    scene: Path,
    output: Path | None,
    overrides: tuple[str, ...],
    plugins: tuple[Path, ...],
    arch: str,
    threads: int | None,
    precision: str | None,
    form: str,
    compress: bool,
    overwrite: bool,
    resume: bool,
    checkpoint_every: float | None,
    force: bool,
    max_time: float | None,
    max_memory: int | None,
    quiet: bool,
    as_json: bool,
) -> int:
    """Run SCENE, a TOML file, and store its particles for ParaView, h5py and learners."""
    from mpmcli.cli.simulate_progress import SimulateProgress
    from mpmcli.errors import InputError
    from mpmcli.materials.registry import load_plugins
    from mpmcli.scene import load_scene
    from mpmcli.simulation.limits import Limits
    from mpmcli.simulation.simulate import RunSettings, simulate

    if resume and overwrite:
        raise InputError("--resume keeps an earlier result, and --overwrite removes it: give one of them.")
    overrides += (f'solver.precision="{precision}"',) if precision else ()
    overrides += ("output.compress=true",) if compress else ()
    loaded = load_scene(scene, overrides, laws=load_plugins(plugins))
    settings = RunSettings(
        directory=output or Path("results") / scene.stem,
        arch=arch,
        threads=threads,
        form=form,
        overwrite=overwrite,
        resume=resume,
        checkpoint_every=checkpoint_every,
        force=force,
        limits=Limits(max_time, max_memory),
        command=["mpmcli", *sys.argv[1:]],
    )
    announce(settings.directory)
    progress = SimulateProgress(loaded.scene.time.end, loaded.scene.time.frames + 1, quiet=quiet)
    with progress, interrupts_wait():
        summary = simulate(loaded, settings, progress.start, progress.advance, interrupt_came)
    progress.close(summary)
    if as_json:
        print_json(summary.as_dict())
    elif not quiet:
        print_text(summary.text())
    return {"finished": 0, "interrupted": interrupted_code()}.get(summary.status, 1)
