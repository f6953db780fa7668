"""`mpmcli bench`."""

from typing import TYPE_CHECKING

import click

from mpmcli.cli.options import json_option, threads_option
from mpmcli.cli.streams import print_json, print_text

if TYPE_CHECKING:
    from mpmcli.bench.cases import BenchCase

# What --quick still takes.
QUICK_PARTICLES = 10_000
# Length of a block, s, and of one with --dataset.
SECONDS, DATASET_SECONDS = 2.0, 20.0


@click.command("bench")
@click.option("--materials", is_flag=True, help="Measure instead what each law costs, and mixes of two in one scene.")
@click.option("--dataset", is_flag=True, help="Measure instead how many trajectories an hour a sweep makes.")
@click.option("--features", is_flag=True, help="Measure instead what colliders, friction, emitters and the like cost.")
@click.option("--case", "names", multiple=True, metavar="NAME", help="Only this case, e.g. 3d-128. May be repeated.")
@click.option("--quick", is_flag=True, help="Only the cases of up to 10,000 particles.")
@threads_option
@click.option(
    "--seconds", type=click.FloatRange(min=0.1), help="Length of a block, by default 2; --dataset 20, --features 0.5."
)
@click.option(
    "--blocks", type=click.IntRange(min=1), help="Blocks of each side, by default 5; --dataset 2, --features 15."
)
@json_option
def command(
    materials: bool,
    dataset: bool,
    features: bool,
    names: tuple[str, ...],
    quick: bool,
    threads: int | None,
    seconds: float | None,
    blocks: int | None,
    as_json: bool,
) -> int:
    """Compare speed with the MPM examples that the taichi package ships.

    Both sides run the same fluid block: equal particles, grid, step and precision, in turn (A B A B), and medians
    are printed: particle-steps per second, start-up and compile time, peak memory. Both may use all threads; mpmcli
    takes one for each 2,500 particles, as mpmcli simulate does.

    With --materials, every law in turn takes the same column of particles, which lands, leans and
    collapses, through the same steps, on one thread unless --threads says more: time per particle and
    step, memory per particle, compile time.

    With --features, a pool of water runs in turn as it is and with one feature more, as a ball that
    moves in it, or friction: ratios of their times, on one thread and on two unless --threads says
    how many.

    With --dataset, a sweep of 1,444 particles of sand and 350 frames is computed and stored, by one worker and by one
    on each of --threads cores in turn: trajectories per hour, and their ratio to the generator of the GNS project.
    """
    import os

    from mpmcli.bench.compare import BLOCKS
    from mpmcli.cores import available_cores
    from mpmcli.errors import InputError

    def chosen(known: tuple["BenchCase", ...]) -> list["BenchCase"]:
        unknown = [name for name in names if name not in {case.name for case in known}]
        if unknown:
            raise InputError(
                f'there is no case "{unknown[0]}"; the cases are {", ".join(case.name for case in known)}.'
            )
        return [case for case in known if not names or case.name in names]

    def progress(line: str) -> None:
        click.echo(line, err=True)

    if dataset:
        from mpmcli.bench.throughput import ROUNDS, run_throughput

        if materials or features or names or quick:
            raise InputError(
                "--dataset has one scene and one table: leave out the other benchmarks, --case and --quick."
            )
        report = run_throughput(
            threads or available_cores(), seconds or DATASET_SECONDS, progress, rounds=blocks or ROUNDS
        )
    elif features:
        from mpmcli.bench.feature_costs import BLOCK, ROUNDS, run_features
        from mpmcli.bench.features import FEATURE_CASES

        if materials or quick:
            raise InputError("--features has one table: leave out --materials and --quick; --case takes one size.")
        report = run_features(
            chosen(FEATURE_CASES),
            (threads,) if threads else (1, 2),
            seconds or BLOCK,
            progress,
            rounds=blocks or ROUNDS,
        )
    elif materials:
        from mpmcli.bench.costs import run_costs
        from mpmcli.bench.materials import MATERIAL_CASES

        if quick:
            raise InputError("--quick is about the comparison; with --materials, --case takes one size.")
        report = run_costs(chosen(MATERIAL_CASES), threads or 1, seconds or SECONDS, progress, blocks=blocks or BLOCKS)
    else:
        from mpmcli.bench.cases import CASES
        from mpmcli.bench.compare import run_bench

        cases = [case for case in chosen(CASES) if not quick or case.particles <= QUICK_PARTICLES]
        report = run_bench(cases, threads or os.cpu_count() or 1, seconds or SECONDS, progress, blocks=blocks or BLOCKS)
    if as_json:
        print_json(report.as_dict())
    else:
        print_text(report.table())
    return 0
