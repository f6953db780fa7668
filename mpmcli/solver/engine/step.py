"""The phases of a step, and the sequence of operations between two frames:

    let due sheets of emitters enter                      emission
    sort the particles if they have drifted               particles.sort
    choose the step                                       step_size.StepSize.begin
    carry out its phases, see `step_phases`               cpu_phases.CpuPhases, gpu_launch.GpuPhases
    update time, drift and bounds on the next step        step_size.StepSize.end
    write the particles at an output time                 frames.reader
    measure the state if its bounds may have changed      step_size.StepControl

`cpu_launch.CpuLaunch.advance_run` does this inside one launch until the host is needed. `gpu_launch.GpuLaunch.step`
takes steps, and the host does the rest between launches. `run.Run` starts launches and yields frames.

A phase is its functions, see `feature.Phase`, or the methods with its name: that of `GpuPhases` processes one item, as
a node or a particle, that of `CpuPhases` a part of all items.
"""

from collections.abc import Iterable, Sequence

from mpmcli.boundaries.feature import STAGES, Feature, Phase
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import ParticleArrays
from mpmcli.solver.transfer import redistribution as by
from mpmcli.solver.transfer.advance import advance_of
from mpmcli.solver.transfer.easing import ease_phases
from mpmcli.solver.transfer.node_update import NodeUpdate
from mpmcli.solver.transfer.particle_update import ParticleUpdate
from mpmcli.solver.transfer.scatter import scatter_of
from mpmcli.solver.transfer.volume import AVERAGE, RELAX


def step_phases(
    arrays: Sequence[ParticleArrays],
    nodes: NodeUpdate,
    particles: ParticleUpdate,
    features: Iterable[Feature],
    *,
    pressed: bool,
    serial: bool,
) -> tuple[Phase, ...]:
    """Return the phases of a step; consecutive ones with the same name that do not add to nodes may run concurrently.

    Args:
        arrays: the particles of each law.
        nodes, particles: the updates of nodes and of particles.
        features: the features of the runs, whose phases follow those of the engine in each stage.
        pressed: whether walls find what presses on them at nodes.
        serial: see `Feature.phases`.
    """
    grid, groups = nodes.grid, tuple(enumerate(arrays))
    keeps, update = grid.scheme.keeps_flip_velocity, "update grid with colliders" if nodes.collides else "update grid"
    own = (
        *(shift_phases(arrays, grid) if grid.fine else ()),
        *(ease_phases(arrays, grid) if any(group.eased for group in arrays) else ()),
        *scatter_phases(arrays, grid, repels=particles.repels),
        *[Phase("find_contact", "planes", "walls", words="find contact")] * (pressed and nodes.needs_contact),
        *[Phase("find_friction", "planes", "walls", words="find friction")] * nodes.needs_friction,
        Phase("update", "nodes", "update", words=update),
        *(
            Phase(
                "advance", "particles", "gather", g, body=advance_of(group, keeps=keeps), most="rate", words="gather {}"
            )
            for g, group in groups
        ),
    )
    more = (phase for feature in features for phase in feature.phases(serial=serial))
    return tuple(sorted((*own, *more), key=lambda phase: STAGES.index(phase.stage)))


def scatter_phases(arrays: Sequence[ParticleArrays], grid: Grid, *, repels: bool) -> tuple[Phase, ...]:
    """Return the phases of P2G, and those that relax volumes by its sums."""
    groups, keeps = tuple(enumerate(arrays)), grid.scheme.keeps_flip_velocity
    adds = {"over": "particles", "stage": "scatter", "adds": True}
    forces = "scatter {}", "scatter {} with forces"
    return (
        Phase("clear", "nodes", "scatter", words="clear grid"),
        *(
            Phase("average", group=g, body=AVERAGE, relaxes=not group.uses_f_bar, words="average volumes of {}", **adds)
            for g, group in groups
            if group.averages
        ),
        *(
            Phase("scatter", group=g, body=body, time="kick", words=forces[group.has_body_force], **adds)
            for g, group in groups
            for body in (scatter_of(group, keeps=keeps, repels=repels),)
        ),
        *[Phase("to_float", "nodes", "scatter", words="read sums in fixed point")] * grid.deterministic,
        *(
            Phase("relax", "particles", "relax", g, body=RELAX, time="relaxed", relaxes=True, most="volume_change")
            for g, group in groups
            if group.law.relaxes or group.levels
        ),
    )


def shift_phases(arrays: Sequence[ParticleArrays], grid: Grid) -> tuple[Phase, ...]:
    """Return the phases that shift the particles of laws with `Law.shifts`."""
    groups, deterministic = range(len(arrays)), grid.deterministic
    flowing = [g for g in groups if arrays[g].law.shifts]
    folds = {"turns": grid.dimension}
    return (
        Phase("clear_fine", "nodes", "shift", body=by.clear_fine),
        *(Phase("fill_fine", "particles", "shift", g, True, body=by.fill_fine) for g in groups),
        *[Phase("fine_to_float", "nodes", "shift", body=by.fine_to_float)] * deterministic,
        Phase("fold_fine", "nodes", "shift", **folds, body=by.fold_fine),
        *(Phase("shift", "particles", "shift", g, True, body=by.SHIFT) for g in flowing),
        *[Phase("shift_to_float", "nodes", "shift", body=by.shift_to_float)] * deterministic,
        Phase("fold_shift", "nodes", "shift", **folds, body=by.fold_shift),
        *(Phase("unshift", "particles", "shift", g, body=by.UNSHIFT) for g in flowing),
    )
