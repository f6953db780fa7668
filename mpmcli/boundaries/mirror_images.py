"""Mirror images of nodes at walls: folds mass and momentum beyond the walls back, and mirrors velocities to the images.

Nodes beyond a wall are mirror images of the nodes inside. Their mass and momentum are mirrored and added to the nodes
inside before momentum is divided by mass; afterwards the nodes beyond receive the mirrored velocity. The wall is then
second-order accurate; setting nodal velocities to zero is first-order accurate (docs/theory.md, 3.1).
"""

from collections.abc import Sequence
from copy import copy

from mpmcli.boundaries.walls import AWAY, IMAGE_DEPTH, Walls
from mpmcli.quick_taichi import ti
from mpmcli.scene.domain import SEPARATING

# A separating wall acts where the node on it is filled to the fraction REACHED of that inside. Half of its kernel is
# outside, so that the filled fraction is twice its mass. Material that comes near is then a fifth of a cell away. The
# wall acts too where the node beyond has CLOSE of the mass of the node on it, half of what material that touches gives:
# light material under heavy fills the node on the wall to less.
REACHED, CLOSE = 0.75, 0.02


@ti.data_oriented
class MirrorImages:
    """The mirror images of nodes behind walls.

    A node has an image for every set of axes along which a wall acts on it and it lies inside that wall. Sets are bit
    masks: bit i is the reflection at the wall of the i-th of the axes of `walls`; 0 is the node itself.

    Attributes:
        walls: the mirrors.
        needs_contact: whether `find_contact` must run before nodes are updated.
        needs_friction: whether `find_friction` must run after `find_contact`.
        shares: fractions of the friction impulse on a column for the node on the wall, and for the two beside it
            together. They are the spline weights at the wall, which balance a shear stress up to the wall.
        planes: axes of the faces that `find_contact` and `find_friction` process.
        crossed: per axis, whether walls along other axes always act on its faces.
        apart: whether nodes near walls of a single axis have separate kinds.
    """

    def __init__(self, walls: Walls, on_node: float, *, on_cpu: bool) -> None:
        """Store the mirrors; `on_node` is the weight of the spline at a node for a point on it."""
        self.walls = walls
        self.dimension = walls.dimension
        self.needs_contact = len(walls.separating) > 0
        self.needs_friction = len(walls.rough) > 0
        self.shares = (on_node, 1 - on_node)
        # There is no gain in 2D, and software Vulkan compiles for 6 s longer.
        self.apart = on_cpu and walls.dimension == 3
        self.planes = tuple(a for a, _ in walls.separating) + tuple(a for _, _, a, _ in walls.rough)
        self.crossed = tuple(
            any(word not in SEPARATING for b in walls.lateral[a] for word in walls.faces[b])
            for a in range(self.dimension)
        )

    def along(self, axes: Sequence[int]) -> "MirrorImages":
        """Return the images for nodes that are near walls of `axes` only."""
        images = copy(self)
        images.walls = self.walls.along(axes)
        return images

    def in_layer(self, layer: object) -> "MirrorImages":
        """Return the images of a layer of nodes; each layer has its own contact and friction with walls.

        Layer 0 is that of the bodies that share a layer, if there are any.
        """
        images = copy(self)
        images.walls = copy(self.walls)
        if images.walls.shut == 0:
            images.walls.shut = -IMAGE_DEPTH * ti.min(layer, 1)
        images.walls.first_plane = self.walls.first_plane + layer * len(self.walls.separating)
        images.walls.first_rough = self.walls.first_rough + layer * len(self.walls.rough)
        return images

    @property
    def kinds(self) -> tuple["MirrorImages", ...]:
        """The kinds of nodes, see `kind`: per axis those near its walls only, which are most, and all others."""
        return (*(self.along((a,)) for a in range(self.dimension) if self.apart), self)

    @ti.func
    def kind(self, node: ti.template()):
        """Return the index of the kind of a node that may have images or be one, -1 for other nodes."""
        result = -1
        if ti.static(self.apart):
            for a in ti.static(range(self.dimension)):
                if self.walls.distance_along(node, a) <= self.walls.reach:
                    result = ti.static(a) if result < 0 else ti.static(self.dimension)
        elif self.walls.near(node):
            result = 0
        return result

    @ti.func
    def fold(
        self,
        grid: ti.template(),
        first: ti.template(),
        node: ti.template(),
        place: ti.template(),
        gravity_step: ti.template(),
        rubbed: ti.template(),
    ):
        """Return the momentum and mass of a node near a wall together with its images, after a step of gravity.

        A node on an acting wall is its own image, so that the components that the wall stops cancel. The result is zero
        at an image, whose share is added to the node inside.

        Args:
            first: index in a node of the first component, an entry of `Grid.parts`.
            place: that of `Walls.state` with the same `rubbed`.
            gravity_step: change of velocity by gravity in this step, m/s.
            rubbed: whether friction acts.
        """
        depth, mirror, upper, acts, holds = ti.static(place)
        owned = True
        for a in ti.static(self.walls.axes):
            if acts[a] == 1 and depth[a] < 0:
                owned = False
        total = ti.Vector.zero(float, grid.kept)
        if owned:
            total = self.image_sum(grid, first, node, mirror, acts, depth, holds, upper, gravity_step)
            if ti.static(rubbed):
                for r, _number, axis, side in ti.static(self.walls.rough):
                    if ti.static(axis in self.walls.axes):
                        slides = acts[axis] == 1 and holds[axis] == 0
                        if slides and depth[axis] <= 1 and upper[axis] == side:
                            impulse = self.walls.impulse[self.walls.first_rough + r, self.walls.plane_index(node, axis)]
                            share = self.shares[0] if depth[axis] == 0 else self.shares[1]
                            for c in ti.static(self.walls.lateral[axis]):
                                total[c] += share * impulse[c]
            for a in ti.static(self.walls.axes):
                if acts[a] == 1 and depth[a] == 0:
                    total = self.walls.stopped(total, a, depth, holds, upper, total[self.dimension])
            if ti.static(self.walls.slips):
                total = self.walls.closed(total, acts, depth)
        return total

    @ti.func
    def unfold(
        self, grid: ti.template(), first: ti.template(), node: ti.template(), place: ti.template(), value: ti.template()
    ):
        """Write a velocity to a node near a wall, and mirrored to its images; `place` is that of `fold`."""
        depth, mirror, upper, acts, holds = ti.static(place)
        every = self.every_image(acts, depth)
        for images in range(self.image_sets(every)):
            if images & every == images:
                mirrored = self.mirrored_value(value, images, depth, holds, upper, 1.0)
                grid.set_part(grid.linear_index(self.image(node, mirror, images)), first, mirrored)

    @ti.func
    def image_sum(
        self,
        grid: ti.template(),
        first: ti.template(),
        node: ti.template(),
        mirror: ti.template(),
        acts: ti.template(),
        depth: ti.template(),
        holds: ti.template(),
        upper: ti.template(),
        gravity_step: ti.template(),
    ):
        """Return the sum over a node and its images, each mirrored, after a step of gravity.

        Gravity acts before the fold and is mirrored with the momentum. If it acted after the fold, the weight of the
        material on a floor would exceed the force of its stress.
        """
        total = ti.Vector.zero(float, grid.kept)
        every = self.every_image(acts, depth)
        for images in range(self.image_sets(every)):
            if images & every == images:
                index = grid.linear_index(self.image(node, mirror, images))
                value = pulled(grid.part(index, first), self.dimension, gravity_step)
                total += self.mirrored_value(value, images, depth, holds, upper, value[self.dimension])
        return total

    @ti.func
    def every_image(self, acts: ti.template(), depth: ti.template()):
        """Return the set of all axes along which the node has an image: there is one for each of its subsets."""
        every = 0
        for i, a in ti.static(enumerate(self.walls.axes)):
            if acts[a] == 1 and depth[a] >= 1:
                every += ti.static(2**i)
        return every

    @ti.func
    def image_sets(self, every: int):
        """Return an upper bound of the subsets: a constant for a single axis, so that no loop remains."""
        sets = every + 1
        if ti.static(len(self.walls.axes) == 1):
            sets = 2
        return sets

    @ti.func
    def image(self, node: ti.template(), mirror: ti.template(), images: int):
        """Return an image of a node, given its mirrors."""
        place = node
        for i, a in ti.static(enumerate(self.walls.axes)):
            if images >> i & 1 == 1:
                place[a] = mirror[a]
        return place

    @ti.func
    def owner(self, node: ti.template()):
        """Return the node inside the domain of which a node is the image, and 1 or -1 per component of its velocity."""
        own, signs = node, ti.Vector.one(float, self.dimension)
        if self.walls.near(node):
            depth, mirror, _upper, acts, holds = self.walls.state(node, False)
            beyond = 0
            for i, a in ti.static(enumerate(self.walls.axes)):
                if acts[a] == 1 and depth[a] < 0:
                    own[a] = mirror[a]
                    beyond += ti.static(2**i)
            found = self.signs(beyond, holds)
            for c in ti.static(range(self.dimension)):
                signs[c] = found[c]
        return own, signs

    @ti.func
    def signs(self, images: int, holds: ti.template()):
        """Return 1 or -1 per component of a velocity and its image.

        The component normal to a wall is always reflected, the others only if the wall sticks.
        """
        result = ti.Vector.one(float, self.dimension)
        for i, a in ti.static(enumerate(self.walls.axes)):
            # An image by translation, at a periodic face, has the same value.
            if ti.static(a not in self.walls.periodic):
                if images >> i & 1 == 1:
                    result[a] = -result[a]
                    for c in ti.static(self.walls.lateral[a]):
                        if holds[a] == 1:
                            result[c] = -result[c]
        return result

    @ti.func
    def mirrored_value(
        self,
        value: ti.template(),
        images: int,
        depth: ti.template(),
        holds: ti.template(),
        upper: ti.template(),
        mass: float,
    ):
        """Return a mirrored momentum, or with mass 1 a mirrored velocity: reflected about the velocity of the wall.

        At an edge, two reflections of a component cancel if both walls have the same velocity; otherwise the velocity
        is discontinuous there for any choice of image.
        """
        result, signs = value, self.signs(images, holds)
        for c in ti.static(range(self.dimension)):
            result[c] *= signs[c]
        if ti.static(self.walls.moves):
            shift = self.shift(images, depth, holds, upper)
            for c in ti.static(range(self.dimension)):
                result[c] += mass * shift[c]
        return result

    @ti.func
    def shift(self, images: int, depth: ti.template(), holds: ti.template(), upper: ti.template()):
        """Return the term of wall velocities in a mirrored velocity: twice that of the last wall that reverses it."""
        result = ti.Vector.zero(float, self.dimension)
        turned = ti.Vector.zero(int, self.dimension)
        for i, a in ti.static(enumerate(self.walls.axes)):
            if ti.static(a not in self.walls.periodic):
                if images >> i & 1 == 1:
                    along = self.walls.velocity_at(a, upper[a], depth)
                    for c in ti.static(range(self.dimension)):
                        # The normal velocity of a wall is zero.
                        turns = 1
                        if ti.static(c != a):
                            turns = holds[a]
                        if turns == 1:
                            turned[c] = 1 - turned[c]
                            result[c] = 2 * turned[c] * along[c]
        return result

    @ti.func
    def plane_nodes(self, grid: ti.template()):
        """Return the largest number of nodes in use of a plane of a separating or a rough face."""
        most = 0
        for f in ti.static(range(len(self.planes))):
            count = 1
            for b in ti.static(self.walls.lateral[self.planes[f]]):
                count *= grid.box[1, b]
            most = ti.max(most, count)
        return most

    @ti.func
    def plane_node(self, grid: ti.template(), q: int, axis: ti.template(), upper: ti.template()):
        """Return the q-th node in use of the plane of a face, and whether there is one."""
        node = ti.Vector.zero(int, self.dimension)
        node[axis] = self.walls.last[axis] if ti.static(upper) else self.walls.first
        count = 1
        for b in ti.static(self.walls.lateral[axis]):
            count *= grid.box[1, b]
        low = grid.box[0, axis]
        inside = q < count and node[axis] >= low and node[axis] < low + grid.box[1, axis]
        if inside:
            rest = q
            for b in ti.static(self.walls.lateral[axis]):
                line = ti.raw_div(rest, grid.box[1, b])
                node[b] = grid.box[0, b] + rest - line * grid.box[1, b]
                rest = line
        return node, inside

    @ti.func
    def find_contact(self, grid: ti.template(), q: int, gravity_step: ti.template()):
        """Store whether the material presses on the q-th node in use of the plane of every separating face.

        A separating wall only pushes: it acts where the momentum of its node, with the forces of this step, points into
        it, and where the material has reached it, see `REACHED`.
        """
        for f in ti.static(range(len(self.walls.separating))):
            axis = ti.static(self.walls.separating[f][0])
            upper = ti.static(self.walls.separating[f][1])
            node, inside = self.plane_node(grid, q, axis, upper)
            if inside:
                value = pulled(grid.part(grid.linear_index(node), 0), self.dimension, gravity_step)
                inner, outer = node, node
                inner[axis] += ti.static(-1 if upper else 1)
                outer[axis] -= ti.static(-1 if upper else 1)
                mass = self.mass_at(grid, node)
                reached = 2 * mass >= REACHED * self.mass_at(grid, inner)
                reached = reached or self.mass_at(grid, outer) >= CLOSE * mass
                if ti.static(self.crossed[axis]):
                    # Contributions that other walls fold onto this node are pressed or pulled with it.
                    depth, mirror, upper_side = self.walls.place(node)
                    acts = ti.Vector.zero(int, self.dimension)
                    for b in ti.static(self.walls.lateral[axis]):
                        separates = self.walls.face_in(SEPARATING, b, upper_side[b])
                        acts[b] = ti.cast(depth[b] <= IMAGE_DEPTH and not separates, int)
                    holds = self.walls.holding(node, depth, upper_side, False)
                    value = self.image_sum(grid, 0, node, mirror, acts, depth, holds, upper_side, gravity_step)
                outward = value[axis]
                if ti.static(not upper):
                    outward = -outward
                place = self.walls.plane_index(node, axis)
                acting = ti.cast(outward >= 0, int)
                if not reached:
                    acting = AWAY
                self.walls.contact[self.walls.first_plane + f, place] = acting

    @ti.func
    def mass_at(self, grid: ti.template(), node: ti.template()):
        """Return the mass of a node and of its images at periodic faces, kg, before they are summed."""
        return self.walls.by_period.sum(grid.nodes, self.dimension, grid, node, 1)


