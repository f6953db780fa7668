"""The transfer scheme of a scene, as constants of the kernels, and its B-splines (docs/theory.md, 2)."""

from dataclasses import dataclass

from mpmcli.quick_taichi import ti
from mpmcli.scene.schema import SolverSettings
from mpmcli.stability.transfer_factors import INVERSE_MOMENT

# Nodes beyond each wall, for the ghost nodes that the wall folds and the extent of a stencil.
PAD = 3
# Largest index to which offsets can be added without overflow.
LOW_BITS = 2**30 - 1


@ti.func
def bounded(index: int):
    """Return an index of at most LOW_BITS with its upper bits masked, so that the compiler can exclude overflow.

    A CPU compiler can then add constant offsets to one address, which takes a third fewer instructions in 3D, and can
    infer that the particles of lanes are contiguous.
    """
    return index & LOW_BITS


@ti.data_oriented
class QuadraticSpline:
    """Quadratic B-spline; its stencil is the three nodes nearest to a point along each axis.

    Attributes:
        nodes: nodes of a stencil per axis.
        on_node: the weight of a node for a point on it.
        inverse_moment: h^2 / D.
    """

    nodes = 3
    on_node = 3 / 4
    inverse_moment = INVERSE_MOMENT["quadratic"]

    @ti.func
    def stencil(self, x: ti.template(), inverse_spacing: float):
        """Return the first node of the stencil of a point and the distance from it per axis, cells, in [0.5, 1.5)."""
        scaled = x * inverse_spacing + PAD
        base = ti.cast(scaled - 0.5, int)
        return base, scaled - ti.cast(base, float)

    @ti.func
    def weights(self, distance: ti.template()):
        """Return the weights, a row for each of the three nodes and a column per axis (Steffen et al. 2008, eq. 24)."""
        return ti.Matrix.rows([0.5 * (1.5 - distance) ** 2, 0.75 - (distance - 1.0) ** 2, 0.5 * (distance - 0.5) ** 2])

    @ti.func
    def at(self, r: float):
        """Return the weight of a node at r cells."""
        far = ti.abs(r)
        beyond = ti.max(1.5 - far, 0.0)
        return ti.select(far < 0.5, 0.75 - far**2, 0.5 * beyond**2)

    @ti.func
    def share_below(self, r: float):
        """Return the integral of the weight from minus infinity to r cells."""
        far = ti.abs(r)
        beyond = ti.max(1.5 - far, 0.0)
        above = ti.select(far < 0.5, 0.5 - far * (0.75 - far**2 / 3.0), beyond**3 / 6.0)
        return ti.select(r > 0.0, 1.0 - above, above)


@ti.data_oriented
class CubicSpline:
    """Cubic B-spline; its stencil is the two nodes on either side of a point along each axis; see QuadraticSpline."""

    nodes = 4
    on_node = 2 / 3
    inverse_moment = INVERSE_MOMENT["cubic"]

    @ti.func
    def stencil(self, x: ti.template(), inverse_spacing: float):
        """Return the first node of the stencil of a point and the distance from it per axis, cells, in [1, 2)."""
        scaled = x * inverse_spacing + PAD
        base = ti.cast(scaled - 1.0, int)
        return base, scaled - ti.cast(base, float)

    @ti.func
    def weights(self, distance: ti.template()):
        """Return the weights, a row for each of the four nodes and a column per axis (Steffen et al. 2008, eq. 25)."""
        up = distance - 1.0
        down = 2.0 - distance
        return ti.Matrix.rows(
            [down**3 / 6.0, 2.0 / 3.0 - up**2 + 0.5 * up**3, 2.0 / 3.0 - down**2 + 0.5 * down**3, up**3 / 6.0]
        )

    @ti.func
    def at(self, r: float):
        """Return the weight of a node at r cells."""
        far = ti.abs(r)
        beyond = ti.max(2.0 - far, 0.0)
        return ti.select(far < 1.0, 2.0 / 3.0 - far**2 + 0.5 * far**3, beyond**3 / 6.0)

    @ti.func
    def share_below(self, r: float):
        """Return the integral of the weight from minus infinity to r cells."""
        far = ti.abs(r)
        beyond = ti.max(2.0 - far, 0.0)
        inner = 0.5 - far * (2.0 / 3.0 - far**2 / 3.0 + far**3 / 8.0)
        above = ti.select(far < 1.0, inner, beyond**4 / 24.0)
        return ti.select(r > 0.0, 1.0 - above, above)


SPLINES = {"quadratic": QuadraticSpline(), "cubic": CubicSpline()}


# Compared by identity, because kernels are compiled for the object that they are given.
@dataclass(frozen=True, eq=False)
class TransferScheme:
    """Constants of the transfers between particles and nodes.

    Attributes:
        spline: the B-spline.
        keeps_flip_velocity: whether nodes also store mass and momentum, without stress and forces of this step,
            weighted by the fraction of its motion that each body keeps (`kept_motion`).
        damped: fraction of the motion not resolved by nodes that a body loses in a step of its own length; less than 1
            with AFLIP.
    """

    spline: QuadraticSpline | CubicSpline
    keeps_flip_velocity: bool = False
    damped: float = 1.0

    @property
    def plain(self) -> bool:
        """Whether the spline is quadratic and nodes store one momentum."""
        return self.spline.nodes == 3 and not self.keeps_flip_velocity


def scheme_of(settings: SolverSettings, *, keeps_flip_velocity: bool) -> TransferScheme:
    damped = 1 - (settings.flip or 0.0)
    return TransferScheme(SPLINES[settings.kernel], keeps_flip_velocity, damped)
