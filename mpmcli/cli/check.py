"""`mpmcli check`."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from mpmcli.cli.options import json_option, plugin_option, set_option, threads_option
from mpmcli.cli.streams import print_json, print_text

if TYPE_CHECKING:
    from mpmcli.check.result_check import ResultCheck
    from mpmcli.check.scene_check import SceneCheck


@click.command("check")
@click.argument("path", type=click.Path(path_type=Path))
@set_option
@plugin_option
@click.option("--no-probe", is_flag=True, help="Skip the run of two seconds that measures the time of a step.")
@click.option("--strict", is_flag=True, help="Treat warnings as errors.")
@threads_option
@json_option
def command(
    path: Path,
    overrides: tuple[str, ...],
    plugins: tuple[Path, ...],
    no_probe: bool,
    strict: bool,
    threads: int | None,
    as_json: bool,
) -> int:
    """Check a scene (PATH.toml): the stable step and its cause, likely faults, and the cost of the run.

    Or check whether a result is stable and complete: its directory, particles.vtkhdf or particles.pvd. Nothing is
    written. The exit code is 1 if there is an error, or with --strict a warning.
    """
    if path.suffix == ".toml":
        check = _of_scene(path, overrides, plugins, threads, probing=not no_probe)
    else:
        check = _of_result(
            path, {"--set": overrides, "--plugin": plugins, "--no-probe": no_probe, "--threads": threads}
        )
    if as_json:
        print_json({**check.as_dict(), "ok": check.passes(strict=strict)})
    else:
        print_text(check.text())
    return 0 if check.passes(strict=strict) else 1


def _of_scene(
    path: Path, overrides: tuple[str, ...], plugins: tuple[Path, ...], threads: int | None, *, probing: bool
) -> "SceneCheck":
    from mpmcli.check.probe import probe_scene
    from mpmcli.check.scene_check import check_scene
    from mpmcli.cores import available_cores
    from mpmcli.materials.registry import load_plugins
    from mpmcli.scene import load_scene
    from mpmcli.solver.backend import Backend
    from mpmcli.solver.plan import make_plan

    loaded = load_scene(path, overrides, laws=load_plugins(plugins))
    backend = Backend("cpu", threads or available_cores(), loaded.scene.solver.precision, compile_cache=True)
    check = check_scene(loaded, plan=make_plan(loaded.scene, backend))
    # A scene that does not fit into memory is not run.
    if probing and not any(finding.rule == "memory" for finding in check.findings):
        probe, plan = probe_scene(loaded, check.forecast.steps, threads=threads)
        check = check_scene(loaded, plan=plan, probe=probe)
    return check


def _of_result(path: Path, scene_only: dict[str, object]) -> "ResultCheck":
    from mpmcli.errors import InputError

    given = [option for option, value in scene_only.items() if value]
    if given:
        raise InputError(f"{given[0]} is for scenes, and {path} is none; leave it out.")
    from mpmcli.check.result_check import check_result

    return check_result(path)
