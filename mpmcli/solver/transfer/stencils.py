"""Weighted sums over the stencil of a spline (gather), and their transpose for linearly varying quantities (scatter).

Both visit the stencil axis by axis: planes of lines of three nodes along the last axis. Positions are relative to its
middle node, so that its nodes lie at -1, 0 and 1, and moments are differences of sums already computed. A cubic stencil
has one more node, at 2. On the CPU every node is four numbers wide, which the compiler vectorises.
"""

from mpmcli.quick_taichi import ti
from mpmcli.solver.grid.fixed_point import FixedSums
from mpmcli.solver.transfer.run_sums import RunSums


@ti.func
def add_linear(
    field: ti.template(),
    grid: ti.template(),
    first: ti.template(),
    w: ti.template(),
    middle: ti.template(),
    change: ti.template(),
    atomic: ti.template(),
):
    """Add to the nodes of a stencil a quantity that varies linearly over it, weighted by the spline.

    Args:
        field: field of the nodes, or sums in fixed point, for which the quantity is already scaled, or the `RunSums` of
            a thread.
        first: `stencil_at` of the first node.
        middle: the quantity at the middle node.
        change: its change per cell, a row per axis.
    """
    d, width = ti.static((grid.dimension, middle.n))
    origin = grid.origin_of(first)
    for i in ti.static(range(grid.planes)):
        # The quantity at the middle of a plane and its changes along the other axes, weighted along the first axis.
        plane, across, along = middle, ti.Vector.zero(float, width), ti.Vector.zero(float, width)
        if ti.static(d == 3):
            add_multiple(plane, ti.static(i - 1), row_of(change, 0, width))
        for c in ti.static(range(width)):
            across[c], along[c] = change[d - 2, c], change[d - 1, c]
            if ti.static(d == 3):
                plane[c] *= w[i, 0]
                across[c] *= w[i, 0]
                along[c] *= w[i, 0]
        for j in ti.static(range(grid.scheme.spline.nodes)):
            line = plane
            add_multiple(line, ti.static(j - 1), across)
            line *= w[j, d - 2]
            step = along * w[j, d - 2]
            put(field, origin, grid, (i, j, 0), (line - step) * w[0, d - 1], atomic)
            put(field, origin, grid, (i, j, 1), line * w[1, d - 1], atomic)
            put(field, origin, grid, (i, j, 2), (line + step) * w[2, d - 1], atomic)
            if ti.static(grid.scheme.spline.nodes == 4):
                put(field, origin, grid, (i, j, 3), (line + 2.0 * step) * w[3, d - 1], atomic)


@ti.func
def row_of(matrix: ti.template(), row: ti.template(), width: ti.template()):
    result = ti.Vector.zero(float, width)
    for c in ti.static(range(width)):
        result[c] = matrix[row, c]
    return result


@ti.func
def columns(vector: ti.template(), matrix: ti.template(), first: ti.template(), count: ti.template()):
    """Return `count` entries of a vector and `count` columns of a matrix, from `first` on."""
    entries, part = ti.Vector.zero(float, count), ti.Matrix.zero(float, matrix.n, count)
    for c in ti.static(range(count)):
        entries[c] = vector[first + c]
        for a in ti.static(range(matrix.n)):
            part[a, c] = matrix[a, first + c]
    return entries, part


@ti.func
def add_multiple(result: ti.template(), factor: ti.template(), vector: ti.template()):
    """Add -1, 0, 1 or 2 times a vector."""
    for c in ti.static(range(result.n)):
        if ti.static(factor == -1):
            result[c] -= vector[c]
        if ti.static(factor == 1):
            result[c] += vector[c]
        if ti.static(factor == 2):
            result[c] += 2.0 * vector[c]


@ti.func
def put(
    field: ti.template(),
    origin: int,
    grid: ti.template(),
    at: ti.template(),
    share: ti.template(),
    atomic: ti.template(),
):
    """Add a share to node k of line j in plane i of a stencil, `at` = (i, j, k)."""
    if ti.static(isinstance(field, RunSums)):
        for c in ti.static(range(share.n)):
            field.sums[ti.static(field.row(at)), c] += share[c]
    else:
        add(field, grid.node_of(origin, at[0], at[1], at[2]), share, atomic)


@ti.func
def add(field: ti.template(), node: int, share: ti.template(), atomic: ti.template()):
    """Add a share of momentum and mass to a node."""
    if ti.static(isinstance(field, FixedSums)):
        field.add(node, share)
    elif ti.static(atomic):
        ti.atomic_add(field[node], share)
    else:
        field[node] = field[node] + share


@ti.func
def gather_linear(field: ti.template(), grid: ti.template(), first: ti.template(), w: ti.template()):
    """Return the weighted sums over a stencil of nodal values, and of values times their offset in cells.

    Offsets are measured from the middle node.
    """
    d, width = ti.static((grid.dimension, field.n))
    origin = grid.origin_of(first)
    velocity = ti.Vector.zero(float, width)
    moment = ti.Matrix.zero(float, d, width)
    for i in ti.static(range(grid.planes)):
        # Sums over a plane, and sums of values times the offset in cells from its middle along its axes.
        plane = ti.Vector.zero(float, width)
        across = ti.Vector.zero(float, width)
        along = ti.Vector.zero(float, width)
        for j in ti.static(range(grid.scheme.spline.nodes)):
            low = field[grid.node_of(origin, i, j, 0)] * w[0, d - 1]
            mid = field[grid.node_of(origin, i, j, 1)] * w[1, d - 1]
            high = field[grid.node_of(origin, i, j, 2)] * w[2, d - 1]
            total, slope = (low + high) + mid, high - low
            if ti.static(grid.scheme.spline.nodes == 4):
                far = field[grid.node_of(origin, i, j, 3)] * w[3, d - 1]
                total += far
                slope += 2.0 * far
            total *= w[j, d - 2]
            plane += total
            add_multiple(across, ti.static(j - 1), total)
            along += slope * w[j, d - 2]
        if ti.static(d == 3):
            plane *= w[i, 0]
            across *= w[i, 0]
            along *= w[i, 0]
        velocity += plane
        for c in ti.static(range(width)):
            if ti.static(d == 3):
                if ti.static(i == 0):
                    moment[0, c] -= plane[c]
                if ti.static(i > 1):
                    moment[0, c] += ti.static(float(i - 1)) * plane[c]
            moment[d - 2, c] += across[c]
            moment[d - 1, c] += along[c]
    return velocity, moment
