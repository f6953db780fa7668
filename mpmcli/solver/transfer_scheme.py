"""How particles and nodes speak to each other, as the kernels need it: one choice of the knobs of [solver]."""

from dataclasses import dataclass

from mpmcli.scene.schema import SolverSettings
from mpmcli.solver.splines import SPLINES, CubicSpline, QuadraticSpline


# Equal by identity: kernels are compiled for the object that they are given.
@dataclass(frozen=True, eq=False)
class TransferScheme:
    """Constants of the kernels.

    Attributes:
        spline: carries everything.
        affine: whether particles hand their affine velocity on to the nodes, as APIC does.
        flip: share of a particle's velocity that is its own, changed as the nodes change, and not theirs; 0 for none.
    """

    spline: QuadraticSpline | CubicSpline
    affine: bool = True
    flip: float = 0.0

    @property
    def keeps_before(self) -> bool:
        """Whether nodes keep the momentum from before stress and forces."""
        return self.flip > 0

    @property
    def plain(self) -> bool:
        """Whether a particle writes no more than quadratic splines and one momentum make it."""
        return self.spline.nodes == 3 and not self.keeps_before


def scheme_of(settings: SolverSettings) -> TransferScheme:
    """Return the scheme that a scene asks for."""
    return TransferScheme(SPLINES[settings.kernel], settings.transfer != "pic", settings.flip or 0.0)
