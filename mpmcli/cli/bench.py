"""`mpmcli bench`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from mpmcli.cli.limit_types import Duration
from mpmcli.cli.options import json_option
from mpmcli.cli.streams import print_json, print_text
from mpmcli.errors import InputError

if TYPE_CHECKING:
    from mpmcli.bench.cases import BenchCase

# What --quick still takes.
QUICK_PARTICLES = 10_000
# Length of a block, s: of most tables, of --dataset, and of --device; and the wall time of --scaling, s.
SECONDS, DATASET_SECONDS, DEVICE_SECONDS, BUDGET = 2.0, 20.0, 0.05, 1200.0
# What has a table of its own.
TABLES = ("materials", "features", "dataset", "scaling", "profile", "device")


class ThreadCounts(click.ParamType):
    """Numbers of threads with commas between them, such as `1,2`."""

    name = "numbers"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        parts = [part.strip() for part in str(value).split(",")]
        if not all(part.isascii() and part.isdecimal() and 0 < int(part) < 10**6 for part in parts):
            self.fail(f"{value} is no number of threads; give 2, or 1,2 for each of both", param, ctx)
        return tuple(dict.fromkeys(int(part) for part in parts))


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
    budget: float | None
    largest: float | None

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

    def chosen(self, known: "tuple[BenchCase, ...]") -> "list[BenchCase]":
        """Return the cases that were asked for."""
        self.check_names([case.name for case in known])
        return [case for case in known if not self.names or case.name in self.names]

    def check_names(self, known: list[str]) -> None:
        """Refuse a --case that is not among these."""
        unknown = [name for name in self.names if name not in known]
        if unknown:
            raise InputError(f'there is no case "{unknown[0]}"; the cases are {", ".join(known)}.')


@click.command("bench")
@click.option("--materials", is_flag=True, help="Measure instead what each law costs, and mixes of two in one scene.")
@click.option("--dataset", is_flag=True, help="Measure instead how many trajectories an hour a sweep makes.")
@click.option("--features", is_flag=True, help="Measure instead what colliders, friction, emitters and the like cost.")
@click.option("--scaling", is_flag=True, help="Measure instead blocks of 1e4 to 1e7 particles.")
@click.option("--profile", is_flag=True, help="Measure instead what sort, P2G, grid and G2P take, for each law.")
@click.option("--device", is_flag=True, help="Measure instead what the device can do: copies, launches, atomics.")
@click.option(
    "--case", "names", multiple=True, metavar="NAME", help="Only this case, e.g. 3d-128; --scaling 3d. May be repeated."
)
@click.option("--quick", is_flag=True, help="Only the cases of up to 10,000 particles.")
@click.option(
    "--peers", is_flag=True, help="Every example of the taichi package that computes a fluid; with --scaling too."
)
@click.option(
    "--threads", type=ThreadCounts(), help="CPU threads, all of them by default; 1,2 measures with one and with two."
)
@click.option(
    "--arch", type=click.Choice(["cpu", "cuda", "vulkan", "metal"]), help="Device of the comparison, or of --device."
)
@click.option(
    "--seconds", type=click.FloatRange(min=0.01), help="Length of a block, by default 2; --dataset 20, --features 0.5."
)
@click.option(
    "--blocks", type=click.IntRange(min=1), help="Blocks of each side, by default 5; --dataset 2, --features 15."
)
@click.option(
    "--budget", type=Duration(), help="Time for --scaling, such as 20m, the default: larger sizes are left out."
)
@click.option("--largest", type=click.FloatRange(min=1e4), help="Most particles of --scaling, such as 1e6.")
@json_option
def command(as_json: bool, **options: Any) -> int:
    """Compare speed with the MPM examples that the taichi package ships.

    All sides run the same fluid block: equal particles, grid, step and precision, in turn (A B A B), and medians are
    printed: particle-steps per second, start-up and compile time, peak memory. Each may use all threads; mpmcli takes
    one for each 2,500 particles, as mpmcli simulate does. Where gcc is, a block in C, with vectors of four numbers,
    tells how far the limit of the processor is. With --threads 1,2 each case is measured with one thread and with two:
    speed-up and efficiency.

    With --materials, every law in turn takes the same column of particles, which lands, leans and collapses, through
    the same steps, on one thread unless --threads says more: time per particle and step, memory per particle, compile
    time.

    With --features, a pool of water runs in turn as it is and with one feature more, as a ball that moves in it, or
    friction: ratios of their times, on one thread and on two unless --threads says how many.

    With --dataset, a sweep of 1,444 particles of sand and 350 frames is computed and stored, by one worker and by one
    on each of --threads cores in turn: trajectories per hour, and their ratio to the generator of the GNS project.

    With --scaling, blocks of 1e4 to 1e7 particles: ns per particle and step beside those in C, and the exponent of the
    time in the number of particles, on one thread and on two.

    With --profile, each law: ns per particle and step of the sort, P2G, the grid, G2P, and measuring the state.

    With --device, what the device can do whatever runs on it: bandwidth, launches, scattered reads and additions.
    """
    asked = [name for name in TABLES if options.pop(name)]
    choice = Choice(table=asked[0] if asked else None, **options)
    if "dataset" in asked and (len(asked) > 1 or choice.names or choice.quick):
        raise InputError("--dataset has one scene and one table: leave out the other benchmarks, --case and --quick.")
    if len(asked) > 1:
        raise InputError(f"--{asked[0]} and --{asked[1]} make a table each: give one of them.")
    if choice.table != "scaling":
        choice.refuse("budget", "largest", why="Only --scaling has sizes of its own:")
    if choice.table not in (None, "device"):
        choice.refuse("arch", why=f"--{choice.table} runs on the CPU:")
    if choice.table not in (None, "scaling"):
        choice.refuse("peers", why=f"--{choice.table} has no peers:")
    report = _RUN[choice.table](choice)
    if as_json:
        print_json(report.as_dict())
    else:
        print_text(report.table())
    return 0


def _progress(line: str) -> None:
    click.echo(line, err=True)


def _yardstick() -> bool:
    """Return whether the yardstick can be measured; say so where it cannot."""
    from mpmcli.bench.yardstick import ABSENT, is_here

    if not is_here():
        _progress(f"note: {ABSENT}")
    return is_here()


def _comparison(choice: Choice) -> Any:
    import os

    from mpmcli.bench.cases import CASES
    from mpmcli.bench.compare import BLOCKS, run_bench

    cases = [case for case in choice.chosen(CASES) if not choice.quick or case.particles <= QUICK_PARTICLES]
    arch = choice.arch or "cpu"
    return run_bench(
        cases,
        choice.threads or (os.cpu_count() or 1,),
        choice.seconds or SECONDS,
        _progress,
        blocks=choice.blocks or BLOCKS,
        arch=arch,
        yardstick=arch == "cpu" and _yardstick(),
        peers=choice.peers,
    )


def _materials(choice: Choice) -> Any:
    from mpmcli.bench.compare import BLOCKS
    from mpmcli.bench.costs import run_costs
    from mpmcli.bench.materials import MATERIAL_CASES

    if choice.quick:
        raise InputError("--quick is about the comparison; with --materials, --case takes one size.")
    cases, seconds, blocks = choice.chosen(MATERIAL_CASES), choice.seconds or SECONDS, choice.blocks or BLOCKS
    return run_costs(cases, choice.one_count(1), seconds, _progress, blocks=blocks)


def _features(choice: Choice) -> Any:
    from mpmcli.bench.feature_costs import BLOCK, ROUNDS, run_features
    from mpmcli.bench.features import FEATURE_CASES

    if choice.quick:
        raise InputError("--features has one table: leave out --quick; --case takes one size.")
    cases, rounds = choice.chosen(FEATURE_CASES), choice.blocks or ROUNDS
    return run_features(cases, choice.threads or (1, 2), choice.seconds or BLOCK, _progress, rounds=rounds)


def _dataset(choice: Choice) -> Any:
    from mpmcli.bench.throughput import ROUNDS, run_throughput
    from mpmcli.cores import available_cores

    workers, seconds = choice.one_count(available_cores()), choice.seconds or DATASET_SECONDS
    return run_throughput(workers, seconds, _progress, rounds=choice.blocks or ROUNDS)


def _scaling(choice: Choice) -> Any:
    from mpmcli.bench.scaling import BLOCKS, COUNTS, run_scaling

    choice.refuse("quick", why="--scaling takes --largest:")
    choice.check_names(["2d", "3d"])
    return run_scaling(
        tuple(int(name[0]) for name in sorted(set(choice.names)) or ("2d", "3d")),
        choice.threads or (1, 2),
        choice.seconds or SECONDS,
        _progress,
        budget=choice.budget or BUDGET,
        counts=[count for count in COUNTS if count <= (choice.largest or COUNTS[-1])],
        blocks=choice.blocks or BLOCKS,
        yardstick=_yardstick(),
        peer=choice.peers,
    )


def _profile(choice: Choice) -> Any:
    from mpmcli.bench.compare import BLOCKS
    from mpmcli.bench.materials import MATERIAL_CASES
    from mpmcli.bench.profile import run_profile

    choice.refuse("quick", why="--profile takes --case:")
    return run_profile(
        choice.chosen(MATERIAL_CASES),
        choice.one_count(1),
        choice.seconds or SECONDS,
        _progress,
        blocks=choice.blocks or BLOCKS,
        yardstick=_yardstick(),
    )


def _device(choice: Choice) -> Any:
    from mpmcli.bench.device import DeviceReport, measure_device
    from mpmcli.solver.backend import start_backend

    choice.refuse("case", "quick", "blocks", why="--device has one table:")
    backend = start_backend(choice.arch or "auto", choice.one_count(0) or None)
    return DeviceReport(measure_device(backend, choice.seconds or DEVICE_SECONDS))


_RUN = {
    None: _comparison,
    "materials": _materials,
    "features": _features,
    "dataset": _dataset,
    "scaling": _scaling,
    "profile": _profile,
    "device": _device,
}
