"""The update of grid nodes between P2G and G2P: fold, velocity, constrain, unfold."""

from copy import copy

from mpmcli.boundaries.colliders import Colliders
from mpmcli.boundaries.mirror_images import MirrorImages
from mpmcli.boundaries.walls import IMAGE_DEPTH
from mpmcli.quick_taichi import ti
from mpmcli.solver.contact.collider_points import ColliderPoints
from mpmcli.solver.grid.grid import Grid


@ti.data_oriented
class NodeUpdate:
    """Converts momentum to velocity at all nodes.

    Attributes:
        images: mirror images beyond walls, which constrain the velocity.
        colliders: colliders, which constrain it after the walls; None if there are none.
        points: contact at points of the surfaces of colliders, in layer 0; None if there is none.
        collides, touches: whether `colliders` and `points` are not None; Taichi cannot compare with None.
    """

    def __init__(
        self,
        grid: Grid,
        images: MirrorImages,
        colliders: Colliders | None = None,
        points: ColliderPoints | None = None,
    ) -> None:
        self.grid, self.dimension, self.images = grid, grid.dimension, images
        self.needs_contact, self.needs_friction = images.needs_contact, images.needs_friction
        self.collides, self.colliders = colliders is not None, colliders
        self.touches, self.points = points is not None, points

    def in_layer(self, grid: Grid, layer: object) -> "NodeUpdate":
        """Return the update of a layer of nodes, given its number, a variable of a kernel."""
        view = copy(self)
        view.grid, view.images = grid, self.images.in_layer(layer)
        if view.collides and not view.colliders.own:
            view.colliders = copy(self.colliders)
            view.colliders.own = layer
        return view

    def slipping(self, slip: object) -> "NodeUpdate":
        """Return the update at walls that move with the slip of what sticks by friction, a variable of a kernel."""
        view = copy(self)
        if self.needs_friction:
            view.images = copy(self.images)
            view.images.walls = self.images.walls.slipping(slip)
        return view

    @ti.func
    def update(self, node: ti.template(), index: int, gravity_step: ti.template()):
        """Update a node and its images; return its squared speed, 0 at an image and at a node without mass.

        Gravity, gravity_step (m/s), is added to the momentum of every image near a wall, and elsewhere to the velocity.
        """
        speed_squared = 0.0
        # If an image beyond a wall has mass, the node inside has mass too: a stencil that reaches one contains the
        # other.
        massive = self.grid.nodes[index][ti.static(self.dimension)] > 0
        if ti.static(len(self.images.walls.periodic) > 0):
            # This does not hold beyond a periodic face.
            massive = massive or self.images.walls.near(node)
        if massive:
            speed_squared = self.update_massive(node, index, gravity_step)
        return speed_squared

    @ti.func
    def update_massive(self, node: ti.template(), index: int, gravity_step: ti.template()):
        """Fold, divide by mass, constrain and unfold a node with mass, and return its squared speed, see `update`."""
        d = ti.static(self.dimension)
        value = self.grid.part(index, 0)
        pull = gravity_step
        speed_squared = 0.0
        # Computed once for all uses below, because the code that depends on these values is most of this loop.
        depth, mirror, upper = ti.Vector([IMAGE_DEPTH + 1] * d), node, ti.Vector.zero(int, d)
        acts, holds = ti.Vector.zero(int, d), ti.Vector.zero(int, d)
        place = ti.static((depth, mirror, upper, acts, holds))

        # Fold.
        kind = self.images.kind(node)
        for k, images in ti.static(enumerate(self.images.kinds)):
            if kind == k:
                found_depth, found_mirror, found_upper, found_acts, found_holds = images.walls.state(node, True)
                for a in ti.static(images.walls.axes):
                    depth[a], mirror[a], upper[a] = found_depth[a], found_mirror[a], found_upper[a]
                    acts[a], holds[a] = found_acts[a], found_holds[a]
                total = images.fold(self.grid, 0, node, place, gravity_step, True)
                # Entry by entry here and below, because Taichi loses vectors that are assigned as a whole in static
                # blocks.
                for c in ti.static(range(self.grid.kept)):
                    value[c] = total[c]
                for a in ti.static(range(d)):
                    pull[a] = 0.0

        if value[d] > 0:
            # Velocity.
            velocity = value
            for a in ti.static(range(d)):
                velocity[a] = value[a] / value[d] + pull[a]

            # Constrain.
            if kind >= 0:
                constrained = self.images.walls.constrained(velocity, depth, upper, acts, holds)
                for c in ti.static(range(d)):
                    velocity[c] = constrained[c]
            outside = 1.0
            if ti.static(self.collides):
                met, outside = self.colliders.constrain(node, velocity, value[d], self.grid.scheme.spline)
                for c in ti.static(range(d)):
                    velocity[c] = met[c]
                if ti.static(self.touches):
                    if self.colliders.own == 0:
                        self.points.free[self.points.place(index)] = outside

            # Unfold.
            self.write(0, node, index, kind, place, velocity)
            if ti.static(self.grid.scheme.keeps_flip_velocity):
                self.update_before(node, index, kind, place)
            # Nodes inside a surface have yet to follow its points, and hardly move particles.
            if ti.abs(outside) > 0.5:
                for a in ti.static(range(d)):
                    speed_squared += velocity[a] ** 2
        return speed_squared

    @ti.func
    def update_before(self, node: ti.template(), index: int, kind: int, place: ti.template()):
        """Convert the momentum before stress and forces to velocity: fold and unfold without boundary conditions.

        Momentum and mass are weighted by the fraction of its motion that each body keeps. The kept motion therefore
        transfers no momentum between bodies in contact, even if their fractions differ.

        Mirror images have this velocity too, so that a wall changes only the contribution of stress; friction acts on
        the change of velocity. Where friction sticks, they are mirrored about the slip, which the wall stops.
        """
        first = ti.static(self.grid.kept)
        before = self.grid.part(index, first)
        slip = ti.Matrix.zero(float, ti.static(self.dimension), ti.static(self.dimension))
        if ti.static(self.needs_friction):
            if kind >= 0:
                depth, _mirror, upper, _acts, holds = ti.static(place)
                slip = self.images.walls.slip_at(node, depth, upper, holds)
        (slipping,) = ti.static((self.slipping(slip),))
        for k, images in ti.static(enumerate(slipping.images.kinds)):
            if kind == k:
                pull = ti.Vector.zero(float, ti.static(self.dimension))
                total = images.fold(self.grid, first, node, place, pull, False)
                for c in ti.static(range(self.grid.kept)):
                    before[c] = total[c]
        mass = before[ti.static(self.dimension)]
        for a in ti.static(range(self.dimension)):
            before[a] = ti.select(mass > 0.0, before[a] / mass, 0.0)
        slipping.write(first, node, index, kind, place, before)

    @ti.func
    def write(
        self, first: ti.template(), node: ti.template(), index: int, kind: int, place: ti.template(), new: ti.template()
    ):
        """Write the velocity of a node and of its images."""
        if kind < 0:
            self.grid.set_part(index, first, new)
        for k, images in ti.static(enumerate(self.images.kinds)):
            if kind == k:
                images.unfold(self.grid, first, node, place, new)
