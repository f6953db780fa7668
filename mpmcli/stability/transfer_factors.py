"""Factors of the transfer schemes: moments of the splines, inertia for the stable step, and loss of energy per step."""

import math

from mpmcli.scene.schema import SolverSettings

# h^2 over the second moment of the spline, D = sum w (x_i - x)^2, by which APIC divides (Jiang et al. 2015;
# docs/theory.md, 2.2).
INVERSE_MOMENT = {"quadratic": 4, "cubic": 3}

# A step of APIC removes this times (k h)^4 of the energy of a wave of wave number k: the leading term of the spectrum
# of a step with two and three particles per cell and axis (docs/theory.md, 2.4).
APIC_LOSS = {"quadratic": 0.024, "cubic": 0.047}

# Steps from one relaxation of volumes, and one shift of particles, to the next (docs/theory.md, 5.11 and 5.12).
INTERVAL = 30
# Openings at which the share of its stress that a particle of a law with `Law.eases` bears begins to fall, and at which
# it has its smallest value (docs/theory.md, 6.1).
EASED_FROM, EASED_TO = 0.15, 0.5
# Largest displacement of a particle in a shift, and back, in distances of fine nodes.
FARTHEST = 0.2

# Loss of an impact, measured on bars of 8 to 64 cells at 0.0005 to 0.1 of their wave speed, in pairs and on walls
# (docs/theory.md, 2.5): -ln(1 - loss) = IMPACT_LOSS sqrt(min(1 / M, n / SLOW)) / (n C) in n cells, at the Mach number M
# of a bar and the Courant number C of a step.
IMPACT_LOSS, SLOW = 0.165, 1 / 14
# Smallest fraction of it that remains with AFLIP.
IMPACT_OF_AFLIP = 0.12
# The same exponent times n where bodies meet by their surfaces, whatever the speed, the step and the transfer.
IMPACT_OF_SURFACES = 1.6


def affine_moment(settings: SolverSettings) -> float:
    """Return D / h^2: m h^2 times it is the moment of inertia that the affine velocity C carries."""
    return 1 / INVERSE_MOMENT[settings.kernel]


def step_inertia(settings: SolverSettings) -> float:
    """Return the inertia that opposes a particle's stiffness, over that of APIC with quadratic splines.

    A lone particle obeys C' = C - a tau with a = dt / (D density), tau = S e + V C and e' = e + dt C', which is stable
    while dt^2 S + 2 dt V <= 4 D density. AFLIP has the bound of APIC (docs/theory.md, 6.1).
    """
    return 4 / INVERSE_MOMENT[settings.kernel]


def loss_per_step(settings: SolverSettings, kh: float) -> float:
    """Return the fraction of its energy that an elastic wave loses in a step, at wave number times spacing kh.

    AFLIP loses 1 - flip times the loss of APIC (docs/theory.md, 2.4).
    """
    # Products overflow to infinity; powers raise an error.
    square = kh * kh
    return (1 - (settings.flip or 0.0)) * APIC_LOSS[settings.kernel] * square * square


def impact_loss(
    settings: SolverSettings, cells: float, mach: float, courant: float, *, surfaces: bool = False
) -> float:
    """Return the share of its energy that a head-on impact of elastic bodies loses; right within a factor of 2.

    Bodies meet about two cells early, where their kernels couple them softly. The nodes between them see the jump of
    velocity in each step until the gap is closed: the loss counts the steps of that time, and the layers that lose are
    about a cell thick whatever the length of the bodies (docs/theory.md, 2.5). `cells` is the length of each body in
    the direction of the impact, or of one before a wall, `mach` the speed of each relative to their mean, or to the
    wall, over their wave speed, and `courant` the wave speed times step over spacing. `surfaces`: whether the bodies
    have velocity fields of their own.
    """
    if surfaces:
        return -math.expm1(-IMPACT_OF_SURFACES / cells)
    factor = APIC_LOSS[settings.kernel] / APIC_LOSS["quadratic"]
    if settings.transfer == "aflip":
        factor *= max(1 - (settings.flip or 0.0), IMPACT_OF_AFLIP)
    slowness = min(1 / mach, cells / SLOW) if mach > 0 else cells / SLOW
    return -math.expm1(-factor * IMPACT_LOSS * math.sqrt(slowness) / (cells * courant))
