"""`mpmcli bench`."""

import click

from mpmcli.cli.json_output import print_json
from mpmcli.cli.options import json_option, threads_option

# What --quick still takes.
QUICK_PARTICLES = 10_000


@click.command("bench")
@click.option("--case", "names", multiple=True, metavar="NAME", help="Only this case, e.g. 3d-128. May be repeated.")
@click.option("--quick", is_flag=True, help="Only the cases of up to 10,000 particles.")
@threads_option
@click.option("--seconds", type=click.FloatRange(min=0.1), default=2.0, show_default=True, help="Length of a block.")
@click.option("--blocks", type=click.IntRange(min=1), default=5, show_default=True, help="Blocks of each side.")
@json_option
def command(
    names: tuple[str, ...], quick: bool, threads: int | None, seconds: float, blocks: int, as_json: bool
) -> int:
    """Compare speed with the MPM examples that the taichi package ships.

    Both sides run the same fluid block: equal particles, grid, precision and threads, in turn (A B A B),
    and medians are printed: particle-steps per second, start-up and compile time, peak memory.
    """
    import os

    from mpmcli.bench.cases import CASES
    from mpmcli.bench.compare import run_bench
    from mpmcli.errors import InputError

    unknown = [name for name in names if name not in {case.name for case in CASES}]
    if unknown:
        known = ", ".join(case.name for case in CASES)
        raise InputError(f'there is no case "{unknown[0]}"; the cases are {known}.')
    cases = [case for case in CASES if not names or case.name in names]
    if quick:
        cases = [case for case in cases if case.particles <= QUICK_PARTICLES]
    report = run_bench(
        cases=cases,
        threads=threads or os.cpu_count() or 1,
        seconds=seconds,
        blocks=blocks,
        progress=lambda line: click.echo(line, err=True),
    )
    click.echo(report.table(), err=True)
    if as_json:
        print_json(report.as_dict())
    return 0
