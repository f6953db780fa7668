"""The step on a GPU: one kernel, whose scatter adds atomically, in fixed point or not, and which reads nothing back."""

from collections.abc import Callable, Sequence

import taichi as ti

from mpmcli.boundaries.wall_friction import find_friction
from mpmcli.solver.forces import Gravity
from mpmcli.solver.grid import Grid
from mpmcli.solver.nodes import NodeUpdate
from mpmcli.solver.particle_update import ParticleUpdate
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.volume_average import add_volume


def build_gpu_step(
    grid: Grid, nodes: NodeUpdate, particles: ParticleUpdate, groups: Sequence[ParticleGroup], gravity: Gravity
) -> Callable[[float, float, float], None]:
    """Build the kernel of a step (dt, kick, relaxed) for these groups and nothing else."""
    numbered = tuple(enumerate(groups))

    @ti.kernel
    def step(dt: float, kick: float, relaxed: float):
        for q in range(grid.box_nodes()):
            grid.clear(grid.linear_index(grid.box_node(q)))
        for g, group in ti.static(numbered):
            if ti.static(group.averaged):
                for p in range(group.present()):
                    add_volume(grid, g, group, p)
        for g, group in ti.static(numbered):
            for p in range(group.present()):
                particles.scatter(g, group, p, kick, relaxed)
        if ti.static(grid.deterministic):
            for q in range(grid.box_nodes()):
                grid.fixed.settle(grid, grid.linear_index(grid.box_node(q)), relaxed)
        for g, group in ti.static(numbered):
            if ti.static(group.law.relaxes):
                for p in range(group.present()):
                    if relaxed > 0.0:
                        particles.relax(group, p, relaxed)
        if ti.static(nodes.needs_contact):
            for q in range(nodes.images.plane_nodes(grid)):
                nodes.images.find_contact(grid, q, gravity.in_step(kick, 0))
        if ti.static(nodes.needs_friction):
            for q in range(nodes.images.plane_nodes(grid)):
                find_friction(nodes.images, grid, q, gravity.in_step(kick, 0))
        for q in range(grid.box_nodes()):
            node = grid.box_node(q)
            nodes.update(node, grid.linear_index(node), gravity.in_step(kick, 0))
        if ti.static(grid.deterministic and nodes.collides):
            for q in range(nodes.colliders.rows * nodes.colliders.room):
                nodes.colliders.book_row(q)
        for g, group in ti.static(numbered):
            for p in range(group.present()):
                particles.advance(g, group, p, dt)

    return step
