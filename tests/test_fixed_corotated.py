"""The fixed corotated solid, and the rotation it takes from F without singular values."""

from collections.abc import Callable

import numpy as np
import pytest
import taichi as ti
from law_probe import EPSILON, LawProbe, rotations, stretched
from law_tangent import largest_stiffness

from mpmcli.materials.fixed_corotated import FixedCorotated, FixedCorotatedParameters
from mpmcli.materials.law import StateBound
from mpmcli.materials.tensors import polar_rotation

E, NU = 3e5, 0.3
MU, LAMBDA = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
PARAMETERS = FixedCorotatedParameters(density=1000.0, youngs_modulus=E, poissons_ratio=NU)


class Backend:
    """One precision, with a probe of the law and a kernel for the rotation in each dimension."""

    def __init__(self, precision: str) -> None:
        self.precision = precision
        self.epsilon = EPSILON[precision]
        self.real = np.float64 if precision == "f64" else np.float32
        self.law = {d: LawProbe(FixedCorotated, PARAMETERS, d) for d in (2, 3)}
        self.kernels = {d: rotation_kernel(d) for d in (2, 3)}

    def rotations(self, F: np.ndarray) -> np.ndarray:
        given = np.ascontiguousarray(F, self.real)
        out = np.zeros_like(given)
        self.kernels[F.shape[1]](given, out)
        return out.astype(np.float64)


def rotation_kernel(d: int) -> Callable:
    @ti.kernel
    def run(states: ti.types.ndarray(), out: ti.types.ndarray()):
        for p in range(out.shape[0]):
            F = ti.Matrix.zero(float, d, d)
            for i, j in ti.static(ti.ndrange(d, d)):
                F[i, j] = states[p, i, j]
            R = polar_rotation(F)
            for i, j in ti.static(ti.ndrange(d, d)):
                out[p, i, j] = R[i, j]

    return run


@pytest.fixture(scope="module", params=["f64", "f32"])
def backend(backend_of: Callable, request: pytest.FixtureRequest) -> Backend:
    backend_of(request.param)
    return Backend(request.param)


