"""`mpmcli bench`."""

import os
from functools import partial

import click

from mpmcli.cli.options import COUNT, json_option, thread_counts
from mpmcli.cli.streams import print_json, print_text
from mpmcli.errors import InputError


@click.command("bench", epilog="Example: mpmcli bench --case 2d-64 --threads 1")
@click.option("--dataset", is_flag=True, help="Measure instead how many trajectories an hour a sweep makes.")
@click.option("--profile", is_flag=True, help="Measure instead what sort, P2G, grid and G2P take, for each law.")
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

    All sides run the same fluid block: equal particles, grid, step and precision, in turn (A B A B), and medians are
    printed: particle-steps per second, start-up and compile time. Each may use all threads; mpmcli takes one for each
    2,500 particles, as mpmcli simulate does. Where gcc is, a block in C, with vectors of four numbers, tells how far
    the limit of the processor is.

    With --dataset, a sweep of 1,444 particles of sand and 350 frames is computed and stored, by one worker and by one
    on each of --threads cores in turn: trajectories per hour, and their ratio to the generator of the GNS project.

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

        cases = _chosen(COLUMNS, names)
        record, table = run_profile(cases, (threads or [1])[0], seconds or 2.0, blocks or 5, tell), profile_table
    else:
        from mpmcli.bench.cases import CASES
        from mpmcli.bench.compare import bench_table, run_bench

        cases = _chosen(CASES, names)
        record, table = run_bench(cases, threads or [count], arch, seconds or 2.0, blocks or 5, tell), bench_table
    if as_json:
        print_json(record)
    else:
        print_text(table(record))
    return 0


def _chosen(known: tuple, names: tuple[str, ...]) -> list:
    """Return the cases that were asked for; InputError: one is not among them."""
    there = [case.name for case in known]
    if unknown := [name for name in names if name not in there]:
        raise InputError(f'there is no case "{unknown[0]}"; the cases are {", ".join(there)}.')
    return [case for case in known if not names or case.name in names]
