"""Process of one contestant, controlled by commands on stdin, one per line.

    python -m mpmcli.bench.contestant ours|solid|deterministic|peer|mpm128|yardstick|profile:LAW
        --dimension 3 --cells 128 --particles 524288 --step 8e-5 [--threads 2] [--precision f32] [--arch cpu]

It answers on stdout, one JSON object per line, and waits for commands on stdin without using the processor:

    (start)        {"particles": 524288, "bytes_per_particle": 88 or null, "threads": 2}     ready to step
    first          {"seconds": 2.9}                                            one step, kernels compiled
    skip STEPS     {}                                                          takes steps that are not measured
    run SECONDS    {"steps": 31, "seconds": 1.02, "processor_seconds": 1.01}   steps for about that long
    phases         {"p2g": 0.4, "g2p": 0.5}                                    time in each since the last such command
    finish         {"sound": true, "smallest_step": 8e-5, "peak_memory": 219152384}    and ends

With "profile:" before the name of a law, the contestant is the column of `mpmcli.bench.column`, which answers to
`phases`, as the yardstick does.

A failure is answered by {"error": "a sentence"} and ends the process with status 1.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol, get_type_hints

from mpmcli.bench.cases import BLOCKS, BenchCase
from mpmcli.errors import MpmcliError
from mpmcli.processes.questions import answering


class Contestant(Protocol):
    """A simulation that can be measured; only columns and the yardstick have phases."""

    particles: int
    bytes_per_particle: int | None
    threads: int
    smallest_step: float

    def advance(self, count: int) -> int:
        """Take about `count` time steps and return how many; may return before the device is done."""

    def sync(self) -> None:
        """Wait until every requested step is done."""

    def is_sound(self) -> bool:
        """Whether every particle is in the domain."""

    def phases(self) -> dict[str, float]:
        """Return the time in each phase of a step since the last call, s."""


def run_block(contestant: Contestant, seconds: float) -> tuple[int, float]:
    """Step for about `seconds` and return (steps, seconds taken), device included."""
    steps, chunk, elapsed = 0, 1, 0.0
    start = time.perf_counter()
    while elapsed < seconds:
        steps += contestant.advance(chunk)
        contestant.sync()
        elapsed = time.perf_counter() - start
        # Few waits for the device, and no overshoot: grow until what is left limits the next chunk.
        left = int(steps / elapsed * (seconds - elapsed)) + 1
        chunk = max(1, min(2 * chunk, left))
    return steps, elapsed


def peak_memory() -> int:
    """Return the largest resident memory that this process has had, in bytes."""
    status = Path("/proc/self/status")
    if status.exists():
        # Not getrusage: on Linux its maximum includes that of the parent which started this process.
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024
    import psutil

    memory = psutil.Process().memory_info()
    if hasattr(memory, "peak_wset"):
        return memory.peak_wset
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # macOS: bytes


def serve(start: Callable[[], Contestant], commands: Iterable[str], answer: Callable[..., None]) -> int:
    """Start a contestant and obey the commands until `finish` or their end; return the exit status."""
    try:
        contestant = start()
        answer(**{name: getattr(contestant, name) for name in ("particles", "bytes_per_particle", "threads")})
        for command in commands:
            match command.split():
                case ["first"]:
                    begin = time.perf_counter()
                    contestant.advance(1)
                    contestant.sync()
                    answer(seconds=time.perf_counter() - begin)
                case ["run", seconds]:
                    busy = time.process_time()
                    steps, elapsed = run_block(contestant, float(seconds))
                    answer(steps=steps, seconds=elapsed, processor_seconds=time.process_time() - busy)
                case ["skip", steps]:
                    contestant.advance(int(steps))
                    contestant.sync()
                    answer()
                case ["phases"]:
                    answer(**contestant.phases())
                case ["finish"]:
                    end = {"sound": contestant.is_sound(), "smallest_step": contestant.smallest_step}
                    answer(**end, peak_memory=peak_memory())
                    break
    except MpmcliError as error:
        answer(error=str(error))
        return 1
    return 0


def _contestant(who: str, case: BenchCase, **options: str | int) -> Contestant:
    if who in ("peer", "yardstick", *case.other_peers):
        from mpmcli.bench.peers import Peer, block_in_c

        if who == "yardstick":
            return block_in_c(case, **options)
        return Peer(case, None if who == "peer" else who, **options)
    if who in BLOCKS:
        from mpmcli.bench.ours import falling_block

        return falling_block(case, who, **options)
    from mpmcli.bench.profile import PROFILE, ProfiledColumn

    return ProfiledColumn(who.removeprefix(PROFILE), case, **options)


def main() -> int:
    """Run one contestant."""
    parser = argparse.ArgumentParser(prog="python -m mpmcli.bench.contestant")
    parser.add_argument("who", help="see above")
    for name, kind in get_type_hints(BenchCase).items():
        parser.add_argument(f"--{name}", type=kind, required=True)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--precision", choices=["f32", "f64"], default="f32")
    parser.add_argument("--arch", default="cpu")
    options = vars(parser.parse_args())
    who, case = options.pop("who"), BenchCase(*(options.pop(name) for name in get_type_hints(BenchCase)))
    with answering() as answer:
        return serve(lambda: _contestant(who, case, **options), sys.stdin, answer)


if __name__ == "__main__":
    sys.exit(main())
