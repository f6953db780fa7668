"""Lets the particles of a cell share their change of volume, so that nearly incompressible material does not lock.

The law of a particle sees F (J'/J)^(1/d), where ln J' is the mean of ln J over the particles of its cell, weighted by
their volumes at rest: F-bar (de Souza Neto et al. 1996) with the projection of B-bar (Hughes 1980). Where particles
change cells (`ParticleArrays.evened`) F itself grows by the mean growth of its cell. See docs/theory.md, 4.4. Only
groups that ask for it (`ParticleArrays.averaged`) have any of this compiled.
"""

from mpmcli.materials.elementary import exp, exp_minus_1, log
from mpmcli.materials.law import SMALLEST, Law
from mpmcli.materials.tensors import volume_strain
from mpmcli.quick_taichi import ti
from mpmcli.scene.schema import SolverSettings
from mpmcli.solver.particles.arrays import VOLUME
from mpmcli.solver.transfer.lanes import (
    LANES,
    load_deformation,
    load_entry,
    load_vectors,
    matrix_of,
    repeat_first,
    vector_of,
    zero_lanes,
)
from mpmcli.solver.transfer.splines import PAD, bounded


def averages_volume(settings: SolverSettings, law: Law) -> bool:
    """Return whether the particles of a law share their change of volume."""
    if settings.f_bar == "auto":
        return law.locks
    return settings.f_bar and law.deformation == "F"


@ti.func
def cell_of(grid: ti.template(), x: ti.template()):
    """Return the linear index of the first node of the cell of a point."""
    cell = ti.Vector.zero(int, ti.static(grid.dimension))
    for a in ti.static(range(grid.dimension)):
        if ti.static(a in grid.period.axes):
            # Of a particle beyond the lower face the coordinate is negative.
            cell[a] = ti.cast(ti.floor(x[a] * grid.inverse_spacing), int) + PAD
        else:
            cell[a] = ti.cast(x[a] * grid.inverse_spacing, int) + PAD
    return grid.linear_index(cell)


@ti.func
def cell_of_particle(grid: ti.template(), group: ti.template(), p: int):
    """Return the linear index of the first node of the cell of a particle, in the layer of its body."""
    cell = cell_of(grid, group.on_grid(p))
    if ti.static(group.layers > 1):
        cell += group.layer_of(p) * ti.static(grid.node_count)
    return cell


@ti.func
def log_volume(H: ti.template()):
    """Return ln J from F - I, finite where a particle is crushed or inverted, too."""
    return log(1.0 + ti.max(volume_strain(H), ti.static(SMALLEST - 1.0)))


@ti.func
def average_range(grid: ti.template(), g: ti.template(), group: ti.template(), first: int, last: int):
    """Add particles first to last - 1 of the g-th group to their cells; no other thread may write to these."""
    d = ti.static(group.dimension)
    x, deformation = zero_lanes(d), zero_lanes(ti.static(d * d))
    volumes, logs, cells = ti.Vector.zero(float, LANES), ti.Vector.zero(float, LANES), ti.Vector.zero(int, LANES)
    growths = zero_lanes(1)
    begin = first
    while begin < last:
        count = ti.min(LANES, last - begin)
        load_deformation(group, bounded(begin), deformation)
        load_vectors(x, group.place_on_grid, bounded(begin))
        if ti.static(group.evened):
            load_entry(growths, 0, group.growth, (), bounded(begin))
        if count < LANES:
            repeat_first(deformation, count)
            repeat_first(x, count)
        for lane in range(LANES):
            # What lies beyond the last particle is no row of the table.
            volumes[lane] = group.row(begin + ti.min(lane, count - 1))[VOLUME]
        for lane in range(LANES):
            logs[lane] = log_volume(matrix_of(deformation, 0, d, lane))
            cells[lane] = cell_of(grid, vector_of(x, 0, d, lane))
            if ti.static(group.layers > 1):
                cells[lane] += group.layer_of(begin + ti.min(lane, count - 1)) * ti.static(grid.node_count)
        for lane in range(count):
            group.cell[begin + lane] = cells[lane]
            group.to_mean[begin + lane] = logs[lane]
            share = volumes[lane] * ti.Vector([logs[lane], growths[0, lane], 1.0])
            grid.means[g][cells[lane]] = grid.means[g][cells[lane]] + share
        begin += LANES