@ti.func
def pulled(value: ti.template(), dimension: ti.template(), gravity_step: ti.template()):
    """Return momentum and mass after a step of gravity: p + m g dt."""
    result = value
    for a in ti.static(range(dimension)):
        result[a] += value[dimension] * gravity_step[a]
    return result


@ti.func
def find_friction(images: ti.template(), grid: ti.template(), q: int, gravity_step: ti.template()):
    """Compute the Coulomb friction on the column of the q-th node in use of the plane of every rough face.

    A column consists of the nodes along the normal of a node on the wall. The wall takes as much tangential momentum
    from it as sticking would, but at most the coefficient times the normal momentum that it gives (docs/theory.md,
    3.4). `find_contact` must run before. Other walls fold here as if nothing sticks by friction. The loop over the
    faces is not unrolled: a copy of its body for each of six faces would triple the compile time of a 3D scene.
    """
    d = ti.static(images.dimension)
    for r in range(ti.static(len(images.walls.rough))):
        axis, side, number = 0, 0, 0
        for row, of_scene, its_axis, its_side in ti.static(images.walls.rough):
            if r == row:
                axis, side, number = its_axis, its_side, of_scene
        # Tangential velocity of the wall.
        along = ti.Vector.zero(float, d)
        if ti.static(images.walls.moves):
            for row, _of_scene, its_axis, its_side in ti.static(images.walls.rough):
                if r == row:
                    own = images.walls.velocity(its_axis, its_side)
                    for c in ti.static(range(d)):
                        along[c] = own[c]
        node, inside = ti.Vector.zero(int, d), True
        rest, place, count = q, 0, 1
        for b in ti.static(range(d)):
            if b == axis:
                node[b] = images.walls.last[b] if side == 1 else images.walls.first
                inside = inside and node[b] >= grid.box[0, b] and node[b] < grid.box[0, b] + grid.box[1, b]
            else:
                count *= grid.box[1, b]
        if inside and q < count:
            for b in ti.static(range(d)):
                if b != axis:
                    line = ti.raw_div(rest, grid.box[1, b])
                    node[b] = grid.box[0, b] + rest - line * grid.box[1, b]
                    place = place * ti.static(images.walls.shape[b]) + node[b]
                    rest = line
            impulse = ti.Vector.zero(float, d)
            # The mass of an image counts for the node of a periodic face, too.
            filled = grid.nodes[grid.linear_index(node)][d] > 0
            if ti.static(len(images.walls.periodic) > 0):
                filled = True
            if filled:
                coefficient = images.walls.friction.of(number)
                found = column_friction(images, grid, node, gravity_step, axis, side, coefficient, along)
                for c in ti.static(range(d)):
                    impulse[c] = found[c]
            for c in ti.static(range(d)):
                images.walls.impulse[images.walls.first_rough + r, place][c] = impulse[c]


