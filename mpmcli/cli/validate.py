"""`mpmcli validate`."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mpmcli.cli.interrupt import interrupt_came, interrupted_code, interrupts_wait
from mpmcli.cli.options import COUNT, choice_option, json_option, output_option, quiet_option
from mpmcli.cli.streams import print_json, print_text
from mpmcli.errors import InputError

if TYPE_CHECKING:
    from mpmcli.validation.case import Case, Level
    from mpmcli.validation.report import Report
    from mpmcli.validation.study import Journal


@click.command("validate", epilog="Example: mpmcli validate couette --levels coarse")
@click.argument("names", nargs=-1, metavar="[CASE]...")
@choice_option(
    "--levels level",
    ["coarse", "default", "fine"],
    "default",
    "Resolutions, and what is varied: coarse takes minutes, default up to an hour, fine more.",
)
@output_option("Where report.md, its figures and the results go; without it nothing is written.")
@click.option("--workers", type=COUNT, help="Runs at a time, one thread each; as many as cores by default.")
@click.option(
    "--timeout", type=click.FloatRange(min=1.0), default=1800.0, show_default=True, help="Seconds that a run may take."
)
@click.option("--resume", is_flag=True, help="Go on in the output directory: runs that still hold are not done again.")
@click.option("--overwrite", is_flag=True, help="Replace the report and all runs in the output directory.")
@click.option("--list", "listing", is_flag=True, help="List the cases and run nothing.")
@click.option("--write-scene", is_flag=True, help="Print the scene of a case as TOML and run nothing.")
@click.option("--resolution", type=COUNT, metavar="N", help="Of --write-scene; the coarsest by default.")
@quiet_option
@json_option
def validate_command(
    names: tuple[str, ...], level: "Level", output: Path | None, quiet: bool, as_json: bool, **asked: Any
) -> int:
    """Measure speed against error on problems with known answers.

    Each CASE, all of them by default, is run at several resolutions and with several settings, each in a process of
    its own, and judged. A name may be short: bar means every case whose name begins with bar_.

    Exit code 1 where a case is out of tolerance.
    """
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
        _write_scene(cases, names, level, resolution)
        return 0
    from mpmcli.cores import available_cores
    from mpmcli.validation.report import write_report
    from mpmcli.validation.study import Journal

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


def _study(
    cases: Sequence["Case"], level: "Level", workers: int, timeout: float, journal: "Journal | None", quiet: bool
) -> "Report":
    """Run what the journal does not have, and return the report; KeyboardInterrupt where it was interrupted."""
    from mpmcli.bench.report import describe_machine
    from mpmcli.cli.progress import ValidateProgress
    from mpmcli.validation.report import Report
    from mpmcli.validation.runs import matrix
    from mpmcli.validation.study import carry_out_all

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
    from mpmcli.scene.problem import listed, nearest
    from mpmcli.validation.cases import all_cases

    known = all_cases()
    chosen = set()
    for name in names:
        meant = [name] if name in known else [case for case in known if case.startswith(f"{name}_")]
        if not meant:
            guess = nearest(name, [*known, *dict.fromkeys(case.partition("_")[0] for case in known)])
            hint = f'did you mean "{guess}"?' if guess else f"there are {listed(list(known), 'and')}."
            raise InputError(f'there is no case "{name}"; {hint}')
        chosen.update(meant)
    return [case for name, case in known.items() if not names or name in chosen]


def _list(cases: Sequence["Case"], level: "Level", as_json: bool) -> None:
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


def _write_scene(cases: Sequence["Case"], names: Sequence[str], level: "Level", resolution: int | None) -> None:
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
