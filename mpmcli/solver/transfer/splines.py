"""The transfer scheme of a scene as constants of the kernels, and its B-splines (docs/theory.md, 2)."""

from dataclasses import dataclass

from mpmcli.quick_taichi import ti
from mpmcli.scene.schema import SolverSettings
from mpmcli.stability.transfer_factors import INVERSE_MOMENT

# Nodes beyond each wall: ghost nodes that the wall folds, and the reach of a stencil.
PAD = 3
# The highest index to which others can be added without overflow.
LOW_BITS = 2**30 - 1


@ti.func
def bounded(index: int):
    """Return an index of at most LOW_BITS, which a compiler then knows not to overflow when another is added.

    A CPU's compiler can then add constants to one address, which takes a third fewer instructions in 3D, and knows that
    the particles of lanes are neighbours.
    """
    return index & LOW_BITS


@ti.data_oriented
class QuadraticSpline:
    """The quadratic B-spline, whose stencil is the three nodes nearest to a point.

    nodes: of a stencil, per axis; on_node: the weight of a node for a point on it; inverse_moment: h^2 / D.
    """

    nodes = 3
    on_node = 3 / 4
    inverse_moment = INVERSE_MOMENT["quadratic"]

    @ti.func
    def stencil(self, x: ti.template(), inverse_spacing: float):
        """Return the first node of the stencil of a point and the distance to it in cells, per axis: in [0.5, 1.5)."""
        scaled = x * inverse_spacing + PAD
        base = ti.cast(scaled - 0.5, int)
        return base, scaled - ti.cast(base, float)

    @ti.func
    def weights(self, distance: ti.template()):
        """Return the weights of the three nodes, a row each, over the axes (Steffen et al. 2008, eq. 24)."""
        return ti.Matrix.rows([0.5 * (1.5 - distance) ** 2, 0.75 - (distance - 1.0) ** 2, 0.5 * (distance - 0.5) ** 2])


@ti.data_oriented
class CubicSpline:
    """The cubic B-spline, whose stencil is the two nodes on either side of a point; see QuadraticSpline."""

    nodes = 4
    on_node = 2 / 3
    inverse_moment = INVERSE_MOMENT["cubic"]

    @ti.func
    def stencil(self, x: ti.template(), inverse_spacing: float):
        """Return the first node of the stencil of a point and the distance to it in cells, per axis: in [1, 2)."""
        scaled = x * inverse_spacing + PAD
        base = ti.cast(scaled - 1.0, int)
        return base, scaled - ti.cast(base, float)

    @ti.func
    def weights(self, distance: ti.template()):
        """Return the weights of the four nodes, a row each, over the axes (Steffen et al. 2008, eq. 25)."""
        up = distance - 1.0
        down = 2.0 - distance
        return ti.Matrix.rows(
            [down**3 / 6.0, 2.0 / 3.0 - up**2 + 0.5 * up**3, 2.0 / 3.0 - down**2 + 0.5 * down**3, up**3 / 6.0]
        )


SPLINES = {"quadratic": QuadraticSpline(), "cubic": CubicSpline()}


# Equal by identity: kernels are compiled for the object that they are given.
@dataclass(frozen=True, eq=False)
class TransferScheme:
    """Constants of the transfers between particles and nodes.

    keeps_flip_velocity: whether nodes also store mass and momentum, without this step's stress and forces, of the
    shares that bodies keep (`kept_motion`); damped: share of what nodes do not see that a body loses in a step of its
    own, less than 1 with AFLIP.
    """

    spline: QuadraticSpline | CubicSpline
    keeps_flip_velocity: bool = False
    damped: float = 1.0

    @property
    def plain(self) -> bool:
        """Whether splines are quadratic and nodes store one momentum."""
        return self.spline.nodes == 3 and not self.keeps_flip_velocity


def scheme_of(settings: SolverSettings, *, keeps_flip_velocity: bool) -> TransferScheme:
    damped = 1 - (settings.flip or 0.0)
    return TransferScheme(SPLINES[settings.kernel], keeps_flip_velocity, damped)
