"""What the phases of the steps of a `Solver` on the CPU take, by Taichi's profiler, which times each loop of a kernel.

A run of a batch has the same functions in one kernel, which no profiler divides.
"""

import re

import taichi as ti
from taichi.profiler.kernel_profiler import get_default_kernel_profiler

# Names of kernels and the phase they belong to; every other kernel measures or reads the state.
PHASE_OF = {
    "p2g": "p2g",
    "average": "volumes",
    "relax": "volumes",
    "update_and_g2p": "grid",
    **dict.fromkeys(("count_stable", "scan", "place_stable", "move", "share_work", "find_box"), "sort"),
}
PHASES = ("sort", "p2g", "grid", "g2p", "volumes", "measure")
# A record's name: kernel, specialisation, place of the loop, kind of loop.
_RECORD = re.compile(r"(?P<kernel>\w+?)_c\d+_\d+_kernel_(?P<loop>\d+)_(?P<kind>\w+)")


def profiles() -> bool:
    """Return whether Taichi was started with its profiler, so that each loop is a task of its own."""
    return ti.lang.impl.current_cfg().kernel_profiler


def take_phase_times(groups: int) -> dict[str, float]:
    """Return the time in each of PHASES since the last call, s.

    Args:
        groups: number of groups of particles, whose G2P are the last loops of their kernel.
    """
    profiler = get_default_kernel_profiler()
    records = [(record.name, 1e-3 * record.kernel_time) for record in _records(profiler)]
    ti.profiler.clear_kernel_profiler_info()
    return phase_times(records, groups)


def phase_times(records: list[tuple[str, float]], groups: int) -> dict[str, float]:
    """Return the time in each of PHASES, s.

    Args:
        records: name of a task in Taichi's form, like "p2g_c118_0_kernel_1_range_for", and its time, s.
        groups: see `take_phase_times`.
    """
    parsed = [(_RECORD.fullmatch(name), seconds) for name, seconds in records]
    loops = [int(found["loop"]) for found, _ in parsed if found and _is_update(found)]
    first_g2p = sorted(set(loops))[-groups:][0] if loops else 0
    times = dict.fromkeys(PHASES, 0.0)
    for found, seconds in parsed:
        phase = PHASE_OF.get(found["kernel"], "measure") if found else "measure"
        if found and found["kernel"] == "p2g" and found["loop"] == "0":
            # The first loop clears the grid.
            phase = "grid"
        elif found and _is_update(found) and int(found["loop"]) >= first_g2p:
            phase = "g2p"
        times[phase] += seconds
    return times


def _is_update(found: re.Match) -> bool:
    return found["kernel"] == "update_and_g2p" and found["kind"] == "range_for"


def _records(profiler: object) -> list:
    # The only way to the single records: what is public prints them.
    profiler._update_records()
    return profiler._traced_records
