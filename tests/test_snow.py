"""Snow against its closed form (docs/theory.md, 5.6), packing, breaking, and hard states."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from law_probe import LawProbe, Probes, Response, rotations, stretched
from law_tangent import largest_stiffness
from pydantic import ValidationError

from mpmcli.materials.law import StateBound
from mpmcli.materials.snow import FOCUS, Snow, SnowParameters
from mpmcli.scene.material import SceneBounds

PARAMETERS = SnowParameters(density=400.0)
MU, LAMBDA = PARAMETERS.shear_modulus, PARAMETERS.lame_lambda
LOW, HIGH = 1 - 0.025, 1 + 0.0075
# Path, stretch, and J_P, h, tau_11 and sigma_11 by the formulas of docs/theory.md, 5.6, to six digits.
TABLE = [
    ("uniaxial", 0.99, 1, 1, -1540.0, -1555.5556),
    ("uniaxial", 0.97, 0.99487179, 1.05262, -3991.1832, -4114.6219),
    ("uniaxial", 0.95, 0.97435897, 1.292283, -4899.9056, -5157.7953),
    ("uniaxial", 0.90, 0.92307692, 2.158106, -8182.8168, -9092.0187),
    ("uniaxial", 0.80, 0.82051282, 6.018703, -22820.9157, -28526.1446),
    ("uniaxial", 1.005, 1, 1, 781.6667, 777.7778),
    ("uniaxial", 1.05, 1.04218362, 0.655841, 770.887, 734.1781),
    ("isotropic 2D", 0.95, 0.94937541, 1.659051, -7746.2463, -8583.0984),
    ("isotropic 2D", 0.90, 0.85207101, 4.389828, -20496.4649, -25304.2776),
    ("isotropic 3D", 0.95, 0.92503245, 2.116313, -11597.5431, -13526.8035),
    ("isotropic 3D", 0.90, 0.78652708, 8.454756, -46332.6533, -63556.4517),
    ("isotropic 3D", 0.80, 0.55240311, 87.879707, -481586.9, -940599.4),
]


@pytest.fixture(scope="module", params=["f64", "f32"])
def probes(backend_of: Callable, request: pytest.FixtureRequest) -> Probes:
    backend_of(request.param)
    return Probes(lambda: PARAMETERS, request.param)


def closed_form(stretches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return J_P (n) and the principal tau (n, 3) after stretches (n, d) reached monotonically from rest."""
    elastic = np.clip(stretches, LOW, HIGH)
    J = elastic.prod(axis=1)
    J_P = np.clip(stretches.prod(axis=1) / J, *PARAMETERS.plastic_range)
    h = np.exp(PARAMETERS.hardening * (1 - J_P))
    full = np.ones((len(J), 3))
    full[:, : stretches.shape[1]] = elastic
    return J_P, h[:, None] * (2 * MU * (full - 1) * full + (LAMBDA * (J - 1) * J)[:, None])


def table_state(path: str, stretch: float, d: int) -> np.ndarray:
    F = np.full(d, stretch) if path.startswith("isotropic") else np.array([stretch, 1.0, 1.0][:d])
    return np.diag(F)


def follow(probe: LawProbe, F: np.ndarray, increments: int) -> Response:
    """Return the response at F (n, d, d), diagonal, after this many increments of equal ratio from rest."""
    n, d = len(F), probe.dimension
    ratio = np.array([np.diag(np.diag(f) ** (1 / increments)) for f in F])
    state, internal = np.tile(np.eye(d), (n, 1, 1)), None
    for _ in range(increments):
        answer = probe(ratio @ state, internal)
        state, internal = answer.deformation, answer.internal
    return answer


