"""What a step is, and what a run does between two frames:

    let the sheets of emitters enter that are due         emission
    sort the particles if they have drifted               particles.sort
    choose the step                                       step_size.StepSize.begin
    carry out its phases, see `step_phases`               cpu_phases.CpuPhases, gpu_launch.GpuPhases
    count it: time, drift, bounds on the next one         step_size.StepSize.end
    show the particles at an output time                  frames.reader
    measure the state, where its bounds may have changed  step_size.StepControl

`cpu_launch.CpuLaunch.lead` does this inside one launch, until its host is needed; `gpu_launch.GpuLaunch.step` takes
steps, and its host does the rest between launches. `run.Run` launches, and yields frames.

The body of a phase is a function of one node or particle, `Phase.body`, or the method of its name: of `CpuPhases`, for
a part of the nodes or particles, and of `GpuPhases`, for one of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from mpmcli.boundaries.rigid_bodies import ROUNDS
from mpmcli.materials.law import Law
from mpmcli.quick_taichi import ti
from mpmcli.solver.transfer import redistribution as by


@dataclass(frozen=True)
class Phase:
    """A loop of a step; the next one begins when it is done.

    Those that shift come before all others, in the steps that relax volumes.

    Attributes:
        name: of its body.
        over: what it runs over: the nodes in use, those on the planes of faces, their rows, the particles of a group,
            all rows of nodes for each collider, threads that work at nodes, or runs, whose bodies move.
        group: number of the group of particles.
        adds: whether particles add to nodes. Without atomics pencils of one colour after another do.
        turns: how often it runs, with `turn` counting up from 0.
        body: of one node or particle, on any device, where the executors have no method of its name: body(at, node,
            kick), or in a shift body(at, node or particle, time over which volumes relax); ranged: of a range of
            particles on the CPU.
        shifts: whether it shifts particles.
    """

    name: str
    over: Literal["nodes", "planes", "rows", "particles", "loads", "threads", "bodies"]
    group: int = 0
    adds: bool = False
    turns: int = 1
    body: Callable | None = None
    ranged: Callable | None = None
    shifts: bool = False


def step_phases(
    laws: Sequence[Law],
    uses_f_bar: Sequence[bool],
    *,
    contact: bool,
    friction: bool,
    deterministic: bool = False,
    loads: bool = False,
    shifts: int = 0,
    separates: bool = False,
    serial: bool = True,
    rigid: bool = False,
) -> tuple[Phase, ...]:
    """Return the phases of a step; neighbours of one name that add nothing to nodes may be carried out at once.

    uses_f_bar: whether the particles of each law share their change of volume; contact, friction: whether walls let go,
    or rub; deterministic: whether P2G is in fixed point; loads: whether there are colliders, too; shifts: the
    dimension where particles are shifted, else 0; separates: whether bodies meet by their surfaces; serial: whether
    one thread lists what these show, on a CPU; rigid: whether colliders move freely. To meet them takes two turns a
    round: over nodes, and over the bodies.
    """
    groups = range(len(laws))
    return (
        *(shift_phases(laws, shifts, deterministic=deterministic) if shifts else ()),
        Phase("clear", "nodes"),
        *(Phase("average", "particles", g, adds=True) for g in groups if uses_f_bar[g]),
        *(Phase("scatter", "particles", g, adds=True) for g in groups),
        *[Phase("to_float", "nodes")] * deterministic,
        *(Phase("relax", "particles", g) for g in groups if laws[g].relaxes),
        *[Phase("find_bodies", "nodes")] * separates,
        *(Phase("show_surface", "particles", g) for g in groups if separates and laws[g].elastic),
        *[Phase("link_surfaces", "particles")] * (separates and serial),
        *[Phase("reserve", "nodes")] * (separates and not serial),
        *(Phase("put", "particles", g) for g in groups if separates and not serial and laws[g].elastic),
        *[Phase("chain", "nodes")] * (separates and not serial),
        *[Phase("exchange", "threads")] * separates,
        *[Phase("find_contact", "planes")] * contact,
        *[Phase("find_friction", "planes")] * friction,
        *[Phase("meet", "rows", turns=2 * ROUNDS)] * rigid,
        Phase("update", "nodes"),
        *[Phase("add_loads", "loads")] * loads,
        *[Phase("move_bodies", "bodies")] * rigid,
        *(Phase("advance", "particles", g) for g in groups),
    )


def shift_phases(laws: Sequence[Law], dimension: int, *, deterministic: bool) -> tuple[Phase, ...]:
    """Return the phases that shift particles, of laws that have it."""
    groups = range(len(laws))
    flowing = [g for g in groups if laws[g].shifts]
    phases = (
        Phase("clear_fine", "nodes", body=by.clear_fine),
        *(Phase("fill_fine", "particles", g, True, 1, by.fill_fine, by.fill_range) for g in groups),
        *[Phase("fine_to_float", "nodes", body=by.fine_to_float)] * deterministic,
        Phase("fold_fine", "nodes", turns=dimension, body=by.fold_fine),
        *(Phase("shift", "particles", g, True, 1, by.shift, by.shift_range) for g in flowing),
        *[Phase("shift_to_float", "nodes", body=by.shift_to_float)] * deterministic,
        Phase("fold_shift", "nodes", turns=dimension, body=by.fold_shift),
        *(Phase("unshift", "particles", g, False, 1, by.unshift, by.unshift_range) for g in flowing),
    )
    return tuple(replace(phase, shifts=True) for phase in phases)


def sorted_fields(groups: Sequence) -> tuple[tuple[ti.Field, ...], ...]:
    """Return the fields of each group that a sort moves with a particle."""
    return tuple((*group.state, *group.labels) for group in groups)
