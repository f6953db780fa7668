"""The transfer scheme of a scene, from its [solver] table, as constants of the kernels (docs/theory.md, 2)."""

from dataclasses import dataclass

from mpmcli.scene.schema import SolverSettings
from mpmcli.solver.splines import SPLINES, CubicSpline, QuadraticSpline


# Equal by identity: kernels are compiled for the object that they are given.
@dataclass(frozen=True, eq=False)
class TransferScheme:
    """Constants of the transfers between particles and nodes.

    Attributes:
        spline: the B-spline of both transfers.
        affine: whether P2G includes the affine velocity C, as in APIC.
        flip: AFLIP's share: how much of a particle's velocity is its own plus the nodes' change; 0 for none.
    """

    spline: QuadraticSpline | CubicSpline
    affine: bool = True
    flip: float = 0.0

    @property
    def keeps_before(self) -> bool:
        """Whether nodes also store the momentum without this step's stress and forces."""
        return self.flip > 0

    @property
    def plain(self) -> bool:
        """Whether splines are quadratic and nodes store one momentum."""
        return self.spline.nodes == 3 and not self.keeps_before


def scheme_of(settings: SolverSettings) -> TransferScheme:
    """Return the scheme of a scene."""
    return TransferScheme(SPLINES[settings.kernel], settings.transfer != "pic", settings.flip or 0.0)
