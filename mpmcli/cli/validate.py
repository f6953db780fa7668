"""`mpmcli validate` and `mpmcli bench`."""

import os
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mpmcli.cli.error_bars import BAR_OPTIONS, bar_options, study_path
from mpmcli.cli.interrupt import interrupt_came, interrupted_code, interrupts_wait
from mpmcli.cli.options import (
    COUNT,
    choice_option,
    json_option,
    output_option,
    plugin_option,
    quiet_option,
    set_option,
    thread_counts,
)
from mpmcli.cli.streams import print_json, print_text
from mpmcli.errors import InputError

if TYPE_CHECKING:
    from mpmcli.validation.case import Case, Level
    from mpmcli.validation.report import Report
    from mpmcli.validation.runs import Journal


@click.command("validate", epilog="Example: mpmcli validate couette --levels coarse")
@click.argument("names", nargs=-1, metavar="[CASE|SCENE]...")
@choice_option(
    "--levels level",
    ["coarse", "default", "fine"],
    "default",
    "Resolutions and settings: coarse takes minutes, default up to an hour, fine more.",
)
@bar_options
@set_option
@plugin_option
@output_option("Directory of report.md, its figures and the results; without it nothing is written.")
@click.option("--workers", type=COUNT, help="Number of parallel runs, one thread each; one per core by default.")
@click.option(
    "--timeout", type=click.FloatRange(min=1.0), default=1800.0, show_default=True, help="Seconds that a run may take."
)
@click.option("--resume", is_flag=True, help="Continue in the output directory: valid runs are not repeated.")
@click.option("--overwrite", is_flag=True, help="Replace the report and all runs in the output directory.")
@click.option("--list", "listing", is_flag=True, help="List the cases and run nothing.")
@click.option("--write-scene", is_flag=True, help="Print the scene of a case as TOML and run nothing.")
@click.option("--resolution", type=COUNT, metavar="N", help="Resolution of --write-scene; the coarsest by default.")
@quiet_option
@json_option
def validate_command(
    names: tuple[str, ...], level: "Level", output: Path | None, quiet: bool, as_json: bool, **asked: Any
) -> int:
    """Measure speed against error on problems with known answers, or the error of any scene.

    Each CASE, all of them by default, is run at several resolutions and with several settings, each run in a separate
    process, and compared with its tolerances. A name may be short: bar means every case whose name begins with bar_.
    The exit code is 1 if a case is out of tolerance.

    A SCENE is a TOML file, an example, or a result. It is computed again on two coarser grids and compared, and each
    of its observables gets an error bar. For a result the report is written beside it.
    """
    if (scene := _scene_of(names)) is not None:
        for name, default in (("workers", None), ("timeout", 1800.0), ("listing", False), ("write_scene", False)):
            if asked[name] != default:
                option = {"listing": "list"}.get(name, name.replace("_", "-"))
                raise InputError(f"--{option} is for cases, and {scene} is a scene; leave it out.")
        if level != "default":
            raise InputError(f"--levels is for cases; --level grids, step or all chooses the siblings of {scene}.")
        return study_path(scene, output, {**asked, "quiet": quiet, "as_json": as_json})
    for name in (*BAR_OPTIONS, "overrides", "plugins"):
        if asked.pop(name):
            option = {"bar_level": "level", "overrides": "set", "plugins": "plugin"}.get(name, name)
            raise InputError(f"--{option} is for a scene: name one, such as drop.toml, in place of cases.")
    resume, overwrite, resolution = asked["resume"], asked["overwrite"], asked["resolution"]
    if resolution is not None and not asked["write_scene"]:
        raise InputError("--resolution is for --write-scene; --levels chooses the resolutions of a report.")
    if (resume or overwrite) and output is None:
        raise InputError("--resume and --overwrite are about an earlier report: name its directory with -o.")
    if resume and overwrite:
        raise InputError("--resume keeps what is there and --overwrite removes it; give one of them.")
    if asked["listing"] and asked["write_scene"]:
        raise InputError("--list lists the cases and --write-scene prints the scene of one; give one of them.")
    cases = _chosen(names)
    if asked["listing"]:
        _list(cases, level, as_json)
        return 0
    if asked["write_scene"]:
        from mpmcli.scene import scene_to_toml
        from mpmcli.validation.case import Setting
        from mpmcli.validation.runs import scene_of

        if not names:
            raise InputError("--write-scene prints the scene of one case; name it.")
        case = cases[0]
        if len(cases) > 1:
            others = ", ".join(other.name for other in cases[1:])
            click.echo(f"this is the scene of {case.name}; others are those of {others}", err=True)
        print_text(scene_to_toml(scene_of(case, resolution or min(case.levels[level]), Setting())).rstrip("\n"))
        return 0
    from mpmcli.cores import available_cores
    from mpmcli.validation.report import write_report
    from mpmcli.validation.runs import Journal

    workers = asked["workers"] or available_cores()
    journal = None if output is None else Journal(output, resume=resume, overwrite=overwrite)
    try:
        report = _study(cases, level, workers, asked["timeout"], journal, quiet)
    except KeyboardInterrupt:
        if output is None:
            raise
        click.echo(f"interrupted; the runs that are done are kept: --resume -o {output} goes on", err=True)
        return interrupted_code()
    if output is not None:
        write_report(report, output)
    if as_json:
        print_json(report.as_dict())
    elif not quiet:
        print_text(report.text())
        if output is not None:
            print_text(f"report: {output / 'report.md'}")
    return 0 if report.passed else 1


