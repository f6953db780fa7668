"""Principal stretches against Jacobi rotations in extended precision: any F, repeated, inverted, of any size."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
import taichi as ti
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mpmcli.materials.tensors import from_principal, principal_stretches

BOTH = pytest.mark.parametrize("dimension", [2, 3])
COUNT = 2000


@dataclass(frozen=True)
class Stretches:
    """What the kernels find for F (n, d, d): Q (n, d, d), s (n, d), and Q diag(s^2) Q^T, all in float64."""

    F: np.ndarray
    Q: np.ndarray
    s: np.ndarray
    b: np.ndarray


@dataclass(frozen=True)
class Finder:
    """Principal stretches in one precision."""

    kernels: dict[int, Callable]
    real: type

    @property
    def eps(self) -> float:
        """Rounding error of one operation."""
        return float(np.finfo(self.real).eps)

    def __call__(self, F: np.ndarray) -> Stretches:
        d = F.shape[-1]
        F = np.ascontiguousarray(F, self.real)
        Q, s, b = np.zeros_like(F), np.zeros(F.shape[:2], self.real), np.zeros_like(F)
        self.kernels[d](F, Q, s, b)
        return Stretches(*(a.astype(np.float64) for a in (F, Q, s, b)))


def kernel_of(d: int) -> Callable:
    @ti.kernel
    def run(F: ti.types.ndarray(), Q: ti.types.ndarray(), s: ti.types.ndarray(), b: ti.types.ndarray()):
        for p in range(F.shape[0]):
            given = ti.Matrix.zero(float, d, d)
            for i, j in ti.static(ti.ndrange(d, d)):
                given[i, j] = F[p, i, j]
            axes, stretches = principal_stretches(given)
            square = from_principal(axes, stretches * stretches)
            for i in ti.static(range(d)):
                s[p, i] = stretches[i]
                for j in ti.static(range(d)):
                    Q[p, i, j] = axes[i, j]
                    b[p, i, j] = square[i, j]

    return run


@pytest.fixture(scope="module", params=["f64", "f32"])
def find(request: pytest.FixtureRequest, backend_of: Callable) -> Iterator[Finder]:
    backend_of(request.param, 1)
    yield Finder({d: kernel_of(d) for d in (2, 3)}, np.float64 if request.param == "f64" else np.float32)


def orthogonal(random: np.random.Generator, count: int, d: int) -> np.ndarray:
    """Return rotations and, half of the time, mirror images of them, (n, d, d)."""
    return np.linalg.qr(random.normal(size=(count, d, d)))[0] * random.choice([-1, 1], (count, 1, d))


def stretched(random: np.random.Generator, s: np.ndarray) -> np.ndarray:
    """Return F (n, d, d) with these stretches (n, d), along random axes and turned or mirrored at random."""
    count, d = s.shape
    return orthogonal(random, count, d) * s[:, None, :] @ orthogonal(random, count, d)


def families(d: int) -> dict[str, np.ndarray]:
    """Return many F of each kind that is hard in its own way."""
    random = np.random.default_rng(5)
    noise = random.normal(size=(COUNT, d, d))
    wide = 10 ** random.uniform(-3, 3, (COUNT, 1))
    spread = 10 ** random.uniform(-8, 0, (COUNT, d))
    repeated, flat = spread.copy(), spread.copy()
    repeated[:, 0] = repeated[:, 1]
    flat[:, 0] = 0
    signs = random.integers(-1, 2, (COUNT, 1, d))
    found = {
        "any": noise,
        "of any size": noise * wide[:, :, None],
        "large strain": np.eye(d) + 0.1 * noise,
        "small strain": np.eye(d) + 1e-3 * noise,
        "minute strain": np.eye(d) + 1e-6 * noise,
        "stretches far apart": stretched(random, spread),
        "two alike": stretched(random, repeated),
        "all alike": stretched(random, np.repeat(wide, d, axis=1)),
        "flat": stretched(random, flat),
        "a line": stretched(random, np.eye(d)[np.zeros(COUNT, int)]),
        "small integers": random.integers(-2, 3, (COUNT, d, d)).astype(float),
        "nearly diagonal": np.eye(d) * signs + 10 ** random.uniform(-12, -4, (COUNT, 1, 1)) * noise,
        "enormous and minute": noise * 10 ** random.uniform(-30, 30, (COUNT, 1, 1)),
    }
    inverted = np.linalg.det(found["stretches far apart"]) < 0
    assert 0.4 < inverted.mean() < 0.6
    return found


def singular_values(F: np.ndarray) -> np.ndarray:
    """Return the singular values of F (n, d, d), the largest first, by one-sided Jacobi rotations.

    Every value is correct to roundings of the largest. LAPACK's bidiagonal QR stops at couplings below 100
    roundings, and so leaves errors of 50 roundings in stretches that nearly agree.
    """
    rows = np.moveaxis(F.astype(np.longdouble), 1, 0).copy()
    for _ in range(8):
        for i, j in zip(*np.triu_indices(len(rows), 1), strict=True):
            # The rotation that makes rows i and j orthogonal.
            coupling = (rows[i] * rows[j]).sum(1)
            difference = (rows[j] ** 2).sum(1) - (rows[i] ** 2).sum(1)
            size = np.abs(difference) + np.hypot(difference, 2 * coupling)
            tangent = 2 * coupling * np.where(difference < 0, -1, 1) / np.where(size > 0, size, 1)
            cos = (1 / np.sqrt(1 + tangent**2))[:, None]
            sin = tangent[:, None] * cos
            rows[i], rows[j] = cos * rows[i] - sin * rows[j], sin * rows[i] + cos * rows[j]
    return -np.sort(-np.sqrt((rows**2).sum(2)).T, axis=1).astype(np.float64)


def check(found: Stretches, eps: float) -> None:
    """Check s to 4 roundings of the largest, Q orthogonal to 6, Q diag(s^2) Q^T = F F^T to 10.

    The comparison has roundings of its own, as many again in f64.
    """
    eps += float(np.finfo(np.float64).eps)
    d = found.F.shape[-1]
    exact = singular_values(found.F)
    largest = np.maximum(exact[:, :1], 1e-300)
    assert (found.s >= 0).all()
    assert np.max(np.abs(-np.sort(-found.s, axis=1) - exact) / largest) < 4 * eps
    assert np.abs(found.Q.transpose(0, 2, 1) @ found.Q - np.eye(d)).max() < 6 * eps
    unit, s = found.F / largest[:, :, None], found.s / largest
    rebuilt = found.Q * s[:, None, :] ** 2 @ found.Q.transpose(0, 2, 1)
    assert np.abs(rebuilt - unit @ unit.transpose(0, 2, 1)).max() < 10 * eps


@BOTH
@pytest.mark.parametrize("family", families(2))
def test_stretches_and_axes(find: Finder, family: str, dimension: int) -> None:
    """Any finite F, mirrored half of the time, is taken apart to a few roundings of its largest stretch."""
    check(find(families(dimension)[family]), find.eps)


@settings(max_examples=20)
# Stretches that nearly agree, where LAPACK is 18 roundings off.
@example(seed=0, exponents=[0.0, -1.3974693747752068e-14, 0.0])
@given(seed=st.integers(0, 2**32 - 1), exponents=st.lists(st.floats(-12, 3), min_size=3, max_size=3))
def test_stretches_of_any_size_together(find: Finder, seed: int, exponents: list[float]) -> None:
    """Whatever three sizes meet in one matrix."""
    random = np.random.default_rng(seed)
    for d in (2, 3):
        check(find(stretched(random, np.tile(10.0 ** np.array(exponents[:d]), (100, 1)))), find.eps)


@BOTH
def test_strains_keep_their_digits(find: Finder, dimension: int) -> None:
    """Near rest Q diag(ln s) Q^T is half the logarithm of F F^T to a few roundings of 1: of any strain, 1e-6 to 0.1."""
    random = np.random.default_rng(9)
    noise = random.normal(size=(COUNT, dimension, dimension))
    found = find(np.eye(dimension) + 10 ** random.uniform(-6, -1, (COUNT, 1, 1)) * noise)
    squares, axes = np.linalg.eigh(found.F @ found.F.transpose(0, 2, 1))
    exact = axes * (np.log(squares) / 2)[:, None, :] @ axes.transpose(0, 2, 1)
    strain = found.Q * np.log(found.s)[:, None, :] @ found.Q.transpose(0, 2, 1)
    ordinary = found.s.min(axis=1) > 0.3
    assert ordinary.mean() > 0.9
    assert np.abs(strain - exact)[ordinary].max() < 24 * find.eps


@BOTH
def test_diagonal_states_are_exact(find: Finder, dimension: int) -> None:
    """Rest has stretches of exactly 1 along the axes, a diagonal F its own entries, and F = 0 none at all."""
    entries = np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [0.5, 2.0, 1.0], [-1.0, 1.0, 3.0], [0.0, 1e-3, -4.0]])
    found = find(np.eye(dimension) * entries[:, None, :dimension])
    assert np.array_equal(found.Q, np.tile(np.eye(dimension), (5, 1, 1)))
    assert np.abs(found.s - np.abs(found.F[:, range(dimension), range(dimension)])).max() <= 4 * find.eps
    assert np.array_equal(found.s[:2], np.abs(entries[:2, :dimension]))


@BOTH
def test_isotropic_tensors_are_symmetric(find: Finder, dimension: int) -> None:
    """from_principal is symmetric to the last bit, and with s^2 gives F F^T."""
    found = find(families(dimension)["any"])
    assert np.array_equal(found.b, found.b.transpose(0, 2, 1))
    scale = (found.F**2).sum(axis=(1, 2), keepdims=True)
    assert np.max(np.abs(found.b - found.F @ found.F.transpose(0, 2, 1)) / scale) < 16 * find.eps
