"""Closed-form bounds on the time step of MLS-MPM with leapfrog, one function per bound (docs/theory.md, 6).

The wave bound is exact for an isolated particle, which is the least stable configuration: particles that share nodes
allow steps up to 1.7 times larger with APIC and quadratic B-splines. `Law.relief` extends it for laws whose isolated
particles bear less stress, `transfer_factors.step_inertia` to the other transfer schemes.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

# Largest displacement in one step, cells: keeps a particle's stencil local (docs/theory.md, 6.3).
COURANT = 0.5
# Largest velocity gradient times step: keeps det(I + dt C), and with it J, positive (docs/theory.md, 6.4).
DEFORMATION = 0.5
# Cells that a node moves in such a step, a cell from the fastest particle.
NODE_COURANT = COURANT + DEFORMATION
# Cells by which particles of bodies that meet walls at their surfaces may be beyond a wall.
OVERLAP = 0.5

WHY = {
    "wave": "a pressure or shear wave must not cross much more than one cell in a step",
    "viscosity": "momentum must not diffuse across more than a quarter of a cell's square in a step",
    "speed": "a particle must not move more than half a cell in a step",
    "deformation": "a particle must not be compressed by more than half in a step",
    "collider": "a collider must not move more than half a cell in a step",
    "force": "a force on a moving particle must not change by its own size within a step",
    "maximum": "time.step in the scene sets it",
    "forced": "time.step in the scene sets it, above what is stable, as --force allows",
}
FIX = {
    "wave": "a softer material or a coarser grid allows a larger step",
    "viscosity": "a thinner fluid or a coarser grid allows a larger step",
    "speed": "a coarser grid or a slower scene allows a larger step",
    "deformation": "a coarser grid or a stiffer material deforms less in a step",
    "collider": "a coarser grid or a slower collider allows a larger step",
    "force": "a force that changes less from place to place allows a larger step",
    "maximum": 'a larger time.step, or "auto", allows a larger step',
    "forced": 'time.step = "auto" takes the largest stable step',
}


class Limit(NamedTuple):
    """One bound on the time step."""

    value: float  # the largest step that it allows, s
    name: str  # one of WHY
    body: str  # name of the body that sets it, "" if no single one does

    @property
    def why(self) -> str:
        """What the bound prevents."""
        return WHY[self.name]

    @property
    def fix(self) -> str:
        """What allows a larger step."""
        return FIX[self.name]


def mode_limit(
    spacing: float, density: float, stiffness: float, viscosity: float = 0.0, inertia: float = 1.0
) -> tuple[float, str]:
    """Return the step that one mode of an isolated particle allows, s, and the name of the binding term.

    With a = 4 dt / (h^2 density) its velocity gradient obeys C' = C - a tau, where tau = stiffness e + viscosity C,
    and then e' = e + dt C'. That is stable while dt^2 stiffness + 2 dt viscosity <= density h^2; at rest the
    stiffness, Pa, is d lambda + 2 mu for a solid and d K for a fluid, and the viscosity, Pa s, 2 density nu in shear,
    see `Mode`. The density, kg/m^3, is that at rest; `inertia` is a factor of density h^2 by the scheme, see
    `transfer_factors.step_inertia`. The binding term is "wave" or "viscosity", the larger of the two at that step.
    """
    inertia = inertia * density * spacing**2
    # The root in a form without cancellation or overflow.
    root = viscosity + math.sqrt(viscosity**2 + stiffness * inertia)
    if root == 0:
        return math.inf, "wave"
    step = inertia / root
    return step, "wave" if step * stiffness >= 2 * viscosity else "viscosity"


def speed_limit(spacing: float, speed: float, gravity: float) -> float:
    """Return the step in which the fastest particle moves COURANT cells, s, by h, m, its speed, m/s, and |g|, m/s^2."""
    return math.inf if speed == 0 and gravity == 0 else crossing_step(spacing, speed, gravity)


def crossing_step(spacing: float, speed: float, gravity: float, sqrt: Callable = math.sqrt) -> float:
    """Return `speed_limit` for a nonzero speed or gravity, s; kernels call it with their own numbers and root.

    It solves speed dt + gravity dt^2 = COURANT h: gravity adds to the speed before the particle moves.
    """
    # The root in a form without cancellation or division by zero.
    return 2 * COURANT * spacing / (speed + sqrt(speed * speed + 4 * gravity * COURANT * spacing))


def deformation_limit(gradient: float) -> float:
    """Return the step in which the largest velocity gradient (1/s) deforms by DEFORMATION, s."""
    return DEFORMATION / gradient if gradient > 0 else math.inf


def collider_limit(spacing: float, speed: float) -> float:
    """Return the step in which a collider with a speed (m/s) moves COURANT cells, s."""
    return COURANT * spacing / speed if speed > 0 else math.inf


def force_limit(slope: float) -> float:
    """Return the step at which a force with the largest slope |da/dx| (1/s^2) stays smooth, s: dt^2 |da/dx| <= 1.

    For a restoring force, a = -k x, leapfrog is stable up to 4.
    """
    return 1 / math.sqrt(slope) if slope > 0 else math.inf