@pytest.mark.parametrize("d", [2, 3])
def test_every_row_of_the_table(probes: Probes, d: int) -> None:
    """J_P, h, tau, sigma of TABLE: all digits as tabulated; as formulas to 1e-10 in f64 and 1e-5 in f32."""
    rows = [row for row in TABLE if row[0] in ("uniaxial", f"isotropic {d}D")]
    F = np.array([table_state(path, stretch, d) for path, stretch, *_ in rows]).astype(probes.real).astype(float)
    answer = probes(d)(F)
    stretches = np.einsum("nii->ni", F)
    J_P, tau = closed_form(stretches)
    tolerance = {np.float64: 1e-10, np.float32: 1e-5}[probes.real]
    assert np.abs(answer.internal[:, 0] / J_P - 1).max() < tolerance
    assert (np.abs(answer.tau - tau[:, :, None] * np.eye(3)).max(axis=(1, 2)) < tolerance * np.abs(tau[:, 0])).all()
    written = np.array([row[2:] for row in rows])
    total = probes(d).law.total_volume_ratio(
        np.linalg.det(answer.deformation), {"plastic_volume_ratio": answer.internal[:, 0]}
    )
    assert total == pytest.approx(stretches.prod(axis=1), rel=10 * probes.epsilon)
    h = np.exp(PARAMETERS.hardening * (1 - answer.internal[:, 0]))
    found = np.stack([answer.internal[:, 0], h, answer.tau[:, 0, 0], answer.tau[:, 0, 0] / total], axis=1)
    assert np.abs(found / written - 1).max() < {np.float64: 1e-6, np.float32: 5e-5}[probes.real]


@pytest.mark.parametrize("d", [2, 3])
def test_increments_do_not_matter(probes: Probes, d: int) -> None:
    """1 or 1000 increments along a path give the same stress and J_P, to 1e-10 in f64."""
    F = np.array([table_state(path, stretch, d) for path, stretch, *_ in TABLE])
    once, often = follow(probes(d), F, 1), follow(probes(d), F, 1000)
    # Rounding of 1000 increments, and of as many projections.
    tolerance = {np.float64: 1e-10, np.float32: 3e-3}[probes.real]
    scale = np.abs(once.tau).max(axis=(1, 2))
    assert (np.abs(often.tau - once.tau).max(axis=(1, 2)) < tolerance * scale).all()
    assert np.abs(often.internal - once.internal).max() < tolerance / 10


@pytest.mark.parametrize("d", [2, 3])
def test_axes_do_not_matter(probes: Probes, d: int) -> None:
    """F -> Q F turns tau to Q tau Q^T, and F -> F Q changes nothing, with J_P as the closed form has it."""
    stretches = np.random.default_rng(1).uniform(0.85, 1.1, (1000, d))
    J_P, principal = closed_form(stretches)
    Q = rotations(np.random.default_rng(2), 1000, d)
    answer = probes(d)(Q * stretches[:, None, :] @ rotations(np.random.default_rng(3), 1000, d))
    expected = Q * principal[:, None, :d] @ Q.transpose(0, 2, 1)
    size = (2 * MU + d * LAMBDA) * np.exp(10 * (1 - J_P))
    assert (np.abs(answer.tau[:, :d, :d] - expected).max(axis=(1, 2)) < 20 * probes.epsilon * size).all()
    assert np.abs(answer.internal[:, 0] - J_P).max() < 20 * probes.epsilon
    if d == 2:
        assert (np.abs(answer.tau[:, 2, 2] - principal[:, 2]) < 20 * probes.epsilon * size).all()


@pytest.mark.parametrize("d", [2, 3])
def test_unloading_frees_of_stress_and_keeps_the_packing(probes: Probes, d: int) -> None:
    """From F = 0.9 by 1/0.975: no stress, and J_P stays."""
    packed = probes(d)(0.9 * np.eye(d)[None])
    free = probes(d)(packed.deformation / LOW, packed.internal)
    assert np.abs(free.tau).max() < 5 * probes.epsilon * 10 * (2 * MU + d * LAMBDA)
    assert np.array_equal(free.internal, packed.internal)


