"""What the knobs of a scene's [solver] table mean in numbers, for the step and for what a run conserves."""

from mpmcli.scene.schema import SolverSettings

# h^2 over the second moment of the spline, D = sum w (x_i - x)^2: APIC divides by D (Jiang et al. 2015).
INVERSE_MOMENT = {"quadratic": 4, "cubic": 3}

# Energy of a wave of wave number k that a step of APIC loses is this times (k h)^4: the leading term of the spectrum of
# a step, two and three particles per cell and axis (verification: finding 2, for quadratic splines).
APIC_LOSS = {"quadratic": 0.024, "cubic": 0.047}


def affine_moment(settings: SolverSettings) -> float:
    """Return D / h^2: m h^2 times it is the moment of inertia that the affine velocity C carries; none with PIC."""
    return 0.0 if settings.transfer == "pic" else 1 / INVERSE_MOMENT[settings.kernel]


def step_inertia(settings: SolverSettings) -> float:
    """Return the inertia that a particle's stiffness works against, over that of APIC with quadratic splines.

    A lone particle obeys C' = s C - a tau with a = dt / (D density), tau = S e + V C and e' = e + dt C'. APIC keeps its
    C, s = 1, which is stable while dt^2 S + 2 dt V <= 4 D density. PIC forgets it, s = 0, and what it has left is the
    whole kick of the stress: half as much is stable. AFLIP changes only what particles that share nodes do.
    """
    return (4 / INVERSE_MOMENT[settings.kernel]) * (0.5 if settings.transfer == "pic" else 1.0)


def loss_per_step(settings: SolverSettings, kh: float) -> float:
    """Return the share of its energy that an elastic wave loses in a step, at wave number times spacing.

    With PIC (D / h^2) (k h)^2: half of what a free transfer takes, as only one half of a wave's energy is in the
    velocities. AFLIP loses what APIC does of the share that is not FLIP's.
    """
    # Products overflow to infinity, where powers raise an error.
    square = kh * kh
    if settings.transfer == "pic":
        return square / INVERSE_MOMENT[settings.kernel]
    return (1 - (settings.flip or 0.0)) * APIC_LOSS[settings.kernel] * square * square
