"""Contact of bodies with their own velocity fields and the bodies that share layer 0, see `body_contact`.

`contact` is the `BodyContact` of a batch, `surfaces` its surfaces, and `at` a `ContactNode`.
"""

from mpmcli.boundaries.colliders import DEEP
from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.collider_points import ACTS_FROM, ACTS_FULLY, FREE, LEAST, smooth
from mpmcli.solver.contact.layers import DENSITY
from mpmcli.solver.contact.surfaces import ALIKE, DIVISOR_FLOOR, position_of
from mpmcli.solver.transfer.splines import PAD


@ti.func
def stopped(contact: ti.template(), at: ti.template(), c: int, u: ti.template(), friction: float):
    """Return the change of the velocity u of body c relative to the shared field at a node, m/s.

    A share of their approach ends, which depends on how far the kernel of the nearest point of the surface is filled
    outside of the body. Deeper than DEEP all of u ends, and as far outside nothing.
    """
    h, d = ti.static((at.grid.spacing, contact.dimension))
    change = -u
    n, far, seen = surface_of(contact, at, c)
    if seen > 0.0:
        share, approach = 1.0, ti.max(u.dot(n), 0.0)
        if far > -DEEP * h:
            # Light nodes would follow the field, which crushes the outermost particles of the body.
            share = 0.0
        elif approach > 0.0 and far > DEEP * h:
            filled = share_filled(contact, at, c, position_of(at.node, h) - far * n)
            share = smooth((filled - ACTS_FROM) / (ACTS_FULLY - ACTS_FROM))
        along = u - u.dot(n) * n
        rub = ti.min(friction * approach, along.norm()) / ti.max(along.norm(), DIVISOR_FLOOR)
        for b in ti.static(range(d)):
            change[b] = -share * (approach * n[b] + rub * along[b])
    return change


@ti.func
def surface_of(contact: ti.template(), at: ti.template(), c: int):
    """Return the mean normal of body c at a node, the distance of the node from its surface, m, and their weight."""
    grid, surfaces, h, d = ti.static((at.grid, contact.surfaces, at.grid.spacing, contact.dimension))
    n, far, seen = ti.Vector.zero(float, d), 0.0, 0.0
    for images in range(ti.static(grid.images.by_period.sets)):
        there, exists = grid.images.by_period.image_from_inside(at.node, images)
        if exists:
            place = surfaces.index_in_batch(grid, at.w, grid.linear_index(there))
            for q in range(ti.static(grid.scheme.spline.nodes**d)):
                before, inside = surfaces.stencil_before(grid, there, q)
                if inside:
                    for g in ti.static(surfaces.surfaced):
                        p = surfaces.first[g][place - before]
                        while p >= 0:
                            if surfaces.shown[g][p] == c and not on_face(surfaces, at, g, p):
                                weight, along = 1.0, 0.0
                                for b in ti.static(range(d)):
                                    way = ti.cast(there[b] - PAD, float) * h - surfaces.groups[g].x[p][b]
                                    weight *= grid.scheme.spline.at(way * grid.inverse_spacing)
                                    along += (way - surfaces.surface[g][p][d + b]) * surfaces.surface[g][p][b]
                                seen += weight
                                far += weight * along
                                for b in ti.static(range(d)):
                                    n[b] += weight * surfaces.surface[g][p][b]
                            p = surfaces.following[g][p]
    return n.normalized(DIVISOR_FLOOR), far / ti.max(seen, DIVISOR_FLOOR), seen


@ti.func
def share_filled(contact: ti.template(), at: ti.template(), c: int, y: ti.template()):
    """Return the share of the kernel of a point outside of body c that the shared field fills."""
    grid, h, d, nodes = ti.static((at.grid, at.grid.spacing, contact.dimension, at.grid.scheme.spline.nodes))
    base, _ = grid.scheme.spline.stencil(y, grid.inverse_spacing)
    full, filled = 0.0, 0.0
    for q in range(ti.static(2 * nodes**d)):
        node, weight, rest = base, 1.0, q
        for b in ti.static(range(d)):
            after = ti.raw_div(rest, nodes)
            # The place of a point is uncertain where normals differ, but no node is off the grid.
            node[b] = ti.min(ti.max(base[b] + rest - after * nodes, 0), ti.static(grid.shape[b] - 1))
            rest = after
            weight *= grid.scheme.spline.at(ti.cast(node[b] - PAD, float) - y[b] * grid.inverse_spacing)
        mass, free = room_at(contact, at, c, node)
        if q < ti.static(nodes**d):
            full = ti.max(full, ti.select(free > FREE, mass / ti.max(free, FREE), 0.0))
        elif full > 0.0:
            most = ti.min(full, contact.rows[at.w * contact.layers, DENSITY] * h**d)
            filled += weight * ti.min(mass / (most * ti.max(free, LEAST)), 1.0)
    return filled


@ti.func
def room_at(contact: ti.template(), at: ti.template(), c: int, node: ti.template()):
    """Return the mass of the shared field at a node, kg, and the share of the kernel inside walls outside of c."""
    grid, d = ti.static((at.grid, contact.dimension))
    surfaces, layer = ti.static((contact.surfaces, at.w * contact.layers + c))
    place, free, used = node, grid.images.share_inside(node, grid.scheme.spline), True
    for a in ti.static(range(d)):
        if ti.static(a in grid.images.periodic):
            place[a] = grid.images.inside_along(node[a], a)
        beyond = place[a] - surfaces.used[2 * layer, a]
        used = used and beyond >= 0 and beyond < surfaces.used[2 * layer + 1, a]
    index = grid.linear_index(place)
    if used:
        mass = surfaces.total(grid, place, index, c * ti.static(contact.node_count))[d]
        free -= mass / (contact.rows[layer, DENSITY] * grid.spacing**d)
    return surfaces.total(grid, place, index, 0)[d], free


@ti.func
def on_face(surfaces: ti.template(), at: ti.template(), g: ti.template(), p: int):
    """Return whether the surface point of a particle is on a face of the domain, where only bodies can meet it."""
    walls, h, d = ti.static((at.obstacles.walls, at.grid.spacing, surfaces.dimension))
    result = False
    for a in ti.static(range(d)):
        n = surfaces.surface[g][p][a]
        y = surfaces.groups[g].x[p][a] + surfaces.surface[g][p][d + a]
        last = ti.cast(walls.last[a] - walls.first, float) * h
        result = result or (ti.abs(n) > ALIKE and ti.min(y, last - y) < 0.25 * h)
    return result