def _scene_of(names: Sequence[str]) -> Path | None:
    """Return the path of a scene or a result, None if cases are named; InputError: there are several."""
    from mpmcli.scene.examples import examples
    from mpmcli.validation.cases import all_cases

    known = all_cases()
    found = []
    for name in names:
        if name in known or any(case.startswith(f"{name}_") for case in known):
            continue
        path = Path(name)
        if path.suffix or path.exists():
            found.append(path)
        elif name in examples():
            found.append(examples()[name])
    if found and len(names) > 1:
        raise InputError(f"error bars are those of one scene: give {found[0]} alone.")
    return found[0] if found else None


def _study(
    cases: Sequence["Case"], level: "Level", workers: int, timeout: float, journal: "Journal | None", quiet: bool
) -> "Report":
    """Run the cases that the journal lacks, and return the report; KeyboardInterrupt: interrupted."""
    from mpmcli.bench.report import describe_machine
    from mpmcli.cli.progress import ValidateProgress
    from mpmcli.validation.report import Report
    from mpmcli.validation.runs import carry_out_all, matrix

    environment = {**describe_machine(), "workers": workers, "date": datetime.now(UTC).date().isoformat()}
    runs = matrix(cases, level)
    kept = {} if journal is None else {run: result for run in runs if (result := journal.find(run)) is not None}
    left = [run for run in runs if run not in kept]
    with ValidateProgress(cases, len(runs), len(kept), workers, quiet=quiet) as progress, interrupts_wait():
        for run, result in carry_out_all(left, workers, timeout, interrupt_came):
            kept[run] = result
            if journal is not None:
                journal.keep(run, result)
            progress.advance(run, result, len(kept))
    return Report(level, environment, cases, {run: kept[run] for run in runs})


def _chosen(names: Sequence[str]) -> list["Case"]:
    """Return the cases of these names and families, or all. Raises InputError for an unknown one."""
    from mpmcli.scene.problem import hint_at, listed
    from mpmcli.validation.cases import all_cases

    known = all_cases()
    chosen = set()
    for name in names:
        meant = [name] if name in known else [case for case in known if case.startswith(f"{name}_")]
        if not meant:
            words = [*known, *dict.fromkeys(case.partition("_")[0] for case in known)]
            hint = hint_at(name, words, f"there are {listed(list(known), 'and')}.")
            raise InputError(f'there is no case "{name}"; {hint}')
        chosen.update(meant)
    return [case for name, case in known.items() if not names or name in chosen]


