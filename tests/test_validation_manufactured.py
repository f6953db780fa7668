"""The force of a manufactured solution balances its stress: by finite differences, and with the laws themselves."""

from collections.abc import Callable

import numpy as np
import pytest

from mpmcli.scene.expression_reader import parse
from mpmcli.validation.cases.mms import AXES, CASES, ManufacturedWave, StandingWave
from mpmcli.validation.shared import lame_moduli

WAVES = [case for case in CASES if isinstance(case, ManufacturedWave)]
CASE = pytest.mark.parametrize("case", WAVES, ids=[case.name for case in WAVES])
STEP = 1e-4


def some_places(wave: StandingWave) -> np.ndarray:
    """Return (n, d) places inside the square or cube, d at least 2."""
    return np.random.default_rng(5).uniform(0.05, 0.95, (40, max(2, len(wave.signs))))


def evaluated(text: str, X: np.ndarray, time: float) -> np.ndarray:
    """Return the value of an expression of a scene at places (n, d)."""
    names = AXES[: X.shape[1]]
    expression = parse(text, ["t", *names])
    return expression(t=time, **dict(zip(names, X.T, strict=True)))


def slope(of: Callable[[np.ndarray], np.ndarray], X: np.ndarray, axis: int) -> np.ndarray:
    """Return the derivative along an axis by central differences of fourth order."""
    shift = np.zeros(X.shape[1])
    shift[axis] = STEP
    near = of(X + shift) - of(X - shift)
    far = of(X + 2 * shift) - of(X - 2 * shift)
    return (8 * near - far) / (12 * STEP)


@CASE
@pytest.mark.parametrize("phase", [0.2, 1.3, 4.0])
def test_force_balances_stress(case: ManufacturedWave, phase: float) -> None:
    """rho (d2u/dt2 - b) = dP_ii/dX_i, and P is diagonal, as F is."""
    wave = case.wave
    X, time = some_places(wave), phase / wave.frequency
    dt = STEP / wave.frequency
    u = [wave.displacement(X, time + k * dt) for k in (-2, -1, 0, 1, 2)]
    acceleration = (16 * (u[1] + u[3]) - u[0] - u[4] - 30 * u[2]) / (12 * dt**2)
    for i, text in enumerate(wave.force()):
        divergence = slope(lambda place, i=i: wave.piola_stress(place, time)[:, i], X, i)
        force = acceleration[:, i] - divergence
        # Differences of an acceleration of c^2 pi^2 A lose eight digits to round-off.
        scale = wave.amplitude * wave.frequency**2
        assert np.abs(evaluated(text, X, time) - force).max() < 1e-5 * scale


@CASE
def test_stretch_and_start_are_those_of_the_motion(case: ManufacturedWave) -> None:
    """F_i = 1 + du_i/dX_i; u = 0 and v = du/dt at the start; no particle leaves through a wall."""
    wave = case.wave
    X, time = some_places(wave), 0.7 / wave.frequency
    edges = np.round(X)
    assert np.abs(wave.displacement(edges, time)).max() < 1e-15
    assert np.abs(wave.displacement(X, 0.0)).max() == 0.0
    for i, text in enumerate(wave.velocity()):
        stretch = 1 + slope(lambda place, i=i: wave.displacement(place, time)[:, i], X, i)
        assert np.abs(stretch - wave.stretches(X, time)[:, i]).max() < 1e-9
        dt = STEP / wave.frequency
        speed = wave.displacement(X, dt)[:, i] / dt
        assert np.abs(evaluated(text, X, 0.0) - speed).max() < STEP * wave.amplitude * wave.frequency


@CASE
def test_stress_is_the_derivative_of_the_energy(case: ManufacturedWave) -> None:
    """P_i = dW/dF_i of the stored energy of the law (Bonet and Wood 2008, eq. 6.27; Stomakhin et al. 2012)."""
    wave = case.wave
    mu, lam = lame_moduli(wave.young, wave.poisson)

    def energy(F: np.ndarray) -> np.ndarray:
        J = F.prod(axis=1)
        if wave.law == "neo_hookean":
            return mu / 2 * ((F**2).sum(axis=1) - 3) - mu * np.log(J) + lam / 2 * np.log(J) ** 2
        return mu * ((F - 1) ** 2).sum(axis=1) + lam / 2 * (J - 1) ** 2

    X, time = some_places(wave), 1.1 / wave.frequency
    F = wave.stretches(X, time)
    for i in range(3):
        assert np.abs(slope(energy, F, i) - wave.piola_stress(X, time)[:, i]).max() < 1e-7 * wave.young
