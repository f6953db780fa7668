"""The walls of the domain: slip, stick and separate, by folding ghost nodes.

A wall lies on a plane of nodes. What particles near it scatter beyond it belongs to their mirror
images: it is added, mirrored, to the nodes inside, and the nodes beyond are given the mirrored velocity
back. That makes the wall second-order accurate, where setting node velocities to zero makes it first-order
(verification: 0.1 and 1.4).
"""

from collections.abc import Sequence

import taichi as ti

# Nodes on each side of a wall that can hold mass from particles of the other side.
REACH = 2


@ti.data_oriented
class Walls:
    """All faces of the domain.

    Attributes:
        faces: per axis the words of the lower and the upper face: "slip", "stick" or "separate".
        first: index of the wall's node plane at the lower faces; `last`, per axis, at the upper ones.
        crossed: per axis, whether walls along other axes always act on its faces.
        contact: per separating face and node of its plane, whether the material presses on it.
    """

    def __init__(self, faces: Sequence[tuple[str, str]], first: int, cells: Sequence[int], shape: Sequence[int]):
        self.dimension = len(faces)
        self.faces = tuple(tuple(pair) for pair in faces)
        self.first = first
        self.last = tuple(first + n for n in cells)
        self.separating = tuple(
            (a, side) for a in range(self.dimension) for side in (0, 1) if self.faces[a][side] == "separate"
        )
        self.lateral = tuple(tuple(b for b in range(self.dimension) if b != a) for a in range(self.dimension))
        self.crossed = tuple(
            any(word != "separate" for b in self.lateral[a] for word in self.faces[b]) for a in range(self.dimension)
        )
        self.shape = tuple(shape)
        if self.separating:
            planes = [self._plane_size(a) for a, _ in self.separating]
            self.contact = ti.field(ti.i32, shape=(len(planes), max(planes)))

    def _plane_size(self, axis: int) -> int:
        size = 1
        for b in self.lateral[axis]:
            size *= self.shape[b]
        return size

    @ti.func
    def plane_index(self, node: ti.template(), axis: ti.template()):
        """Return the index of a node in the plane normal to `axis`."""
        index = 0
        for b in ti.static(self.lateral[axis]):
            index = index * ti.static(self.shape[b]) + node[b]
        return index

    @ti.func
    def plane_nodes(self, grid: ti.template()):
        """Return the number of nodes in use of the largest plane that a separating face lies in."""
        most = 0
        for f in ti.static(range(len(self.separating))):
            count = 1
            for b in ti.static(self.lateral[self.separating[f][0]]):
                count *= grid.box[1, b]
            most = ti.max(most, count)
        return most

    @ti.func
    def find_contact(self, grid: ti.template(), q: int, gravity_step: ti.template()):
        """For the q-th node in use of the plane of every separating face, note whether it is pressed.

        A wall that lets go only pushes: it acts where the momentum of the node on the wall, with this
        step's forces in it, points into the wall.
        """
        for f in ti.static(range(len(self.separating))):
            axis = ti.static(self.separating[f][0])
            upper = ti.static(self.separating[f][1])
            node = ti.Vector.zero(int, self.dimension)
            node[axis] = self.last[axis] if ti.static(upper) else self.first
            rest = q
            for b in ti.static(self.lateral[axis]):
                node[b] = grid.box[0, b] + rest % grid.box[1, b]
                rest = rest // grid.box[1, b]
            inside = rest == 0
            low = grid.box[0, axis]
            if inside and node[axis] >= low and node[axis] < low + grid.box[1, axis]:
                value = self.pulled(grid.nodes[grid.linear_index(node)], gravity_step)
                if ti.static(self.crossed[axis]):
                    # What other walls fold onto this node is pressed or pulled with it.
                    depth, mirror, upper_side = self.place(node)
                    acts = ti.Vector.zero(int, self.dimension)
                    for b in ti.static(self.lateral[axis]):
                        separates = self.face_is("separate", b, upper_side[b])
                        acts[b] = ti.cast(depth[b] <= REACH and not separates, int)
                    value = self.folded(grid, node, mirror, acts, depth, upper_side, gravity_step)
                outward = value[axis]
                if ti.static(not upper):
                    outward = -outward
                self.contact[f, self.plane_index(node, axis)] = ti.cast(outward >= 0, int)

    @ti.func
    def place(self, node: ti.template()):
        """Return, per axis, how deep inside a wall within reach the node lies, its mirror, and which wall it is.

        The depth counts nodes inwards, and is REACH + 1 where no wall is within reach.
        """
        depth = ti.Vector.zero(int, self.dimension)
        mirror = node
        upper = ti.Vector.zero(int, self.dimension)
        for a in ti.static(range(self.dimension)):
            depth[a] = REACH + 1
            if node[a] <= self.first + REACH:
                depth[a] = node[a] - self.first
                mirror[a] = 2 * self.first - node[a]
            elif node[a] >= self.last[a] - REACH:
                upper[a] = 1
                depth[a] = self.last[a] - node[a]
                mirror[a] = 2 * self.last[a] - node[a]
        return depth, mirror, upper

    @ti.func
    def folded(
        self,
        grid: ti.template(),
        node: ti.template(),
        mirror: ti.template(),
        acts: ti.template(),
        depth: ti.template(),
        upper: ti.template(),
        gravity_step: ti.template(),
    ):
        """Return the momentum, gravity's included, and mass of a node with those of its images behind the walls.

        Gravity acts before the fold, so that it pulls mirror images the mirrored way, as everything else does with
        them: after it, matter on a floor would weigh more than its stress can balance, and be squeezed for ever.
        """
        total = ti.Vector.zero(float, grid.width)
        for images in range(ti.static(2**self.dimension)):
            if self.has_image(images, acts, depth):
                value = self.pulled(grid.nodes[self.image(grid, node, mirror, images)], gravity_step)
                total += self.mirrored(value, images, upper)
        return total

    @ti.func
    def folded_before(
        self,
        grid: ti.template(),
        node: ti.template(),
        mirror: ti.template(),
        acts: ti.template(),
        depth: ti.template(),
        upper: ti.template(),
    ):
        """Return the momentum from before stress and forces of a node with those of its images behind the walls."""
        total = ti.Vector.zero(float, grid.width)
        for images in range(ti.static(2**self.dimension)):
            if self.has_image(images, acts, depth):
                total += self.mirrored(grid.before[self.image(grid, node, mirror, images)], images, upper)
        return total

    @ti.func
    def pulled(self, value: ti.template(), gravity_step: ti.template()):
        """Return the momentum and mass of a node after a step of gravity."""
        result = value
        for a in ti.static(range(self.dimension)):
            result[a] += value[self.dimension] * gravity_step[a]
        return result

    @ti.func
    def near(self, node: ti.template()):
        """Return whether the node is within reach of any wall."""
        close = False
        for a in ti.static(range(self.dimension)):
            close = close or node[a] <= self.first + REACH or node[a] >= self.last[a] - REACH
        return close

    @ti.func
    def update(self, grid: ti.template(), node: ti.template(), gravity_step: ti.template()):
        """Turn momentum into velocity, with gravity and the walls, at a node near a wall and at its images.

        Returns:
            Whether it did: an image behind a wall is left to the node inside.
        """
        d = ti.static(self.dimension)
        depth, mirror, upper = self.place(node)
        acts = ti.Vector.zero(int, d)
        inner = node
        for a in ti.static(range(d)):
            acts[a] = ti.cast(depth[a] <= REACH, int)
            if depth[a] < 0:
                inner[a] = mirror[a]
        # Whether a face presses is looked up at the image inside the domain: a node and all its images agree.
        for f in ti.static(range(len(self.separating))):
            axis = ti.static(self.separating[f][0])
            if depth[axis] <= REACH and upper[axis] == self.separating[f][1]:
                acts[axis] = self.contact[f, self.plane_index(inner, axis)]
        owned = True
        for a in ti.static(range(d)):
            if acts[a] == 1 and depth[a] < 0:
                owned = False
        if owned:
            total = self.folded(grid, node, mirror, acts, depth, upper, gravity_step)
            if total[d] > 0:
                velocity = total / total[d]
                velocity[d] = total[d]
                for a in ti.static(range(d)):
                    if acts[a] == 1 and depth[a] == 0:
                        velocity = self.stop(velocity, a, upper[a])
                    elif depth[a] <= 0:
                        # A wall that has let go still lets nothing through.
                        inward = velocity[a] if upper[a] == 0 else -velocity[a]
                        if inward < 0:
                            velocity[a] = 0.0
                for images in range(ti.static(2**d)):
                    if self.has_image(images, acts, depth):
                        grid.nodes[self.image(grid, node, mirror, images)] = self.mirrored(velocity, images, upper)
                if ti.static(grid.scheme.keeps_before):
                    # As the mirror images have it, so that a wall that acts changes nothing but what stress does.
                    before = self.folded_before(grid, node, mirror, acts, depth, upper) / total[d]
                    for a in ti.static(range(d)):
                        if acts[a] == 1 and depth[a] == 0:
                            before = self.stop(before, a, upper[a])
                    for images in range(ti.static(2**d)):
                        if self.has_image(images, acts, depth):
                            grid.before[self.image(grid, node, mirror, images)] = self.mirrored(before, images, upper)
        return owned

    @ti.func
    def has_image(self, images: int, acts: ti.template(), depth: ti.template()):
        """Return whether the node has an image mirrored in exactly the axes of the bit set `images`."""
        exists = True
        for a in ti.static(range(self.dimension)):
            exists = exists and (images >> a & 1 == 0 or (acts[a] == 1 and depth[a] >= 1))
        return exists

    @ti.func
    def image(self, grid: ti.template(), node: ti.template(), mirror: ti.template(), images: int):
        """Return the linear index of that image."""
        place = node
        for a in ti.static(range(self.dimension)):
            if images >> a & 1 == 1:
                place[a] = mirror[a]
        return grid.linear_index(place)

    @ti.func
    def face_is(self, word: ti.template(), axis: ti.template(), upper: int):
        """Return whether the face of `axis` on that side has this word."""
        # In branches: Taichi takes a static flag as an operand of `and` for false inside some conditions.
        result = False
        if ti.static(self.faces[axis][0] == word):
            result = upper == 0
        if ti.static(self.faces[axis][1] == word):
            if upper == 1:
                result = True
        return result

    @ti.func
    def mirrored(self, value: ti.template(), images: int, upper: ti.template()):
        """Return momentum or velocity mirrored: the normal part always, the rest where the wall sticks."""
        result = value
        for a in ti.static(range(self.dimension)):
            if images >> a & 1 == 1:
                holds = self.face_is("stick", a, upper[a])
                for c in ti.static(range(self.dimension)):
                    if ti.static(c == a):
                        result[c] = -result[c]
                    elif holds:
                        result[c] = -result[c]
        return result

    @ti.func
    def stop(self, velocity: ti.template(), axis: ti.template(), upper: int):
        """Return the velocity on the wall: no normal part, and none at all where the wall sticks."""
        result = velocity
        holds = self.face_is("stick", axis, upper)
        for c in ti.static(range(self.dimension)):
            if ti.static(c == axis):
                result[c] = 0.0
            elif holds:
                result[c] = 0.0
        return result
