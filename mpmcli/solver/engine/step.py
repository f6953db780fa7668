"""The phases of a step, and the sequence of operations between two frames:

    let due sheets of emitters enter                      emission
    sort the particles if they have drifted               particles.sort
    choose the step                                       step_size.StepSize.begin
    carry out its phases, see `step_phases`               cpu_phases.CpuPhases, gpu_launch.GpuPhases
    update time, drift and bounds on the next step        step_size.StepSize.end
    show the particles at an output time                  frames.reader
    measure the state if its bounds may have changed      step_size.StepControl

`cpu_launch.CpuLaunch.advance_run` does this inside one launch until the host is needed. `gpu_launch.GpuLaunch.step`
takes steps, and the host does the rest between launches. `run.Run` starts launches and yields frames.

The body of a phase is `Phase.body`, a function of one node or particle, or else the method with the name of the phase.
The method of `GpuPhases` processes one item, such as a node or a particle; that of `CpuPhases` a part of all items.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from mpmcli.boundaries.rigid_bodies import ROUNDS
from mpmcli.quick_taichi import ti
from mpmcli.solver.contact import collider_points as touch
from mpmcli.solver.contact.body_contact import BodyContact
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.transfer import redistribution as by
from mpmcli.solver.transfer.node_update import NodeUpdate


@dataclass(frozen=True)
class Phase:
    """A loop of a step; the next phase starts when it is finished.

    In steps that relax volumes, the phases that shift particles come first; other steps omit them.

    Attributes:
        name: name of the phase and of its body.
        over: the items of the loop: nodes in use ("nodes"), nodes on the planes of faces ("planes"), rows of nodes
            ("rows"), the particles of a group ("particles"), rows of nodes per collider ("loads"), threads that process
            nodes ("threads"), or runs with moving bodies ("bodies").
        group: index of the group of particles.
        adds: whether particles add to nodes; without atomics this is done colour by colour of pencils.
        turns: number of repetitions, with `turn` counting from 0.
        body: function of one node or particle on any device, for phases without a method: body(at, node, kick), or in a
            shift body(at, node or particle, time over which volumes relax).
        ranged: the same for a range of particles on the CPU.
        wanted: function of the first node of a row on a dense grid on the CPU, which returns whether the row has work:
            wanted(at, node). Such phases have work in layer 0 alone.
        shifts: whether the phase belongs to the shift of particles.
    """

    name: str
    over: Literal["nodes", "planes", "rows", "particles", "loads", "threads", "bodies"]
    group: int = 0
    adds: bool = False
    turns: int = 1
    body: Callable | None = None
    ranged: Callable | None = None
    wanted: Callable | None = None
    shifts: bool = False


def step_phases(
    arrays: Sequence[ParticleArrays], nodes: NodeUpdate, contact: BodyContact | None, *, serial: bool
) -> tuple[Phase, ...]:
    """Return the phases of a step; consecutive ones with the same name that do not add to nodes may run concurrently.

    The phase "meet" takes two turns per round: over points, and over rigid bodies.

    Args:
        arrays: the particles of each law.
        nodes: the update of nodes.
        contact: contact of bodies with velocity fields of their own, or None.
        serial: whether one thread lists surface particles, as on a CPU.
    """
    groups, grid = tuple(enumerate(arrays)), nodes.grid
    rigid, points, separates = nodes.couples, nodes.touches, contact is not None
    leaves = nodes.needs_contact and (contact is None or contact.surfaces.shares)
    return (
        *(shift_phases(arrays, grid) if grid.fine else ()),
        Phase("clear", "nodes"),
        *(Phase("average", "particles", g, adds=True) for g, group in groups if group.averages),
        *(Phase("scatter", "particles", g, adds=True) for g, _ in groups),
        *[Phase("to_float", "nodes")] * grid.deterministic,
        *[Phase("fill_solids", "nodes", body=touch.fill_solids, wanted=touch.near_row)]
        * (points and any(group.law.relaxes for _, group in groups)),
        *(Phase("relax", "particles", g) for g, group in groups if group.law.relaxes or group.levels),
        *[Phase("find_bodies", "nodes")] * separates,
        *(Phase("show_surface", "particles", g) for g, group in groups if group.surfaced),
        *[Phase("link_surfaces", "particles")] * (separates and serial),
        *[Phase("reserve", "nodes")] * (separates and not serial),
        *(Phase("put", "particles", g) for g, group in groups if group.surfaced and not serial),
        *[Phase("chain", "nodes")] * (separates and not serial),
        *[Phase("exchange", "threads")] * separates,
        *[Phase("find_contact", "planes")] * leaves,
        *[Phase("find_friction", "planes")] * nodes.needs_friction,
        Phase("update", "nodes"),
        *[Phase("find_points", "nodes", body=touch.find_points, wanted=touch.new_row)] * points,
        *[Phase("spread_points", "nodes", body=touch.spread_points, wanted=touch.marked_row)] * points,
        *[Phase("weigh_points", "nodes", body=touch.weigh_points, wanted=touch.busy_row)] * points,
        *[Phase("meet", "rows", turns=2 * ROUNDS, body=touch.meet_points, wanted=touch.busy_row)] * rigid,
        *[Phase("settle_points", "nodes", body=touch.settle_points, wanted=touch.busy_row)] * rigid,
        *[Phase("push_points", "nodes", body=touch.push_points, wanted=touch.last_row)] * points,
        # Sums in fixed point leave the loads on colliders to a phase of their own.
        *[Phase("add_loads", "loads")] * (grid.deterministic and nodes.collides),
        *[Phase("move_bodies", "bodies")] * rigid,
        *(Phase("advance", "particles", g) for g, _ in groups),
    )


def shift_phases(arrays: Sequence[ParticleArrays], grid: Grid) -> tuple[Phase, ...]:
    """Return the phases that shift the particles of laws with `Law.shifts`."""
    groups, dimension, deterministic = range(len(arrays)), grid.dimension, grid.deterministic
    flowing = [g for g in groups if arrays[g].law.shifts]
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
    """Return the fields of each group that the sort moves."""
    return tuple((*group.state, *group.labels) for group in groups)
