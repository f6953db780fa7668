"""The answers that columns, cantilevers and the disc are measured against, each checked from another side."""

import math

import numpy as np
import pytest

from mpmcli.scene.entry import value_of
from mpmcli.scene.expression_reader import parse
from mpmcli.validation.cases import column_dynamic, column_static, spinning_disc
from mpmcli.validation.cases.cantilever import Beam
from mpmcli.validation.cases.locking import CORNERS, DEFLECTION, LAME, PULL, SHEAR, STRIP
from mpmcli.validation.shared import smooth_ramp, window_weights

# P L^2 / EI, shortening / L, deflection / L, angle of the tip in degrees (docs/theory.md, 10).
ELASTICA = [
    (0.25, 0.004118, 0.082746, 7.121),
    (1, 0.056433, 0.301721, 26.434),
    (2, 0.160642, 0.493457, 44.791),
    (5, 0.387628, 0.713792, 69.636),
    (10, 0.554996, 0.810609, 81.949),
]
# Law, E, height at rest of a column of 50 m (docs/theory.md, 10).
SETTLED = [
    ("von_mises", 1e6, 49.03799142), ("neo_hookean", 1e6, 49.01333014), ("fixed_corotated", 1e6, 49.0),
    ("von_mises", 1e5, 42.66526084), ("neo_hookean", 1e5, 41.30303152), ("fixed_corotated", 1e5, 40.0),
]  # fmt: skip
# Elements along the membrane, the part that is pulled not included, and across.
ELEMENTS = 18, 10
# Points and weights of Gauss on [-1, 1].
THREE = ((-(0.6**0.5), 5 / 9), (0.0, 8 / 9), (0.6**0.5, 5 / 9))
TWO = ((-(3**-0.5), 1.0), (3**-0.5, 1.0))


@pytest.mark.parametrize(("load", "shortening", "deflection", "degrees"), ELASTICA)
def test_elastica_is_that_of_the_table(load: float, shortening: float, deflection: float, degrees: float) -> None:
    bent = Beam(load).bent()
    assert bent(1.0)[:2] == pytest.approx([1 - shortening, deflection], abs=1e-6)
    assert math.degrees(bent(1.0)[2]) == pytest.approx(degrees, abs=1e-3)


def test_bent_beam_keeps_its_first_integral() -> None:
    """M^2/2 + P sin theta + P^2/4 (1/kGA - 1/EA) cos 2 theta is the same all along a beam loaded at its end."""
    load, axial, shear = 2.0, 300.0, 125.0
    for a, s in ((math.inf, math.inf), (axial, shear)):
        _, _, theta, moment = Beam(load, 0.0, a, s).bent()(np.linspace(0.0, 1.0, 201))
        kept = moment**2 / 2 + load * np.sin(theta) + load**2 / 4 * (1 / s - 1 / a) * np.cos(2 * theta)
        assert np.ptp(kept) < 1e-8


def test_small_deflection_is_timoshenkos() -> None:
    """The tip sinks by s^2 (3 - s) / 6 P under a load P at s: the mean of it, and (1 - a/2) P / kGA of shear."""
    load, spread, shear = 1e-4, 0.2, 125.0
    s = np.linspace(1 - spread, 1, 20001)
    bending = np.trapezoid(s**2 * (3 - s) / 6, s) / spread
    bent = Beam(load, spread, 300.0, shear).bent()
    assert bent(1.0)[1] / load == pytest.approx(bending + (1 - spread / 2) / shear, rel=1e-6)
    s = 0.5003
    clamped = s**2 * (3 * (1 - spread / 2) - s) / 6 + s / shear
    assert bent(s)[1] / load == pytest.approx(clamped, rel=1e-6)


def test_smooth_ramp_leaves_little_swinging() -> None:
    """x'' + w^2 x = w^2 ramp(t): what swings afterwards is |w int ramp' e^(iwt) dt| / w = the transform of ramp'."""
    duration = 3.0
    ramp = parse(smooth_ramp(duration), ["t"])
    t = np.linspace(0.0, duration, 20001)
    values = value_of(ramp, t=t)
    assert values[0] == 0
    assert values[-1] == 1
    assert (np.diff(values) > -1e-12).all()
    assert float(value_of(ramp, t=2 * duration)) == 1
    for w in (2 * math.pi * k / duration for k in (2.0, 3.3, 10.0)):
        left = abs(np.trapezoid(np.gradient(values, t) * np.exp(1j * w * t), t))
        assert left < 1680 / (w * duration) ** 4 + 1e-6


@pytest.mark.parametrize("periods", [1.4, 2.0, 2.5, 4.0])
def test_window_leaves_what_it_says_of_a_swing(periods: float) -> None:
    weights = window_weights(2001)
    swing = np.exp(2j * math.pi * periods * np.linspace(-0.5, 0.5, 2001))
    expected = math.sin(math.pi * periods) / (math.pi * periods * (1 - periods**2))
    assert weights.sum() == pytest.approx(1)
    assert abs(weights @ swing - expected) < 1e-5


@pytest.mark.parametrize(("law", "modulus", "height"), SETTLED)
def test_column_settles_as_in_the_table(law: str, modulus: float, height: float) -> None:
    assert float(column_static.rest_place(law, modulus, np.array(50.0))) == pytest.approx(height, abs=1e-8)


