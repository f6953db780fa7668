"""What linear analysis says of a wave, against its closed form (docs/theory.md, 2.4)."""

import math

import numpy as np
import pytest

from mpmcli.validation.cases.bar import discrete_wave


def spectrum(kh: float, aliases: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Return S = (sin(K/2) / (K/2))^3 and dS/dK at K = kh + 2 pi m: all waves that look alike on the nodes."""
    K = kh + 2 * np.pi * np.arange(-aliases, aliases + 1)
    x = K / 2
    sinc = np.sin(x) / x
    return sinc**3, 3 * sinc**2 * (np.cos(x) - sinc) / (2 * x)


@pytest.mark.parametrize("courant", [0.1, 0.4, 0.8])
@pytest.mark.parametrize("kh", [0.05, 0.2, 0.5])
def test_many_particles_give_integrals(kh: float, courant: float) -> None:
    """With sums as integrals z^2 - (left + 1 - s^2) z + left = 0: |z|^2 = left, whatever the step.

    left = sum S^2 + 4 S'^2 and s^2 = (4 courant)^2 sum S'^2. A midpoint rule with p points per cell is off by 1/p^2
    of what aliases do, or less.
    """
    S, slope = spectrum(kh)
    left = float((S**2 + 4 * slope**2).sum())
    s2 = 16 * courant**2 * float((slope**2).sum())
    angle = math.acos((left + 1 - s2) / (2 * math.sqrt(left)))
    period_error, loss = discrete_wave(kh, courant, 32)
    assert loss == pytest.approx(1 - left, rel=1e-3)
    assert period_error == pytest.approx(kh * courant / angle - 1, rel=1e-3)


def test_loss_of_long_waves() -> None:
    """1/40 from S^2 + 4 S'^2, less 9/8 zeta(6) 2/pi^6 = 1/840 that aliases bring back: (kh)^4 / 42 in a step."""
    kh = 0.05
    assert discrete_wave(kh, 0.5, 32)[1] == pytest.approx(kh**4 / 42, rel=1e-3)


@pytest.mark.parametrize("per_axis", [2, 3, 4])
@pytest.mark.parametrize("cells", [13, 26, 52])
def test_laws_that_were_measured(cells: int, per_axis: int) -> None:
    """Measured at C = 0.2, that is with 26 cells: eT = 0.105 (kh)^2 and a loss of 0.024 (kh)^4 (1.2)."""
    kh = np.pi / cells
    period_error, loss = discrete_wave(kh, 0.2, per_axis)
    assert period_error == pytest.approx(0.105 * kh**2, rel=0.02)
    assert loss == pytest.approx(0.024 * kh**4, rel=0.02)


def test_long_waves_in_short_steps_are_exact() -> None:
    """As kh vanishes, the speed is that of sound at any step, and nothing is lost."""
    for courant in (0.05, 0.5, 0.9):
        period_error, loss = discrete_wave(1e-3, courant, 2)
        assert abs(period_error) < 0.11e-6
        assert abs(loss) < 1e-12