def nearest_rotations(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return R (n, d, d) by singular values in float64, and their signed form (n, d), the last one negative."""
    U, s, V = np.linalg.svd(F)
    sign = np.sign(np.linalg.det(U @ V))
    U[:, :, -1] *= sign[:, None]
    s[:, -1] *= sign
    return U @ V, s


def wide(random: np.random.Generator, count: int, d: int) -> np.ndarray:
    return np.exp(random.uniform(np.log(0.05), np.log(20), (count, d)))


def flattened(random: np.random.Generator, count: int, d: int, last: float) -> np.ndarray:
    stretches = random.uniform(0.5, 2.0, (count, d))
    stretches[:, -1] = last
    return stretches


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("stretches", [
    lambda random, count, d: np.ones((count, d)),
    lambda random, count, d: 1 + 0.1 * random.normal(size=(count, d)),
    wide,
    lambda random, count, d: flattened(random, count, d, 1e-6),
    lambda random, count, d: flattened(random, count, d, 0.0),
    lambda random, count, d: flattened(random, count, d, -0.4),
    lambda random, count, d: -wide(random, count, d),
], ids=["rotated", "strained", "wide", "nearly flat", "flat", "inverted", "inverted wide"])  # fmt: skip
def test_rotation_is_the_nearest_one(backend: Backend, stretches: Callable, d: int) -> None:
    """R agrees with singular values in f64 to 10 roundings (f32: about 2) times its condition s_1/(s_2 + s_3).

    The latter is how R itself answers a change of F (Higham 2008, theorem 8.9), with s_3 negative where det F is.
    """
    count = 4000
    F = stretched(stretches(np.random.default_rng(2), count, d)).astype(backend.real).astype(np.float64)
    R = backend.rotations(F)
    expected, s = nearest_rotations(F)
    condition = np.maximum(s[:, 0] / np.maximum(s[:, -2] + s[:, -1], 1e-300), 1.0)
    error = np.abs(R - expected).max(axis=(1, 2)) / condition
    # The reference itself errs by some 20 roundings of f64.
    assert error.max() < max(3 * backend.epsilon, 60 * EPSILON["f64"])
    assert np.abs(R @ R.transpose(0, 2, 1) - np.eye(d)).max() < 5 * backend.epsilon


@pytest.mark.parametrize("d", [2, 3])
def test_states_without_a_nearest_rotation_are_bounded(backend: Backend, d: int) -> None:
    """A point, a line and a mirror image: |R| < 2 sqrt(d), tau symmetric and no larger than b, and 0 at F = 0."""
    random = np.random.default_rng(3)
    line = np.zeros((50, d))
    line[:, 0] = random.uniform(0.1, 10.0, 50)
    mirror = np.ones((50, d))
    mirror[:, -1] = -1.0
    F = np.concatenate([np.zeros((1, d, d)), stretched(line), stretched(mirror), -np.eye(d)[None]])
    R = backend.rotations(F)
    assert np.linalg.norm(R, axis=(1, 2)).max() < 2 * np.sqrt(d)
    answer = backend.law[d](F)
    assert np.isfinite(answer.tau).all()
    assert np.isfinite(answer.energy).all()
    assert not answer.tau[0].any()
    assert np.array_equal(answer.tau, answer.tau.transpose(0, 2, 1))
    size = 2 * MU * (np.linalg.norm(F, axis=(1, 2)) + 1) ** 2 + LAMBDA * 2
    assert (np.abs(answer.tau).max(axis=(1, 2)) <= size).all()


@pytest.mark.parametrize("d", [2, 3])
def test_stress_in_principal_stretches(backend: Backend, d: int) -> None:
    """tau_i = 2 mu (s_i - 1) s_i + lambda (J - 1) J along the axes of b, also for s_d < 0; the z axis has s = 1."""
    random = np.random.default_rng(4)
    stretches = np.concatenate([random.uniform(0.3, 2.5, (500, d)), flattened(random, 100, d, -0.3)])
    Q = rotations(random, len(stretches), d)
    F = Q * stretches[:, None, :] @ rotations(random, len(stretches), d)
    J = stretches.prod(axis=1)
    pressure_part = LAMBDA * (J - 1) * J
    principal = 2 * MU * (stretches - 1) * stretches + pressure_part[:, None]
    answer = backend.law[d](F)
    expected = Q * principal[:, None, :] @ Q.transpose(0, 2, 1)
    size = E + np.abs(principal).max(axis=1)
    assert (np.abs(answer.tau[:, :d, :d] - expected).max(axis=(1, 2)) < 10 * backend.epsilon * size).all()
    if d == 2:
        assert (np.abs(answer.tau[:, 2, 2] - pressure_part) < 10 * backend.epsilon * size).all()
    energy = MU * ((stretches - 1) ** 2).sum(axis=1) + LAMBDA / 2 * (J - 1) ** 2
    assert (np.abs(answer.energy - energy) < 10 * backend.epsilon * size).all()
    assert np.array_equal(answer.deformation, F.astype(backend.real).astype(np.float64))


@pytest.mark.parametrize("d", [2, 3])
def test_turning_alone_makes_no_stress(backend: Backend, d: int) -> None:
    """tau is exactly 0 at rest, and a few roundings of the moduli after any rotation."""
    F = np.concatenate([np.eye(d)[None], rotations(np.random.default_rng(5), 1000, d)])
    answer = backend.law[d](F)
    assert not answer.tau[0].any()
    assert answer.energy[0] == 0
    assert np.abs(answer.tau).max() < 5 * backend.epsilon * (2 * MU + d * LAMBDA)


@pytest.mark.parametrize("d", [2, 3])
def test_small_strain_keeps_its_digits(backend: Backend, d: int) -> None:
    """At strain e stress and energy are those of Hooke's law: off by order e and by rounding over e, relatively."""
    strain = {"f64": 1e-7, "f32": 1e-4}[backend.precision]
    random = np.random.default_rng(6)
    H = random.normal(size=(200, d, d))
    H = strain * (H + H.transpose(0, 2, 1)) / 2
    F = (np.eye(d) + H).astype(backend.real).astype(np.float64)
    H = F - np.eye(d)
    trace = np.einsum("nii->n", H)
    answer = backend.law[d](F)
    tau = 2 * MU * H + LAMBDA * trace[:, None, None] * np.eye(d)
    tolerance = 20 * strain + 5 * backend.epsilon / strain
    assert np.abs(answer.tau[:, :d, :d] - tau).max() < tolerance * np.abs(tau).max()
    energy = MU * (H**2).sum(axis=(1, 2)) + LAMBDA / 2 * trace**2
    assert np.abs(answer.energy / energy - 1).max() < tolerance


@pytest.mark.parametrize("d", [2, 3])
def test_small_shear_keeps_its_digits(backend: Backend, d: int) -> None:
    """Of F = I + e, e off the diagonal, of any size: F is symmetric, so that S = F, and tau there is 2 mu (F^2 - F)."""
    sizes = np.logspace(-8, -1, 200)
    F = np.tile(np.eye(d), (len(sizes), 1, 1))
    F[:, 0, 1] = F[:, 1, 0] = sizes.astype(backend.real)
    exact = F.astype(np.float64)
    answer = backend.law[d](F)
    expected = 2 * MU * (exact @ exact - exact)
    tolerance = {"f64": 1e-8, "f32": 3e-4}[backend.precision]
    assert np.abs(answer.tau[:, 0, 1] / expected[:, 0, 1] - 1).max() < tolerance


@pytest.mark.parametrize("d", [2, 3])
def test_stiffness_bounds_every_state(backend: Backend, d: int) -> None:
    """`modes` is exact at rest, d lambda + 2 mu, and exact again where all stretches are the bound's largest.

    It is never below the largest eigenvalue of the differentiated stress within the bound, nor below that at rest.
    """
    if backend.precision == "f32":
        pytest.skip("differences of f32 say nothing")
    probe = backend.law[d]
    law = probe.law

    def bound(F: np.ndarray) -> StateBound:
        J = np.linalg.det(F)
        return StateBound(J.min(), J.max(), (np.linalg.svd(F)[1] ** 2).max())

    at_rest = law.modes(PARAMETERS, StateBound())[0].stiffness
    assert at_rest == pytest.approx(d * LAMBDA + 2 * MU)
    assert largest_stiffness(probe, np.eye(d)[None])[0] == pytest.approx(at_rest, rel=1e-8)
    swollen = 1.3 * np.eye(d)[None]
    assert largest_stiffness(probe, swollen)[0] == pytest.approx(law.modes(PARAMETERS, bound(swollen))[0].stiffness)
    random = np.random.default_rng(7)
    inverted = flattened(random, 300, d, -0.5)
    for stretches in (random.uniform(0.1, 2.5, (300, d)), random.uniform(0.2, 0.9, (300, d)), inverted):
        F = stretched(stretches)
        for part in (F[::2], F[1::2]):
            stated = law.modes(PARAMETERS, bound(part))[0].stiffness
            assert stated >= largest_stiffness(probe, part).max()
            assert stated >= at_rest
    auxetic = PARAMETERS.model_copy(update={"poissons_ratio": -0.5})
    assert law.modes(auxetic, StateBound())[0].stiffness == pytest.approx(2 * auxetic.shear_modulus)
