"""`mpmcli bench`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from mpmcli.cli.options import COUNT, json_option, thread_counts
from mpmcli.cli.streams import print_json, print_text
from mpmcli.errors import InputError

if TYPE_CHECKING:
    from mpmcli.bench.cases import BenchCase
    from mpmcli.bench.side import BenchOptions

# What --quick still takes.
QUICK_PARTICLES = 10_000
# Length of a block, s: of most tables, and of --dataset.
SECONDS, DATASET_SECONDS = 2.0, 20.0
# What a table makes: its record for JSON, and what writes that as text.
Outcome = tuple[dict, Callable[[dict], str]]
# What has a table of its own.
TABLES = ("dataset", "profile")


@dataclass(frozen=True)
class Choice:
    """What the options say; None where an option was not given."""

    table: str | None
    names: tuple[str, ...]
    quick: bool
    peers: bool
    threads: tuple[int, ...] | None
    arch: str | None
    seconds: float | None
    blocks: int | None

    def refuse(self, *options: str, why: str) -> None:
        """Raise InputError if one of these options was given."""
        for option in options:
            given = getattr(self, {"case": "names"}.get(option, option))
            if given not in (None, False, ()):
                raise InputError(f"{why} leave out --{option}.")

    def one_count(self, default: int) -> int:
        """Return the number of threads of a table that has one."""
        if self.threads and len(self.threads) > 1:
            raise InputError(f"--{self.table} takes one number of threads: give --threads {self.threads[0]}.")
        return self.threads[0] if self.threads else default

    def options(
        self, threads: tuple[int, ...], seconds: float = SECONDS, blocks: int | None = None, **others: Any
    ) -> "BenchOptions":
        """Return the options of a table, with its defaults where none were given."""
        from mpmcli.bench.side import BLOCKS, BenchOptions

        times = {"seconds": self.seconds or seconds, "blocks": self.blocks or blocks or BLOCKS}
        return BenchOptions(self.threads or threads, progress=_progress, **times, **others)

    def chosen(self, known: "tuple[BenchCase, ...]") -> "list[BenchCase]":
        """Return the cases that were asked for; InputError: one is not among them."""
        names = [case.name for case in known]
        if unknown := [name for name in self.names if name not in names]:
            raise InputError(f'there is no case "{unknown[0]}"; the cases are {", ".join(names)}.')
        return [case for case in known if not self.names or case.name in self.names]


@click.command("bench")
@click.option("--dataset", is_flag=True, help="Measure instead how many trajectories an hour a sweep makes.")
@click.option("--profile", is_flag=True, help="Measure instead what sort, P2G, grid and G2P take, for each law.")
@click.option("--case", "names", multiple=True, metavar="NAME", help="Only this case, e.g. 3d-128. May be repeated.")
@click.option("--quick", is_flag=True, help="Only the cases of up to 10,000 particles.")
@click.option("--peers", is_flag=True, help="Every example of the taichi package that computes a fluid.")
@click.option(
    "--threads",
    type=thread_counts,
    metavar="NUMBERS",
    help="CPU threads, all of them by default; 1,2 measures with one and with two.",
)
@click.option("--arch", type=click.Choice(["cpu", "cuda", "vulkan", "metal"]), help="Device of the comparison.")
@click.option("--seconds", type=click.FloatRange(min=0.01), help="Length of a block, by default 2; --dataset 20.")
@click.option("--blocks", type=COUNT, help="Blocks of each side, by default 5; --dataset 2.")
@json_option
def bench_command(as_json: bool, **options: Any) -> int:
    """Compare speed with the MPM examples that the taichi package ships.

    All sides run the same fluid block: equal particles, grid, step and precision, in turn (A B A B), and medians are
    printed: particle-steps per second, start-up and compile time, peak memory. Each may use all threads; mpmcli takes
    one for each 2,500 particles, as mpmcli simulate does. Where gcc is, a block in C, with vectors of four numbers,
    tells how far the limit of the processor is. With --threads 1,2 each case is measured with one thread and with two:
    speed-up and efficiency.

    With --dataset, a sweep of 1,444 particles of sand and 350 frames is computed and stored, by one worker and by one
    on each of --threads cores in turn: trajectories per hour, and their ratio to the generator of the GNS project.

    With --profile, each law: ns per particle and step of the sort, P2G, the grid, G2P, and measuring the state.
    """
    asked = [name for name in TABLES if options.pop(name)]
    choice = Choice(table=asked[0] if asked else None, **options)
    if "dataset" in asked and (len(asked) > 1 or choice.names or choice.quick):
        raise InputError("--dataset has one scene and one table: leave out the other benchmarks, --case and --quick.")
    if choice.table:
        choice.refuse("arch", why=f"--{choice.table} runs on the CPU:")
        choice.refuse("peers", why=f"--{choice.table} has no peers:")
    record, table = _RUN[choice.table](choice)
    if as_json:
        print_json(record)
    else:
        print_text(table(record))
    return 0


def _progress(line: str) -> None:
    click.echo(line, err=True)


def _yardstick() -> bool:
    """Return whether the yardstick can be measured; say so where it cannot."""
    from mpmcli.bench.peers import ABSENT, is_here

    if not is_here():
        _progress(f"note: {ABSENT}")
    return is_here()


def _comparison(choice: Choice) -> Outcome:
    import os

    from mpmcli.bench.cases import CASES
    from mpmcli.bench.compare import bench_table, run_bench

    cases = [case for case in choice.chosen(CASES) if not choice.quick or case.particles <= QUICK_PARTICLES]
    arch = choice.arch or "cpu"
    yardstick = arch == "cpu" and _yardstick()
    threads = choice.threads or (os.cpu_count() or 1,)
    options = choice.options(threads, arch=arch, yardstick=yardstick, peers=choice.peers)
    return run_bench(cases, options), bench_table


def _dataset(choice: Choice) -> Outcome:
    from mpmcli.bench.throughput import ROUNDS, run_throughput, throughput_table
    from mpmcli.cores import available_cores

    options = choice.options((choice.one_count(available_cores()),), DATASET_SECONDS, ROUNDS)
    return run_throughput(options), throughput_table


def _profile(choice: Choice) -> Outcome:
    from mpmcli.bench.column import COLUMN_CASES
    from mpmcli.bench.profile import profile_table, run_profile

    choice.refuse("quick", why="--profile takes --case:")
    cases, threads = choice.chosen(COLUMN_CASES), (choice.one_count(1),)
    return run_profile(cases, choice.options(threads, yardstick=_yardstick())), profile_table


_RUN = {
    None: _comparison,
    "dataset": _dataset,
    "profile": _profile,
}
