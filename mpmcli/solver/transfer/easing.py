"""Reduces the stress of particles that share nodes with few others, so that they do not limit the step.

A unit pressure in all particles opens particle p at the rate h_p times that of a lone particle: 0 in bulk, 1/4 at a
flat surface, 1/2 at a corner, 1 alone. Its stress is multiplied by phi(h_p), 1 in bulk and 1 / `Law.relief` alone,
which the steps that shift particles measure (docs/theory.md, 6.1). The functions below are the bodies of phases, like
those of `redistribution`.
"""

from collections.abc import Sequence

from mpmcli.boundaries.feature import Phase
from mpmcli.quick_taichi import ti
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.particles.arrays import MASS, ParticleArrays
from mpmcli.solver.transfer.redistribution import add_shift, fold_shift, shift_to_float
from mpmcli.solver.transfer.stencils import gather_linear
from mpmcli.stability.transfer_factors import EASED_FROM, EASED_TO


def ease_phases(arrays: Sequence[ParticleArrays], grid: Grid) -> tuple[Phase, ...]:
    """Return the phases that measure phi of the particles of laws with `Law.eases`."""
    eased = [g for g, group in enumerate(arrays) if group.eased]
    # Bodies in layers of their own share no nodes with them, nor do bodies on the grid of the state at rest.
    near = eased if grid.layers > 1 else [g for g, group in enumerate(arrays) if not group.total]
    return (
        Phase("clear_opening", "nodes", "shift", body=clear_opening),
        *(Phase("open_up", "particles", "shift", g, True, body=open_up) for g in near),
        *[Phase("opening_to_float", "nodes", "shift", body=shift_to_float)] * grid.deterministic,
        Phase("fold_opening", "nodes", "shift", turns=grid.dimension, body=fold_shift),
        *(Phase("ease", "particles", "shift", g, body=ease) for g in eased),
    )


@ti.func
def clear_opening(at: ti.template(), node: ti.template(), time: float):
    at.grid.clear(at.grid.linear_index(node))


@ti.func
def open_up(at: ti.template(), p: int, time: float):
    """Add the mass of particle p times the distance of nodes from it, and its mass, to its nodes."""
    grid, d = ti.static((at.grid, at.grid.dimension))
    base, distance = grid.scheme.spline.stencil(at.group.x[p], grid.inverse_spacing)
    way, slope = (1.0 - distance) * grid.spacing, grid.spacing * ti.Matrix.identity(float, d)
    add_shift(at, grid.stencil_at(base), grid.scheme.spline.weights(distance), at.group.row(p)[MASS], way, slope)


@ti.func
def ease(at: ti.template(), p: int, time: float):
    """Set the share of its stress that particle p bears."""
    grid, group, d = ti.static((at.grid, at.group, at.grid.dimension))
    base, distance = grid.scheme.spline.stencil(group.x[p], grid.inverse_spacing)
    mean, moment = gather_linear(grid.nodes, grid, grid.stencil_at(base), grid.scheme.spline.weights(distance))
    opening = 0.0
    for a in ti.static(range(d)):
        opening += moment[a, a] - mean[a] * (distance[a] - 1.0)
    opening *= ti.static(grid.scheme.spline.inverse_moment / d) * grid.inverse_spacing
    alone = ti.min(ti.max((opening - EASED_FROM) * ti.static(1.0 / (EASED_TO - EASED_FROM)), 0.0), 1.0)
    before, share = group.borne[p], 1.0 - ti.static(1.0 - 1.0 / group.law.relief) * alone
    group.borne[p] = share
    # A larger share of the same strain would be energy from nowhere.
    if share > before:
        group.store(p, group.law.released(group.stored(p), before / share), group.inner(p))
