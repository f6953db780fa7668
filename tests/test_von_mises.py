"""Von Mises plasticity: pure shear, uniaxial stress and strain, plane strain, hardening, and wild states."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from law_probe import LawProbe, Probes, Response, assert_finite, rotations, stretched, wild
from law_tangent import largest_stiffness

from mpmcli.materials.law import StateBound
from mpmcli.materials.von_mises import VonMises, VonMisesParameters
from mpmcli.scene.material import SceneBounds

BOTH = pytest.mark.parametrize("dimension", [2, 3])
MODULUS, YIELD, HARDENING = 7e7, 2e5, 4e6
KINDS = {"hardening": {"hardening_modulus": HARDENING}, "perfect": {}, "elastic": {"yield_stress": 1e12}}


def metal(kind: str) -> VonMisesParameters:
    return VonMisesParameters(
        density=2700.0, **{"youngs_modulus": MODULUS, "poissons_ratio": 0.33, "yield_stress": YIELD, **KINDS[kind]}
    )


MU, LAMBDA = metal("perfect").shear_modulus, metal("perfect").lame_lambda


@pytest.fixture(scope="module")
def probes(backend_of: Callable) -> Probes:
    """Probes in double precision."""
    backend_of("f64", 1)
    return Probes(metal)


def diagonal(*strains: np.ndarray | float, dimension: int = 3) -> np.ndarray:
    """Return F (n, d, d) with these Hencky strains, (n,) or numbers, along the axes; the first d of them."""
    e = np.stack(np.broadcast_arrays(*np.atleast_1d(*strains)), axis=-1)[:, :dimension]
    return np.exp(e)[:, None, :] * np.eye(dimension)


def states(d: int, count: int = 300) -> np.ndarray:
    """Return F (n, d, d), from strains of 1e-4 to 0.5, turned at random."""
    random = np.random.default_rng(d)
    e = random.normal(size=(count, d)) * 10 ** random.uniform(-4, -0.3, (count, 1))
    return stretched(np.exp(e), random)


def steps(probe: LawProbe, F: np.ndarray, increment: np.ndarray, count: int, internal: np.ndarray | None = None):
    """Return the response after `count` multiplications of F (n, d, d) by an increment (n, d, d)."""
    answer = probe(F, internal)
    for _ in range(count):
        answer = probe(increment @ answer.deformation, answer.internal)
    return answer


def mises(tau: np.ndarray) -> np.ndarray:
    """Return sqrt(3/2) |dev tau| (n,) of tau (n, 3, 3)."""
    deviator = tau - np.einsum("nii->n", tau)[:, None, None] / 3 * np.eye(3)
    return np.sqrt(1.5 * (deviator**2).sum(axis=(1, 2)))


def strain_of(answer: Response) -> np.ndarray:
    return answer.internal[:, 0]


@BOTH
@pytest.mark.parametrize("kind", ["hardening", "perfect"])
def test_pure_shear(probes: Probes, kind: str, dimension: int) -> None:
    """tau = 2 mu g, at most (yield + H a) / sqrt(3), with a = (2 sqrt(3) mu g - yield) / (3 mu + H)."""
    H = metal(kind).hardening_modulus
    first = YIELD / (math.sqrt(3) * 2 * MU)
    g = first * np.array([0.5, 0.999, 1.001, 2.0, 10.0, 300.0])
    F = diagonal(g, -g, 0.0, dimension=dimension)
    answer = probes(dimension, kind)(F)
    a = np.maximum(2 * math.sqrt(3) * MU * g - YIELD, 0) / (3 * MU + H)
    shear = np.where(g < first, 2 * MU * g, (YIELD + H * a) / math.sqrt(3))
    assert np.abs(answer.tau - shear[:, None, None] * np.diag([1.0, -1.0, 0.0])).max() < 1e-12 * MODULUS
    assert np.abs(strain_of(answer) - a).max() < 1e-12
    assert np.array_equal(answer.deformation[:2], F[:2])


def test_uniaxial_stress(probes: Probes) -> None:
    """Pulled with free sides: sigma = yield + H a at strain sigma / E + a, a slope of E H / (E + H) beyond yield."""
    a = np.array([0.0, 1e-3, 0.01, 0.1])
    sigma = YIELD + HARDENING * a
    along, across = sigma / MODULUS + a, -0.33 * sigma / MODULUS - a / 2
    for sign in (1, -1):
        answer = probes(3, "hardening")(diagonal(sign * along, sign * across, sign * across))
        assert np.abs(answer.tau - sign * sigma[:, None, None] * np.diag([1.0, 0.0, 0.0])).max() < 1e-12 * MODULUS
        assert np.abs(strain_of(answer) - a).max() < 1e-12
    slope = np.diff(sigma) / np.diff(along)
    assert slope == pytest.approx(np.full(3, MODULUS * HARDENING / (MODULUS + HARDENING)))


@BOTH
def test_uniaxial_strain(probes: Probes, dimension: int) -> None:
    """Between walls tau = K e + (2, -1, -1)/3 (yield + H a) sign(e), with a = (2 mu |e| - yield) / (3 mu + H)."""
    e = np.array([1e-3, -1e-3, 0.01, -0.3])
    answer = probes(dimension, "hardening")(diagonal(e, 0.0, 0.0, dimension=dimension))
    a = np.maximum(2 * MU * np.abs(e) - YIELD, 0) / (3 * MU + HARDENING)
    stress = np.minimum(2 * MU * np.abs(e), YIELD + HARDENING * a) * np.sign(e)
    mean = (LAMBDA + 2 * MU / 3) * e
    exact = mean[:, None] + stress[:, None] * np.array([2.0, -1.0, -1.0]) / 3
    assert np.abs(answer.tau - exact[:, None, :] * np.eye(3)).max() < 1e-12 * MODULUS
    assert np.abs(strain_of(answer) - a).max() < 1e-12


def test_plane_strain_flows_to_its_limit(probes: Probes) -> None:
    """Pulled along x, then sheared in the plane: |s_1 - s_2| -> 2 yield / sqrt(3), s_zz -> their mean, as in 3D."""
    increment = diagonal(2e-4, -2e-4, 0.0)
    solid = steps(probes(3, "perfect"), diagonal(0.02, 0.0, 0.0), increment, 300)
    flat = steps(probes(2, "perfect"), diagonal(0.02, 0.0, dimension=2), increment[:, :2, :2], 300)
    assert np.abs(flat.tau - solid.tau).max() < 1e-10 * MODULUS
    s = np.diag(flat.tau[0])
    assert s[0] - s[1] == pytest.approx(2 * YIELD / math.sqrt(3), rel=1e-9)
    assert s[2] == pytest.approx((s[0] + s[1]) / 2, rel=1e-5)
    # The path began elsewhere: pulled alone it flows at s_1 - s_2 = yield.
    began = np.diag(probes(2, "perfect")(diagonal(0.02, 0.0, dimension=2)).tau[0])
    assert began[0] - began[1] == pytest.approx(YIELD)
    assert abs(began[2] - (began[0] + began[1]) / 2) > 0.4 * YIELD


@BOTH
def test_one_step_or_a_thousand(probes: Probes, dimension: int) -> None:
    """Along a straight path the result does not depend on the number of increments."""
    random = np.random.default_rng(4)
    strain = random.uniform(-0.1, 0.1, (20, 3))
    at_once = probes(dimension, "hardening")(diagonal(*strain.T, dimension=dimension))
    rest = np.tile(np.eye(dimension), (20, 1, 1))
    small = diagonal(*(strain.T / 1000), dimension=dimension)
    slowly = steps(probes(dimension, "hardening"), rest, small, 1000)
    assert np.abs(slowly.tau - at_once.tau).max() < 1e-10 * MODULUS
    assert np.abs(slowly.internal - at_once.internal).max() < 1e-10
    assert np.abs(slowly.deformation - at_once.deformation).max() < 1e-10


@BOTH
@pytest.mark.parametrize("kind", ["hardening", "perfect"])
def test_return_mapping(probes: Probes, kind: str, dimension: int) -> None:
    """Inside bitwise unchanged; else on the yield surface, mean stress and volume kept; a second return is none."""
    probe, F = probes(dimension, kind), states(dimension)
    once = probe(F)
    trial = probes(dimension, "elastic")(F)
    flows = mises(trial.tau) > YIELD
    assert min(flows.sum(), (~flows).sum()) > 30
    assert np.array_equal(once.deformation[~flows], F[~flows])
    assert not once.internal[~flows].any()
    limit = YIELD + metal(kind).hardening_modulus * strain_of(once)
    assert np.abs(mises(once.tau) - limit)[flows].max() < 1e-12 * MODULUS
    assert np.abs(np.einsum("nii->n", once.tau - trial.tau)).max() < 1e-11 * MODULUS
    named = {variable.name: once.internal[:, k] for k, variable in enumerate(probe.law.internal)}
    total = probe.law.total_volume_ratio(np.linalg.det(once.deformation), named)
    assert np.abs(total / np.linalg.det(F) - 1).max() < 1e-12
    twice = probe(once.deformation, once.internal)
    assert np.abs(twice.deformation - once.deformation).max() < 1e-12
    assert np.abs(twice.internal - once.internal).max() < 1e-12
    assert np.abs(twice.tau - once.tau).max() < 1e-12 * MODULUS


@BOTH
def test_stress_turns_with_the_body(probes: Probes, dimension: int) -> None:
    """tau(Q F) = Q tau(F) Q^T while it flows, and the plastic strain does not see the turn."""
    F = states(dimension)
    Q = np.tile(np.eye(3), (len(F), 1, 1))
    Q[:, :dimension, :dimension] = rotations(np.random.default_rng(8), len(F), dimension)
    straight = probes(dimension, "hardening")(F)
    turned = probes(dimension, "hardening")(Q[:, :dimension, :dimension] @ F)
    assert np.abs(turned.tau - Q @ straight.tau @ Q.transpose(0, 2, 1)).max() < 1e-12 * MODULUS
    assert np.abs(turned.internal - straight.internal).max() < 1e-13


@BOTH
def test_elastic_part(probes: Probes, dimension: int) -> None:
    """Below yield tau = 2 mu e + lambda tr e I, e = ln(F F^T) / 2, and the energy is mu |e|^2 + lambda/2 (tr e)^2."""
    F = states(dimension)
    answer = probes(dimension, "elastic")(F)
    squares, axes = np.linalg.eigh(F @ F.transpose(0, 2, 1))
    e = np.zeros((len(F), 3, 3))
    e[:, :dimension, :dimension] = axes * (np.log(squares) / 2)[:, None, :] @ axes.transpose(0, 2, 1)
    trace = np.einsum("nii->n", e)
    hooke = 2 * MU * e + LAMBDA * trace[:, None, None] * np.eye(3)
    assert np.abs(answer.tau - hooke).max() < 1e-12 * MODULUS
    energy = MU * (e**2).sum(axis=(1, 2)) + LAMBDA / 2 * trace**2
    assert np.abs(answer.energy - energy).max() < 1e-12 * MODULUS


@BOTH
def test_modes_are_the_tangent(probes: Probes, dimension: int) -> None:
    """d lambda + 2 mu for normal strain, and 2 mu x coth x for shear, x the logarithm of a ratio of stretches."""
    d, law = dimension, VonMises([metal("elastic")], dimension)
    x = np.array([0.0, 0.1, 1.0, 3.0, 5.0])
    F = diagonal(x / 2, -x / 2, 0.0, dimension=d)
    found = largest_stiffness(probes(d, "elastic"), F)
    shear = np.where(x > 0, 2 * MU * x / np.tanh(np.maximum(x, 1e-9)), 2 * MU)
    assert found == pytest.approx(np.maximum(shear, d * LAMBDA + 2 * MU), rel=1e-6)
    for k in range(5):
        normal, tangential, bulk = law.modes(metal("elastic"), StateBound(1.0, 1.0, float(np.exp(x[k]))))
        assert normal.stiffness == pytest.approx(d * LAMBDA + 2 * MU)
        assert bulk.stiffness >= LAMBDA + 2 * MU * (1 + 1.2 * x[k] / 2) * (1 - 1e-12)
        # In 3D two stretches may be the largest together, and the third makes up for both.
        bound = x[k] * (1.0 if d == 2 else 1.5)
        assert tangential.stiffness == pytest.approx(2 * MU * (bound / math.tanh(bound) if bound else 1.0))
    flat = law.modes(metal("elastic"), StateBound(0.0, 1.0, 1.0))[1].stiffness
    assert shear[-1] < flat < math.inf


def check_wild(probe: LawProbe) -> None:
    """Nothing is NaN, and no stress is beyond yield."""
    once = probe(wild(probe.dimension))
    twice = probe(once.deformation, once.internal)
    assert_finite(once, twice)
    for answer in (once, twice):
        limit = YIELD + probe.law.members[0].hardening_modulus * strain_of(answer)
        assert (mises(answer.tau) <= limit + 1e-5 * np.abs(answer.tau).max()).all()


@BOTH
@pytest.mark.parametrize("kind", ["hardening", "perfect"])
def test_metal_stays_finite(probes: Probes, kind: str, dimension: int) -> None:
    check_wild(probes(dimension, kind))


def test_the_modulus_is_as_soft_as_the_scene_and_the_strength_allow() -> None:
    """E = 200 yield_stress at least, and that of the weight and the speed where those are more."""
    speed = math.sqrt(2 * 9.81)
    soft = VonMisesParameters(density=1800.0, youngs_modulus="auto", yield_stress=1e3, poissons_ratio=0.4)
    for d in (2, 3):
        chosen, notes = soft.resolve(SceneBounds(d, 0.05, 9.81, speed, 1.0))
        bulk = chosen.lame_lambda + 2 * chosen.shear_modulus / d
        assert bulk == pytest.approx(1800 * 3 * 9.81 / 0.01)
        assert "1 %" in notes[0] and f"{chosen.youngs_modulus:.4g} Pa" in notes[0]
    strong = soft.model_copy(update={"yield_stress": 5e6})
    chosen, notes = strong.resolve(SceneBounds(2, 0.05, 9.81, speed, 1.0))
    assert chosen.youngs_modulus == pytest.approx(1e9) and "0.5 %" in notes[0]
    assert metal("perfect").resolve(SceneBounds(2, 0.05, 9.81, speed, 1.0)) == (metal("perfect"), [])


def test_single_precision(backend_of: Callable) -> None:
    """In f32: wild states, and stress on the yield surface to 3e-6 of E. Comes last: it ends the other backend."""
    backend_of("f32", 1)
    for d in (2, 3):
        probe = LawProbe(VonMises, metal("hardening"), d)
        check_wild(probe)
        answer = probe(states(d))
        assert (mises(answer.tau) - YIELD - HARDENING * strain_of(answer)).max() < 3e-6 * MODULUS