@pytest.mark.parametrize("d", [2, 3])
def test_inside_the_bounds_nothing_changes_and_projections_settle(probes: Probes, d: int) -> None:
    """Elastic states come back bitwise as they were, and so does every projected one."""
    random = np.random.default_rng(4)
    inside = stretched(random.uniform(LOW, HIGH, (2000, d)), 5)
    inside = inside.astype(probes.real).astype(float)
    internal = random.uniform(0.6, 1.4, (2000, 1)).astype(probes.real).astype(float)
    answer = probes(d)(inside, internal)
    assert np.array_equal(answer.deformation, inside)
    assert np.array_equal(answer.internal, internal)
    outside = stretched(random.uniform(0.7, 1.3, (2000, d)), 7)
    once = probes(d)(outside, internal)
    again = probes(d)(once.deformation, once.internal)
    assert np.array_equal(again.deformation, once.deformation)
    assert np.array_equal(again.internal, once.internal)


@pytest.mark.parametrize("d", [2, 3])
def test_energy(probes: Probes, d: int) -> None:
    """h (mu sum (s_i - 1)^2 + lambda/2 (J_E - 1)^2) of the projected state."""
    stretches = np.random.default_rng(9).uniform(0.9, 1.05, (500, d))
    J_P, _ = closed_form(stretches)
    s = np.clip(stretches, LOW, HIGH)
    expected = MU * ((s - 1) ** 2).sum(axis=1) + LAMBDA / 2 * (s.prod(axis=1) - 1) ** 2
    expected *= np.exp(10 * (1 - J_P))
    answer = probes(d)(stretched(stretches, 10))
    assert np.abs(answer.energy / expected - 1).max() < 100 * probes.epsilon / 0.0075


@pytest.mark.parametrize("d", [2, 3])
def test_hard_states_are_defined(probes: Probes, d: int) -> None:
    """Crushed, torn, inverted and empty: finite, h within its limits, J_P within its bounds."""
    low, high = PARAMETERS.plastic_range
    eye = np.eye(d)
    mirror = np.diag([-1.0] + [1.0] * (d - 1))
    flat = np.diag([1.0] * (d - 1) + [0.0])
    F = np.array([0.5 * eye, 0.01 * eye, 3 * eye, 0 * eye, mirror, -0.9 * eye, flat, 1e-6 * eye, 1e4 * eye])
    F = np.concatenate([F, np.random.default_rng(12).normal(size=(200, d, d)) ** 3])
    internal = None
    for _ in range(3):
        answer = probes(d)(F, internal)
        assert np.isfinite(answer.tau).all()
        assert np.isfinite(answer.energy).all()
        s = np.linalg.svd(answer.deformation)[1]
        assert s.min() > LOW - 1e-5
        assert s.max() < HIGH + 1e-5
        assert (np.abs(answer.internal - 1) <= max(1 - low, high - 1) * (1 + 1e-6)).all()
        assert np.abs(answer.tau).max() < PARAMETERS.hardening_limit * (2 * MU + d * LAMBDA) * 0.1
        F, internal = F @ answer.deformation, answer.internal
    crushed = probes(d)(0.01 * eye[None])
    assert crushed.internal[0, 0] == pytest.approx(low)
    assert PARAMETERS.hardness(low) == pytest.approx(100)
    assert PARAMETERS.hardness(high) == pytest.approx(0.01)
    assert probes(d)(3 * eye[None]).internal[0, 0] == pytest.approx(high)
    assert not probes(d)(mirror[None]).tau.any()