@ti.func
def column_friction(
    images: ti.template(),
    grid: ti.template(),
    node: ti.template(),
    gravity_step: ti.template(),
    axis: int,
    side: int,
    coefficient: float,
    along: ti.template(),
):
    """Return the entry of `Walls.impulse` for the column of a node on a wall.

    With mass m and momentum p of the node w + 1 beside the wall and m', p' of its image, folding and gathering take

        p_w + 2 (m' p + m p') / (m + m')

    from a column, along each axis whose sign they reverse: along all axes if the wall sticks. The normal part is the
    impulse by which the wall pushes. Of the motion that bodies keep, folding takes and returns `kept`. `inertia` is the
    mass that sticking stops, as if all of it moved with one velocity.
    """
    d = ti.static(images.dimension)
    depth, mirror, upper, acts, holds = images.walls.state(node, False)
    pressed, others = False, 0
    for a in ti.static(range(d)):
        if images.walls.ends(a, depth) and a != axis:
            along[a] = 0.0
        if a == axis:
            pressed = acts[a] == 1
            acts[a] = 0
        others = ti.max(others, acts[a])
    taken, slip = ti.Vector.zero(float, d), ti.Vector.zero(float, d)
    kept, inertia = ti.Vector.zero(float, d), 0.0
    compliance = 0.0
    if pressed:
        # No particle inside the domain reaches the second node beyond a wall.
        for j in range(2):
            inner, outer = node, node
            for a in ti.static(range(d)):
                if a == axis:
                    inner[a] += j
                    outer[a] -= j
            # It does not matter which of them lies inside. On the wall both are the same node, which counts once.
            whole = 0.5 if j == 0 else 1.0
            if ti.static(grid.scheme.keeps_flip_velocity):
                first, still = ti.static(grid.kept), ti.Vector.zero(float, d)
                old = grid.part(grid.linear_index(inner), first)
                beyond = grid.part(grid.linear_index(outer), first)
                if others > 0:
                    old = images.image_sum(grid, first, inner, mirror, acts, depth, holds, upper, still)
                    beyond = images.image_sum(grid, first, outer, mirror, acts, depth, holds, upper, still)
                if old[d] + beyond[d] > 0:
                    for c in ti.static(range(d)):
                        kept[c] += 2 * whole * (beyond[d] * old[c] + old[d] * beyond[c]) / (old[d] + beyond[d])
                    inertia += 4 * whole * old[d] * beyond[d] / (old[d] + beyond[d])
            here = pulled(grid.part(grid.linear_index(inner), 0), d, gravity_step)
            there = pulled(grid.part(grid.linear_index(outer), 0), d, gravity_step)
            if others > 0:
                here = images.image_sum(grid, 0, inner, mirror, acts, depth, holds, upper, gravity_step)
                there = images.image_sum(grid, 0, outer, mirror, acts, depth, holds, upper, gravity_step)
            if ti.static(images.walls.moves):
                # Momentum and slip relative to the wall.
                for c in ti.static(range(d)):
                    here[c] -= here[d] * along[c]
                    there[c] -= there[d] * along[c]
            mass = here[d] + there[d]
            if mass > 0:
                share = 0.0
                if j == 0:
                    share = images.shares[0]
                elif j == 1:
                    share = images.shares[1]
                for c in ti.static(range(d)):
                    taken[c] += 2 * whole * (there[d] * here[c] + here[d] * there[c]) / mass
                    slip[c] += share * (here[c] + there[c]) / mass
                compliance += share**2 / (whole * mass)
    bound, needed, speed = 0.0, 0.0, 0.0
    for c in ti.static(range(d)):
        if c == axis:
            push = taken[c] - kept[c]
            bound = coefficient * (push if side == 1 else -push)
        else:
            needed += taken[c] ** 2
            speed += slip[c] ** 2
    result = ti.Vector.zero(float, d)
    if pressed and bound >= 0:
        sticks = needed <= bound**2
        speed = ti.sqrt(speed)
        size = 0.0
        if not sticks and speed > 0:
            size = ti.min(bound, speed / compliance) / speed
        for c in ti.static(range(d)):
            if c == axis:
                result[c] = 1.0 if sticks else 0.0
            elif not sticks:
                result[c] = -size * slip[c]
            elif inertia > 0:
                result[c] = kept[c] / inertia
    return result
