"""Error bars on the command line: of a run by `simulate --error-bars`, of a scene or a result by `validate`."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mpmcli.cli import options
from mpmcli.cli.interrupt import interrupt_came, interrupted_code, interrupts_wait
from mpmcli.cli.streams import print_json, print_note, print_text
from mpmcli.errors import InputError
from mpmcli.plain_text import counted, duration_text

if TYPE_CHECKING:
    from mpmcli.error_bars.study import Study, StudyPlan
    from mpmcli.output.result import Result
    from mpmcli.scene import LoadedScene

BAR_OPTIONS = ("bar_level", "budget", "only", "skip", "confidence", "observe", "target")


def bar_options(command: Callable) -> Callable:
    """Add the options of error bars to a command."""
    level = "Siblings: grids are coarser ones, 0.7 runs; step adds half a step, 3.7; all placement and samples, 9."
    mean = "Also the mean over the particles of an expression of x, y, z, vx, vy, vz and t. May be repeated."
    for option in (
        click.option(
            "--level", "bar_level", type=click.Choice(["grids", "step", "all"]), help=f"{level}  [default: grids]"
        ),
        click.option("--budget", type=options.duration, metavar="TIME", help="Take the level that fits: 10m, 2h."),
        click.option(
            "--only", multiple=True, metavar="CAUSE", help="Only grid, model, rounding, step, placement, sample."
        ),
        click.option("--skip", multiple=True, metavar="CAUSE", help="Leave out such a cause. May be repeated."),
        click.option("--confidence", type=click.Choice(["90", "95"]), help="Percent, of the bars.  [default: 90]"),
        click.option("--observe", multiple=True, metavar="NAME=EXPRESSION", help=mean),
        click.option("--target", metavar="NAME:PERCENT%", help="Print the spacing that keeps it, such as front:2%."),
    ):
        command = option(command)
    return command


def plan_for(loaded: "LoadedScene", directory: Path | None, asked: dict[str, Any]) -> "StudyPlan":
    """Return the plan by the options and the table error_bars of a scene; InputError: they cannot be used."""
    from mpmcli.error_bars.observables import read_observed
    from mpmcli.error_bars.siblings import CAUSES
    from mpmcli.error_bars.study import StudyPlan, chosen_causes
    from mpmcli.scene.schema import ErrorBars

    table = loaded.scene.error_bars or ErrorBars()
    for name in ("only", "skip"):
        for unknown in (cause for cause in asked.get(name, ()) if cause not in CAUSES):
            raise InputError(f'--{name}: there is no cause "{unknown}"; there are {", ".join(CAUSES)}.')
    if asked.get("budget") and (asked.get("bar_level") or asked.get("only") or asked.get("skip")):
        raise InputError("--budget chooses the level: give it without --level, --only and --skip.")
    causes = chosen_causes(asked.get("bar_level") or table.level, asked.get("only", ()), asked.get("skip", ()))
    stated = [f"{name}={text}" for name, text in table.observe.items()]
    observed = read_observed(stated, loaded.scene, f"{loaded.source}: error_bars.observe:")
    observed |= read_observed(asked.get("observe", ()), loaded.scene)
    device = {"arch": asked.get("arch", "auto"), "threads": asked.get("threads")}
    return StudyPlan(causes, int(asked.get("confidence") or table.confidence), observed, directory, **device)


def within_budget(plan: "StudyPlan", dimension: int, seconds: float, runs: float, budget: float) -> "StudyPlan":
    """Return the plan with the level that fits a budget, s, if a run takes some seconds, of which `runs` are needed."""
    from dataclasses import replace

    from mpmcli.error_bars.siblings import LEVELS

    plans = [replace(plan, causes=causes) for causes in LEVELS.values()]
    needed = [seconds * (runs + each.cost(dimension)) for each in plans]
    fits = [each for each, need in zip(plans, needed, strict=True) if need <= budget]
    if not fits:
        raise InputError(
            f"--budget {duration_text(budget)} allows nothing: two coarser grids need about "
            f"{duration_text(needed[0])}, and the run takes {duration_text(seconds)} of that."
            if runs
            else f"--budget {duration_text(budget)} allows nothing: two coarser grids need {duration_text(needed[0])}."
        )
    return fits[-1]


def study_result(loaded: "LoadedScene", result: "Result", plan: "StudyPlan", *, quiet: bool) -> "Study":
    """Compute the siblings of a finished result, and write the report beside it."""
    from mpmcli.error_bars.report import write
    from mpmcli.error_bars.study import Student

    record = result.record or {}
    seconds = float(record.get("timings", {}).get("solve_s", 0.0))
    student = Student(loaded, plan, [body.chosen for body in result.header.bodies])
    base = student.base_of(result, seconds, int(record.get("steps", 0)))
    _tell_cost(plan, loaded, seconds, quiet=quiet)
    with interrupts_wait():
        study = student.study(base, lambda *facts: _tell(*facts, quiet=quiet), interrupt_came)
    write(study, plan.directory)
    return study


def study_path(path: Path, output: Path | None, asked: dict[str, Any]) -> int:
    """Compute the error bars of a scene, or of a result, and print them; see `mpmcli validate`."""
    from mpmcli.error_bars.report import as_dict, target_of, target_text, text

    target = None if asked["target"] is None else target_of(asked["target"])
    try:
        study, output = _study_of(path, output, asked)
    except KeyboardInterrupt:
        if output is None and path.suffix == ".toml":
            raise
        print_note("interrupted; the runs that are done are kept, and the same command with --resume goes on")
        return interrupted_code()
    advice = None if target is None else target_text(study, *target)
    if asked["as_json"]:
        print_json(as_dict(study) | ({} if advice is None else {"target": advice}))
    elif not asked["quiet"]:
        told = [text(study), advice, output and f"report: {output / 'report.md'}"]
        print_text("\n".join(str(each) for each in told if each))
    return 0


def _study_of(path: Path, output: Path | None, asked: dict[str, Any]) -> tuple["Study", Path | None]:
    """Run the siblings of a scene or of a finished result; return the study, and where it is written."""
    from mpmcli.check.finding import passes
    from mpmcli.check.scene_check import check_scene
    from mpmcli.error_bars.report import write
    from mpmcli.error_bars.study import Student
    from mpmcli.materials.registry import load_plugins
    from mpmcli.output.directory import ERROR_BARS, SCENE, check_directory
    from mpmcli.output.result import open_result
    from mpmcli.scene import load_scene
    from mpmcli.simulation.simulate import refusal

    quiet, laws, overrides = asked["quiet"], load_plugins(asked["plugins"]), asked["overrides"]
    if path.suffix == ".toml":
        loaded = load_scene(path, overrides, laws=laws)
        if output is not None:
            check_directory(output, asked["overwrite"], resume=asked["resume"])
        plan = plan_for(loaded, output, asked)
        check = check_scene(loaded)
        if not passes(check.findings):
            raise InputError(refusal(str(path), check.findings, forced=False))
        seconds = check.forecast.seconds or 0.0
        if asked["budget"]:
            plan = within_budget(plan, loaded.scene.dimension, seconds, 1.0, asked["budget"])
        _tell_cost(plan, loaded, seconds, quiet=quiet)
        student = Student(loaded, plan)
        with interrupts_wait():
            base = student.base(interrupt_came)
            study = student.study(base, lambda *facts: _tell(*facts, quiet=quiet), interrupt_came)
        if output is not None:
            write(study, output)
    else:
        result = open_result(path)
        if overrides:
            raise InputError(f"--set changes scenes, and {path} is not one; leave it out.")
        if result.status != "finished":
            raise InputError(f'{path} is of a run that is "{result.status}": error bars need all its frames.')
        original = (result.record or {}).get("scene", "")
        loaded = load_scene(result.directory / SCENE, laws=laws, original=original)
        output = output or result.directory / ERROR_BARS
        plan = plan_for(loaded, output, asked)
        if asked["budget"]:
            seconds = float((result.record or {}).get("timings", {}).get("solve_s", 0.0))
            plan = within_budget(plan, loaded.scene.dimension, seconds, 0.0, asked["budget"])
        study = study_result(loaded, result, plan, quiet=quiet)
    return study, output


def _tell_cost(plan: "StudyPlan", loaded: "LoadedScene", seconds: float, *, quiet: bool) -> None:
    cost = plan.cost(loaded.scene.dimension)
    if not quiet:
        causes = ", ".join(plan.causes)
        about = f", about {duration_text(cost * seconds)}" if seconds else ""
        print_note(f"error bars: siblings for {causes}, {cost:.2g} times the time of the run{about}")


def _tell(name: str, number: int, count: int, *, quiet: bool) -> None:
    if not quiet:
        print_note(f"error bars: {number + 1} of {counted(count, 'sibling')}: {name}")