def test_stress_of_the_dynamic_column_is_its_sum_of_modes() -> None:
    """sigma = -density g sum 2 / (H k^2) cos(k y) (1 - cos(k c t)), k = (2 j + 1) pi / 2H."""
    H, c = column_dynamic.HEIGHT, column_dynamic.WAVE_SPEED
    k = (2 * np.arange(4000) + 1) * math.pi / (2 * H)
    Y = np.array([0.02, 0.4, 0.97]) * H
    for time in np.array([0.1, 0.6, 1.0, 2.3]) * column_dynamic.PERIOD:
        modes = -column_dynamic.WEIGHT / H * 2 / H * (np.cos(k * Y[:, None]) / k**2 * (1 - np.cos(k * c * time))).sum(1)
        # The terms left out add up to 4 / (pi^2 4000) of the weight at most.
        assert column_dynamic.exact_stress(Y, time) == pytest.approx(modes, abs=2e-4 * column_dynamic.WEIGHT)


def test_disc_starts_in_balance() -> None:
    """d sigma_r/dr + (sigma_r - sigma_t)/r + density w^2 r = 0 for Hooke's law, sigma_r = 0 at the rim (9.5)."""
    E, nu, R, k = spinning_disc.YOUNG, spinning_disc.POISSON, spinning_disc.RADIUS, spinning_disc.STRETCH
    r = np.linspace(0.05, R, 2001)
    shear, lame = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    along, around = k * ((3 - 2 * nu) * R**2 - 3 * r**2), k * ((3 - 2 * nu) * R**2 - r**2)
    radial, hoop = (2 * shear * strain + lame * (along + around) for strain in (along, around))
    pull = spinning_disc.DENSITY * spinning_disc.SPIN**2 * r
    rest = np.gradient(radial, r, edge_order=2) + (radial - hoop) / r + pull
    assert np.abs(rest).max() < 1e-6 * pull.max()
    assert abs(radial[-1]) < 1e-9 * radial[0]
    assert around[-1] == pytest.approx(8.125e-4)


def shapes(s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the quadratic shape functions of a line, and their slopes, at s in [-1, 1]."""
    return np.array([s * (s - 1) / 2, 1 - s * s, s * (s + 1) / 2]), np.array([s - 0.5, -2 * s, s + 0.5])


def deflection_of_the_membrane() -> float:
    """Return the displacement along y of the middle of the right side of Cook's membrane, m.

    Biquadratic elements in plane strain, with the volume integrated by 2 x 2 points where the shape takes 3 x 3, so
    that they do not lock (Hughes 2000, chapter 4). Elements get narrower towards the clamped side and the faces, in
    whose corners the stress is singular, and end where the pull begins.
    """
    (x0, low0), (x1, low1), (_, high1), (_, high0) = CORNERS
    start = x1 - STRIP
    along, across = ELEMENTS
    # Nodes along x, those at the middle of elements included, and across, in parts of the width.
    inner = np.linspace(0, 1, along + 1) ** 1.5
    ends = x0 + (start - x0) * inner
    ends = np.concatenate([ends, np.linspace(start, x1, 3)[1:]])
    x = np.sort(np.concatenate([ends, (ends[1:] + ends[:-1]) / 2]))
    ends = (1 - np.cos(np.pi * np.linspace(0, 1, across + 1))) / 2
    t = np.sort(np.concatenate([ends, (ends[1:] + ends[:-1]) / 2]))
    share = ((x - x0) / (x1 - x0))[:, None]
    low, high = low0 + share * (low1 - low0), high0 + share * (high1 - high0)
    nodes = np.stack(np.broadcast_arrays(x[:, None], low + (high - low) * t), axis=-1)
    numbers = np.arange(len(x) * len(t)).reshape(len(x), len(t))
    K, f = np.zeros((2 * numbers.size,) * 2), np.zeros(2 * numbers.size)
    shape = np.diag([2 * SHEAR, 2 * SHEAR, SHEAR])
    for i in range(0, len(x) - 1, 2):
        for j in range(0, len(t) - 1, 2):
            mine, points = numbers[i : i + 3, j : j + 3].ravel(), nodes[i : i + 3, j : j + 3].reshape(-1, 2)
            k = np.zeros((18, 18))
            for rule in (THREE, TWO):
                for s, ws in rule:
                    for r, wr in rule:
                        (a, da), (b, db) = shapes(s), shapes(r)
                        slopes = np.stack([np.outer(da, b).ravel(), np.outer(a, db).ravel()])
                        jacobian = slopes @ points
                        weight = ws * wr * np.linalg.det(jacobian)
                        slopes = np.linalg.solve(jacobian, slopes)
                        if rule is TWO:
                            volume = slopes.T.ravel()
                            k += LAME * weight * np.outer(volume, volume)
                            continue
                        B = np.zeros((3, 18))
                        B[0, 0::2], B[1, 1::2], B[2, 0::2], B[2, 1::2] = slopes[0], slopes[1], slopes[1], slopes[0]
                        k += weight * B.T @ shape @ B
                        if x[i] >= start - 1e-9 * x1:
                            f[2 * mine + 1] += PULL * weight * np.outer(a, b).ravel()
            unknowns = np.stack([2 * mine, 2 * mine + 1], axis=1).ravel()
            K[np.ix_(unknowns, unknowns)] += k
    free = np.arange(2 * len(t), 2 * numbers.size)
    u = np.linalg.solve(K[np.ix_(free, free)], f[free])
    # At the middle of the width of the right side, where there is a node.
    return float(u[2 * numbers[-1, len(t) // 2] + 1 - 2 * len(t)])


def test_cooks_membrane_is_that_of_elements_that_do_not_lock() -> None:
    """The matrix is ill-conditioned: the number of threads of LAPACK shows in the tenth digit."""
    assert pytest.approx(DEFLECTION, rel=1e-8) == deflection_of_the_membrane()
