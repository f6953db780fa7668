"""The motion of the elliptical drop of Monaghan (1994), by its ordinary differential equation."""

import math

STEPS = 1000


def half_axis(time: float, rate: float = 1.0) -> float:
    """Return the half axis a(t) along x of a drop that was round, a(0) = 1, under v = rate (-x, y).

    The flow v = A (-x, y) keeps an ellipse of half axes a and 1/a, and the energy A^2 (a^2 + a^-2): so that
    da/dt = -a A with A = rate sqrt(2 / (a^2 + a^-2)). By the classical Runge-Kutta method, to 1e-12.

    Args:
        time: s; rate: 1/s.
    """

    def slope(a: float) -> float:
        return -a * math.sqrt(2 / (a * a + 1 / (a * a)))

    a, dt = 1.0, rate * time / STEPS
    for _ in range(STEPS):
        k1 = slope(a)
        k2 = slope(a + dt / 2 * k1)
        k3 = slope(a + dt / 2 * k2)
        a += dt / 6 * (k1 + 2 * k2 + 2 * k3 + slope(a + dt * k3))
    return a