@ti.func
def add_volume(grid: ti.template(), g: ti.template(), group: ti.template(), p: int):
    """Add particle p to its cell, with atomics."""
    H = ti.Matrix.zero(float, group.dimension, group.dimension)
    for i, j in ti.static(ti.ndrange(group.dimension, group.dimension)):
        H[i, j] = group.displacement_gradient[p][i, j]
    own, growth = log_volume(H), 0.0
    if ti.static(group.evened):
        growth = group.growth[p]
    group.to_mean[p] = own
    volume, cell = group.row(p)[VOLUME], cell_of_particle(grid, group, p)
    group.cell[p] = cell
    if ti.static(grid.deterministic):
        grid.fixed.add_mean(g, cell, volume, own, growth)
    else:
        ti.atomic_add(grid.means[g][cell][0], volume * own)
        if ti.static(group.evened):
            ti.atomic_add(grid.means[g][cell][1], volume * growth)
        ti.atomic_add(grid.means[g][cell][2], volume)


@ti.func
def clear_mean(grid: ti.template(), g: ti.template(), group: ti.template(), p: int):
    """Set the sums of the cell of particle p, and of its images, to zero."""
    cell = cell_of_particle(grid, group, p)
    clear_cell(grid, g, cell)
    if ti.static(len(grid.period.axes) > 0):
        for images in range(1, ti.static(2**grid.dimension)):
            image, exists = grid.period.image(grid.place_of(cell), images)
            if exists:
                clear_cell(grid, g, grid.linear_index(image))


@ti.func
def clear_cell(grid: ti.template(), g: ti.template(), cell: int):
    if ti.static(grid.deterministic):
        grid.fixed.means[g].clear(cell)
    else:
        grid.means[g][cell] = ti.Vector.zero(float, 3)


@ti.func
def sums_at(grid: ti.template(), g: ti.template(), cell: int):
    if ti.static(grid.deterministic):
        return grid.fixed.mean(g, cell)
    else:
        return grid.means[g][cell]


@ti.func
def sums_of_cell(grid: ti.template(), g: ti.template(), cell: int):
    """Return the sums of a cell and its images, once all particles were added."""
    sums = sums_at(grid, g, cell)
    if ti.static(len(grid.period.axes) > 0):
        for images in range(1, ti.static(2**grid.dimension)):
            image, exists = grid.period.image(grid.place_of(cell), images)
            if exists:
                more = sums_at(grid, g, grid.linear_index(image))
                for k in ti.static(range(3)):
                    sums[k] += more[k]
    return sums


@ti.func
def missing_to_mean(grid: ti.template(), g: ti.template(), group: ti.template(), p: int):
    """Return the mean of ln J over the cell of particle p less its own."""
    sums = sums_of_cell(grid, g, group.cell[p])
    return sums[0] / sums[2] - group.to_mean[p]


@ti.func
def missing_growth(grid: ti.template(), g: ti.template(), group: ti.template(), p: int):
    """Return the mean over the cell of particle p of the growth of ln J in the last step, less its own."""
    sums = sums_of_cell(grid, g, group.cell[p])
    return sums[1] / sums[2] - group.growth[p]


@ti.func
def stretch_to(missing: float, d: ti.template()):
    """Return the factor of F by which ln J grows by `missing`."""
    return exp(missing * ti.static(1.0 / d))


@ti.func
def even(H: ti.template(), missing: float):
    """Return F - I from F - I before, once ln J has grown by `missing`."""
    d = ti.static(H.n)
    return H + exp_minus_1(missing * ti.static(1.0 / d)) * (H + ti.Matrix.identity(float, d))


@ti.func
def average_for_frame(grid: ti.template(), g: ti.template(), group: ti.template(), first: int, last: int):
    """Leave in `to_mean` of all particles of a run what `missing_to_mean` returns; on one thread."""
    for p in range(first, last):
        clear_mean(grid, g, group, p)
    average_range(grid, g, group, first, last)
    for p in range(first, last):
        group.to_mean[p] = missing_to_mean(grid, g, group, p)