@pytest.mark.parametrize("d", [2, 3])
def test_stiffness_bounds_every_state(probes: Probes, d: int) -> None:
    """`modes` is exact at rest, d lambda + 2 mu, and bounds the differentiated stress of packing and torn states.

    Also where packing is stiffer than the snow itself: with a wide elastic range and strong hardening.
    """
    if probes.real == np.float32:
        pytest.skip("differences of f32 say nothing")
    law = probes(d).law
    assert law.modes(PARAMETERS, StateBound())[0].stiffness == pytest.approx(d * LAMBDA + 2 * MU)
    assert largest_stiffness(probes(d), np.eye(d)[None])[0] == pytest.approx(d * LAMBDA + 2 * MU, rel=1e-6)
    strong = PARAMETERS.model_copy(update={"critical_compression": 0.2, "hardening": 30.0})
    stiffer = 0
    for parameters, probe in ((PARAMETERS, probes(d)), (strong, LawProbe(Snow, strong, d))):
        random = np.random.default_rng(13)
        for J_P in (1.0, 0.9, 1.2):
            stretches = random.uniform(0.7, 1.1, (300, d))
            stretches[:100] = stretches[:100, :1]
            stretches[100:200, 1:] = random.uniform(LOW, HIGH, (100, d - 1))
            F = stretched(stretches, 14)
            for part in np.split(np.arange(300), 30):
                J = np.linalg.det(F[part])
                bound = StateBound(J.min(), J.max(), stretches[part].max() ** 2, {"plastic_volume_ratio": (J_P, J_P)})
                internal = np.full((len(part), 1), J_P)
                found = largest_stiffness(probe, F[part], internal, 1e-7).max()
                assert found <= law.modes(parameters, bound)[0].stiffness * (1 + 1e-6)
                elastic = d * parameters.lame_lambda + 2 * parameters.shear_modulus
                stiffer += found > 1.5 * elastic * parameters.hardness(probe(F[part], internal).internal.min())
    assert stiffer > 0


def test_stiffest_state_follows_the_scene() -> None:
    """Nothing packs at rest; a column that weighs h yield stresses packs to that h, and nothing beyond the limit."""
    law = Snow([PARAMETERS], 2)

    def packed(speed: float, height: float) -> float:
        bounds = SceneBounds(dimension=2, spacing=0.01, gravity=9.81, speed=speed, height=height)
        return law.stiffest(PARAMETERS, bounds).internal["plastic_volume_ratio"][0]

    assert packed(0.0, 0.1) == 1
    yields_at = (2 * MU + LAMBDA) * 0.025 * 0.975
    assert PARAMETERS.hardness(packed(0.0, 5 * yields_at / (400 * 9.81))) == pytest.approx(5)
    assert packed(1e3, 0.0) == pytest.approx(PARAMETERS.plastic_range[0])
    J_P = packed(5.0, 0.0)
    assert PARAMETERS.hardness(J_P) * yields_at == pytest.approx(FOCUS * 400 * 25 / (1 - J_P))
    rest = max(mode.stiffness for mode in law.modes(PARAMETERS, StateBound()))
    bounds = SceneBounds(dimension=2, spacing=0.01, gravity=9.81, speed=1e3, height=0.0)
    hardest = max(mode.stiffness for mode in law.modes(PARAMETERS, law.stiffest(PARAMETERS, bounds)))
    assert 100 * rest <= hardest < 110 * rest
    for changes in ({"hardening": 0.0}, {"hardening_limit": 1.0}):
        other = PARAMETERS.model_copy(update=changes)
        assert math.isfinite(law.modes(other, law.stiffest(other, bounds))[0].stiffness)
        assert other.hardness(0.3) == 1


def test_parameters() -> None:
    """Defaults are those of the paper; what snow cannot be is refused."""
    assert (PARAMETERS.youngs_modulus, PARAMETERS.poissons_ratio, PARAMETERS.hardening) == (1.4e5, 0.2, 10)
    assert pytest.approx((58333.33, 38888.89), rel=1e-6) == (MU, LAMBDA)
    for wrong in (
        {"critical_compression": 0.0},
        {"critical_stretch": -0.1},
        {"hardening": -1.0},
        {"hardening_limit": 0.5},
    ):
        with pytest.raises(ValidationError):
            SnowParameters(density=400.0, **wrong)