def _list(cases: Sequence["Case"], level: "Level", as_json: bool) -> None:
    """Print the cases with their resolutions and numbers of runs at a level."""
    from mpmcli.plain_text import text_table
    from mpmcli.validation.runs import runs_of

    facts = [
        {
            "case": case.name,
            **{name: getattr(case, name) for name in ("title", "group", "source", "resolution")},
            "resolutions": sorted(case.levels[level]),
            "runs": len(runs_of(case, level)),
        }
        for case in cases
    ]
    if as_json:
        print_json(facts)
        return
    head = ("case", "problem", f"n at level {level}", "runs", "n counts")
    rows = [
        (f["case"], f["title"], ", ".join(map(str, f["resolutions"])), str(f["runs"]), f["resolution"]) for f in facts
    ]
    print_text(text_table(head, rows, left={0, 1, 2, 4}))


@click.command("bench", epilog="Example: mpmcli bench --case 2d-64 --threads 1")
@click.option("--dataset", is_flag=True, help="Measure the trajectories per hour of a sweep instead.")
@click.option("--profile", is_flag=True, help="Measure the times of sort, P2G, grid and G2P for each law instead.")
@click.option("--case", "names", multiple=True, metavar="NAME", help="Only this case, e.g. 3d-128. May be repeated.")
@click.option(
    "--threads", type=thread_counts, metavar="NUMBERS", help="CPU threads: 2, or in turn 1,2; by default all."
)
@click.option("--arch", type=click.Choice(["cpu", "cuda", "vulkan", "metal"]), default="cpu", help="Device.")
@click.option("--seconds", type=click.FloatRange(min=0.01), help="Length of a block, by default 2; --dataset 20.")
@click.option("--blocks", type=COUNT, help="Blocks of each side, by default 5; --dataset 2.")
@json_option
def bench_command(
    dataset: bool,
    profile: bool,
    names: tuple[str, ...],
    threads: tuple[int, ...] | None,
    arch: str,
    seconds: float | None,
    blocks: int | None,
    as_json: bool,
) -> int:
    """Compare speed with the MPM examples that the taichi package ships.

    All programs run the same fluid block, with equal particles, grid, step and precision, in alternation (A B A B).
    Medians are printed of particle-steps per second, start-up and compile time. Each may use all threads; mpmcli uses
    one for each 2,500 particles, as mpmcli simulate does. If gcc is installed, a block in C, with vectors of four
    numbers, shows the distance from the limit of the processor.

    With --dataset, a sweep of 1,444 particles of sand and 350 frames is computed and stored, by one worker and by one
    per core on --threads cores, in turn: trajectories per hour, and their ratio to the generator of the GNS project.

    With --profile, each law: ns per particle and step of the sort, P2G, the grid, G2P, and measuring the state.
    """
    if (dataset or profile) and arch != "cpu":
        raise InputError(f"--dataset and --profile run on the CPU: leave out --arch {arch}.")
    if (dataset or profile) and threads and len(threads) > 1:
        raise InputError(f"--dataset and --profile take one number of threads: give --threads {threads[0]}.")
    if dataset and (profile or names):
        raise InputError("--dataset has one scene and one table: leave out --profile and --case.")
    tell = partial(click.echo, err=True)
    count = os.cpu_count() or 1
    if dataset:
        from mpmcli.bench.throughput import run_throughput, throughput_table

        record, table = run_throughput((threads or [count])[0], seconds or 20.0, blocks or 2, tell), throughput_table
    elif profile:
        from mpmcli.bench.ours import COLUMNS
        from mpmcli.bench.profile import profile_table, run_profile

        cases = _named(COLUMNS, names)
        record, table = run_profile(cases, (threads or [1])[0], seconds or 2.0, blocks or 5, tell), profile_table
    else:
        from mpmcli.bench.cases import CASES
        from mpmcli.bench.compare import bench_table, run_bench

        cases = _named(CASES, names)
        record, table = run_bench(cases, threads or [count], arch, seconds or 2.0, blocks or 5, tell), bench_table
    if as_json:
        print_json(record)
    else:
        print_text(table(record))
    return 0


def _named(known: tuple, names: tuple[str, ...]) -> list:
    """Return the requested cases; InputError: one does not exist."""
    there = [case.name for case in known]
    if unknown := [name for name in names if name not in there]:
        raise InputError(f'there is no case "{unknown[0]}"; the cases are {", ".join(there)}.')
    return [case for case in known if not names or case.name in names]
