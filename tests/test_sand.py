"""Sand (docs/theory.md, 5.7): return mapping, effective friction angle, cohesion, volume, extreme states."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import taichi as ti
from law_probe import LawProbe, Probes, Response, assert_finite, stretched, wild
from law_tangent import largest_stiffness
from pydantic import ValidationError
from scenes import body, scene_of

from mpmcli.materials.law import StateBound
from mpmcli.materials.sand import BEHIND, REAL_MODULUS, Sand, SandParameters
from mpmcli.scene.material import SceneBounds

BOTH = pytest.mark.parametrize("dimension", [2, 3])
# Klar et al. 2016.
MODULUS = 3.537e5
KINDS = {
    "dry": {"friction_angle": 30.0},
    "damp": {"friction_angle": 35.0, "cohesion": 500.0},
    "delayed": {"friction_angle": 30.0, "friction_delay": 2e-3},
    "uncorrected": {"friction_angle": 30.0, "volume_correction": False},
}
LARGEST_STRESS = 1e-12 * MODULUS


def sand(**values: float | bool) -> SandParameters:
    return SandParameters(density=1600.0, **{"youngs_modulus": MODULUS, **values})


def bulk(parameters: SandParameters, d: int) -> float:
    """Return lambda + 2 mu / d: minus the mean stress in the plane or in space, per volume strain."""
    return parameters.lame_lambda + 2 * parameters.shear_modulus / d


@pytest.fixture(scope="module")
def probes(backend_of: Callable) -> Probes:
    """Probes in double precision."""
    backend_of("f64", 1)
    return Probes(lambda kind: sand(**KINDS[kind]))


def strained(e: np.ndarray, seed: int = 1) -> np.ndarray:
    """Return F (n, d, d) with principal Hencky strains e (n, d), along random axes and turned at random."""
    return stretched(np.exp(e), seed)


def strains(F: np.ndarray) -> np.ndarray:
    """Return the Hencky strain tensors (n, d, d): half the logarithm of F F^T."""
    squares, axes = np.linalg.eigh(F @ F.transpose(0, 2, 1))
    return axes * (np.log(squares) / 2)[:, None, :] @ axes.transpose(0, 2, 1)


def parts(e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return traces (n,) and deviators (n, d, d) of tensors (n, d, d)."""
    d = e.shape[-1]
    trace = np.einsum("nii->n", e)
    return trace, e - trace[:, None, None] / d * np.eye(d)


def lengths(e: np.ndarray) -> np.ndarray:
    return np.sqrt((e**2).sum(axis=(1, 2)))


def plane_stress(answer: Response, d: int) -> np.ndarray:
    return answer.tau[:, :d, :d]


def shear_strength(parameters: SandParameters, d: int, pressure: np.ndarray) -> np.ndarray:
    """Return the |dev tau| at which sand slides: sqrt(2) (p sin(phi) + c cos(phi))."""
    phi = math.radians(parameters.friction_angle)
    return math.sqrt(2) * (pressure * math.sin(phi) + parameters.cohesion * math.cos(phi))


def states(d: int, count: int = 500) -> np.ndarray:
    """Return Hencky strains (n, d) on all sides of the cone: pressed and pulled, hardly and much sheared."""
    random = np.random.default_rng(d)
    sheared = random.normal(size=(count, d)) * 10 ** random.uniform(-4, -1, (count, 1))
    return sheared + random.normal(size=(count, 1)) * 10 ** random.uniform(-4, -1, (count, 1))


@BOTH
@pytest.mark.parametrize("kind", ["dry", "damp"])
def test_return_mapping(probes: Probes, kind: str, dimension: int) -> None:
    """Inside the cone bitwise unchanged; past its tip at the tip; else on the cone, volume kept; and tau of it."""
    d, parameters = dimension, sand(**KINDS[kind])
    probe = probes(d, kind)
    F = strained(states(d))
    answer = probe(F)
    trial, trial_deviator = parts(strains(F))
    kept, deviator = parts(strains(answer.deformation))
    K, mu = bulk(parameters, d), parameters.shear_modulus
    tip = parameters.cohesion / (math.tan(math.radians(parameters.friction_angle)) * K)
    limit = shear_strength(parameters, d, -K * np.minimum(trial, tip)) / (2 * mu)
    torn = trial > tip
    slides = ~torn & (lengths(trial_deviator) > limit)
    inside = ~torn & ~slides
    assert min(torn.sum(), slides.sum(), inside.sum()) > 30
    assert np.array_equal(answer.deformation[inside], F[inside])
    assert not answer.internal[~torn, 0].any()
    # 7.2 (iii): non-associative, on the cone, along the direction of the trial shear.
    assert np.abs(kept - trial)[slides].max() < 1e-12
    assert np.abs(lengths(deviator) - limit)[slides].max() < 1e-12
    scale = (limit / lengths(trial_deviator))[:, None, None]
    assert np.abs(deviator - scale * trial_deviator)[slides].max() < 1e-12
    # 7.2 (i): the tip is free of shear, and what was taken is remembered.
    assert np.abs(kept[torn] - tip).max() < 1e-12
    assert lengths(deviator[torn]).max() < 1e-12
    assert np.abs(answer.internal[torn, 0] + tip - trial[torn]).max() < 1e-12
    hooke = 2 * mu * strains(answer.deformation) + parameters.lame_lambda * kept[:, None, None] * np.eye(d)
    assert np.abs(plane_stress(answer, d) - hooke).max() < 1e-11 * MODULUS
    energy = mu * (strains(answer.deformation) ** 2).sum(axis=(1, 2)) + parameters.lame_lambda / 2 * kept**2
    assert np.abs(answer.energy - energy).max() < 1e-12 * MODULUS


@BOTH
@pytest.mark.parametrize("kind", ["dry", "damp", "uncorrected"])
def test_what_was_returned_stays(probes: Probes, kind: str, dimension: int) -> None:
    """7.2 (iv): a second return changes nothing to 1e-12, from states that remember some opening too."""
    probe = probes(dimension, kind)
    opened = np.random.default_rng(3).uniform(0, 0.05, (500, 1)) * (np.arange(500) % 2)[:, None]
    once = probe(strained(states(dimension)), opened)
    twice = probe(once.deformation, once.internal)
    assert np.abs(twice.deformation - once.deformation).max() < 1e-12
    assert np.abs(twice.internal - once.internal).max() < 1e-12
    assert np.abs(twice.tau - once.tau).max() < 1e-11 * MODULUS


@BOTH
@pytest.mark.parametrize("kind", ["dry", "damp", "uncorrected"])
def test_total_volume_is_never_lost(probes: Probes, kind: str, dimension: int) -> None:
    """ln J = tr e + v before and after any return, and total_volume_ratio says J."""
    probe = probes(dimension, kind)
    opened = np.random.default_rng(3).uniform(0, 0.05, (500, 1))
    F = strained(states(dimension))
    answer = probe(F, opened)
    total = np.log(np.linalg.det(F)) + opened[:, 0]
    J = np.linalg.det(answer.deformation)
    assert np.abs(np.log(J) + answer.internal[:, 0] - total).max() < 1e-12
    ratio = probe.law.total_volume_ratio(J, {"plastic_volume_strain": answer.internal[:, 0]})
    assert np.abs(np.log(ratio) - total).max() < 1e-12
    assert (answer.internal[:, 0] >= 0).all()


def squeezed(probe: LawProbe, start: float, end: float, steps: int, F: np.ndarray, v: np.ndarray) -> tuple:
    """Bring ln J from `start` to `end` in equal steps; return ln J, pressures (steps,), and the last F and v."""
    d = probe.dimension
    volumes = np.linspace(start, end, steps + 1)
    pressures = []
    for change in np.diff(volumes):
        answer = probe(np.exp(change / d) * F, v)
        F, v = answer.deformation, answer.internal
        pressures.append(-np.trace(plane_stress(answer, d)[0]) / d)
    return volumes[1:], np.array(pressures), F, v


@BOTH
def test_opened_sand_closes_before_it_bears_pressure(probes: Probes, dimension: int) -> None:
    """7.2 (i), H16: opened to J = 1.05 and closed there is no pressure until J = 1; without correction at once.

    Stirred ten times, uncorrected sand takes up half as much volume again.
    """
    d, K = dimension, bulk(sand(friction_angle=30.0), dimension)
    rest, gap = np.eye(d)[None], math.log(1.05)
    for kind in ("dry", "uncorrected"):
        probe = probes(d, kind)
        F, v = rest, np.zeros((1, 1))
        for _ in range(10):
            _, open_pressures, F, v = squeezed(probe, 0.0, gap, 7, F, v)
            volumes, pressures, F, v = squeezed(probe, gap, 0.0, 7, F, v)
            if kind == "dry":
                assert np.abs(open_pressures).max() < LARGEST_STRESS
                assert np.abs(pressures).max() < LARGEST_STRESS
                assert np.abs(v).max() < 1e-12
        if kind == "dry":
            assert np.abs(F - rest).max() < 1e-12
            volumes, pressures, F, v = squeezed(probe, 0.0, -0.01, 5, F, v)
            assert np.abs(pressures + K * volumes).max() < LARGEST_STRESS
        else:
            assert np.abs(pressures - K * (gap - volumes)).max() < LARGEST_STRESS
            assert v[0, 0] == pytest.approx(gap, abs=1e-12), "closing squeezes it, and opening lets it go again"
    # Let go of its pressure after each closing, it grows by the gap each time.
    F, v = rest, np.zeros((1, 1))
    for _ in range(10):
        _, _, F, v = squeezed(probe, 0.0, gap, 7, rest, v)
    assert v[0, 0] == pytest.approx(10 * gap)


def shearing(dimension: int, members: list[SandParameters], simple: bool) -> np.ndarray:
    """Return tau (n, d, d) of each sand pressed to eps = -1e-3 I and sheared, at constant volume, in 400 steps."""
    d, law = dimension, Sand(members, dimension)
    table = ti.Vector.field(7, float, shape=len(members))
    table.from_numpy(np.array([law.constants(member) for member in members]))
    step = np.eye(d)
    if simple:
        step[0, 1] = 2e-4
    else:
        step[0, 0], step[1, 1] = math.exp(1e-4), math.exp(-1e-4)

    @ti.kernel
    def run(increment: ti.types.ndarray(), out: ti.types.ndarray()):
        for p in table:
            A = ti.Matrix.zero(float, d, d)
            for i, j in ti.static(ti.ndrange(d, d)):
                A[i, j] = increment[i, j]
            F = ti.exp(-1e-3) * ti.Matrix.identity(float, d)
            variables = ti.Vector([0.0, 0.0])
            tau = ti.Matrix.zero(float, d, d)
            for _ in range(400):
                tau, _tau_zz, F, variables = law.respond(A @ F, variables, tau, 0.0, table[p])
            for i, j in ti.static(ti.ndrange(d, d)):
                out[p, i, j] = tau[i, j]

    out = np.zeros((len(members), d, d))
    run(step, out)
    return out


@BOTH
def test_the_friction_angle_acts(probes: Probes, dimension: int) -> None:
    """7.1: sheared at constant volume in plane strain, sin(phi) = (tau_1 - tau_2) / -(tau_1 + tau_2), to 6 digits.

    Klar's alpha = sqrt(2/3) 2 sin(phi) / (3 - sin(phi)) would give 17.3, 27.5, 39.0, 45.4 for 20, 30, 40, 45 in 2D, and
    26.5, 43.9, 70.8 in 3D, where it never yields from 42.2 on.
    """
    angles = [20.0, 30.0, 40.0, 45.0, 55.0]
    members = [sand(friction_angle=angle) for angle in angles]
    for simple in (False, True):
        tau = shearing(dimension, members, simple)
        low, high = np.linalg.eigvalsh(tau[:, :2, :2]).T
        reached = np.degrees(np.arcsin((high - low) / -(high + low)))
        assert np.abs(reached - angles).max() < 1e-4
        if dimension == 3:
            assert np.abs(tau[:, 2, 2] - (low + high) / 2).max() < 1e-9 * MODULUS


def test_friction_follows_the_pressure_after_a_delay(probes: Probes) -> None:
    """p sin(phi) with T dp_d/dt = p - p_d, implicitly, p_d within 2 % of p.

    The normal stress of what slides sets its strength after a time (Prakash 1998).
    """
    probe, strain, dt, ratios = probes(2, "delayed"), 1e-3, 1e-3, np.array([0.0, 0.1, 0.99, 1.01, 9.0])
    parameters = probe.law.members[0]
    F = strained(np.tile([0.1 - strain / 2, -0.1 - strain / 2], (len(ratios), 1)))
    before = np.stack([0 * ratios, -strain * ratios], 1)
    answer = probe(F, before, dt=dt)
    delayed = np.clip(ratios + (1 - ratios) * dt / (dt + parameters.friction_delay), 1 / BEHIND, BEHIND)
    assert answer.internal[:, 1] == pytest.approx(-strain * delayed, rel=1e-12)
    _, deviator = parts(plane_stress(answer, 2))
    limit = shear_strength(parameters, 2, bulk(parameters, 2) * strain * delayed)
    assert lengths(deviator) == pytest.approx(limit, rel=1e-9)


def test_stress_out_of_the_plane(probes: Probes) -> None:
    """In 2D tau_zz is the mean of the stresses in the plane, so that -tr tau / 3 is the pressure of the cone."""
    tau = probes(2, "dry")(strained(states(2))).tau
    assert np.abs(tau[:, 2, 2] - (tau[:, 0, 0] + tau[:, 1, 1]) / 2).max() < LARGEST_STRESS


@BOTH
def test_cohesion(probes: Probes, dimension: int) -> None:
    """Without pressure it bears a shear of c cos(phi); pulled apart c cot(phi) on all sides, as long as it tears."""
    d, parameters = dimension, sand(**KINDS["damp"])
    probe, phi, c = probes(d, "damp"), math.radians(parameters.friction_angle), parameters.cohesion
    sheared = probe(np.diag([math.exp(0.1), math.exp(-0.1), 1.0][:d])[None]).tau[0]
    assert (sheared[0, 0] - sheared[1, 1]) / 2 == pytest.approx(c * math.cos(phi), rel=1e-12)
    assert np.abs(sheared.trace()) < LARGEST_STRESS
    torn = probe(np.array([1.01, 1.3, 3.0])[:, None, None] * np.eye(d))
    assert np.abs(torn.tau[:, :d, :d] - c / math.tan(phi) * np.eye(d)).max() < 1e-9 * c
    # Let go, it unloads elastically, and closes what had opened without any stress.
    tip = c / (math.tan(phi) * bulk(parameters, d))
    _, pressures, _, v = squeezed(probe, 0.0, -tip, 4, torn.deformation[1:2], torn.internal[1:2])
    assert pressures == pytest.approx(-bulk(parameters, d) * tip * np.array([0.75, 0.5, 0.25, 0.0]), abs=1e-6)
    assert v[0, 0] == pytest.approx(torn.internal[1, 0], abs=1e-12)


@BOTH
def test_modes_are_the_tangent(probes: Probes, dimension: int) -> None:
    """Inside the cone the stiffest tangent is the stiffest mode of that very state, whatever its pressure.

    The last mode is that of bulk: the tangent of a plane wave and 1.2 times the largest pressure (docs/theory.md, 6.6).
    """
    d, parameters = dimension, sand(**KINDS["dry"])
    pressed = np.full((8, d), -np.logspace(-4, 0, 8)[:, None])
    pressed[4:, 0] *= 1.2
    F = strained(pressed)
    found = largest_stiffness(probes(d, "dry"), F)
    law = Sand([parameters], d)
    for k in range(8):
        J, largest = float(np.linalg.det(F[k])), float(np.linalg.norm(F[k], 2) ** 2)
        *lone, bulk = (mode.stiffness for mode in law.modes(parameters, StateBound(J, J, largest)))
        stated = max(lone)
        assert stated == pytest.approx(found[k], rel=1e-5)
        assert stated == pytest.approx(d * parameters.lame_lambda + 2 * parameters.shear_modulus)
        pressure = -probes(d, "dry")(F[k : k + 1]).tau[0, :d, :d].diagonal().min()
        least = parameters.lame_lambda + 2 * parameters.shear_modulus + 1.2 * pressure
        # The bound knows no more of the least stretch than J and the largest one.
        assert least * (1 - 1e-9) <= bulk <= 1.2 * least


def check_wild(probe: LawProbe) -> None:
    """Nothing is NaN, no stress leaves the cone, and a second look finds the same.

    Of a stretch of 1e-4 a matrix in f32, which has ones beside it, keeps three digits: 1e-4 of its logarithm.
    """
    d = probe.dimension
    once = probe(wild(d))
    twice = probe(once.deformation, once.internal)
    assert_finite(once, twice)
    for answer in (once, twice):
        mean, deviator = parts(plane_stress(answer, d))
        limit = shear_strength(probe.law.members[0], d, -mean / d)
        assert (lengths(deviator) <= limit + 1e-5 * (MODULUS + np.abs(mean))).all()
    assert np.abs(twice.tau - once.tau).max() < 1e-4 * (MODULUS + np.abs(once.tau).max())


@BOTH
@pytest.mark.parametrize("kind", ["dry", "damp", "uncorrected"])
def test_sand_stays_finite(probes: Probes, kind: str, dimension: int) -> None:
    """H17: crushed to 1 %, torn, flat, inverted, or nothing at all."""
    check_wild(probes(dimension, kind))


@pytest.mark.parametrize("angle", [0.0, -5.0, 90.0, 120.0])
def test_angles_that_are_none_are_refused(angle: float) -> None:
    with pytest.raises(ValidationError, match="than"):
        sand(friction_angle=angle)


def test_a_heap_says_its_friction_angle() -> None:
    """sin(phi) = tan(repose), 35.26 degrees of 30, in place of a preset's; not beside one that is given."""
    parameters = sand(repose_angle=30.0)
    assert math.sin(math.radians(parameters.friction_angle)) == pytest.approx(1 / math.sqrt(3), rel=1e-12)
    assert SandParameters.model_validate(parameters.model_dump()) == parameters
    box = {"box": {"min": [0.0, 0.0], "max": [0.5, 0.5]}}
    heap = body("heap", {"preset": "sand", "repose_angle": 30.0}, box)
    scene = scene_of(heap, domain={"size": [1.0, 1.0], "spacing": 0.1})
    assert scene.bodies[0].material.friction_angle == parameters.friction_angle
    with pytest.raises(ValidationError, match="sets friction_angle, which is given as well"):
        sand(repose_angle=30.0, friction_angle=30.0)
    with pytest.raises(ValidationError, match="sets friction_angle, which is given as well"):
        SandParameters.model_validate({"density": 1600.0, "repose_angle": 30.0, "friction_angle": "35"})
    with pytest.raises(ValidationError, match=r"at most 40.8 degrees in 3D.*; found 42"):
        SandParameters.model_validate({"density": 1600.0, "repose_angle": 42.0}, context={"dimension": 3})
    for bad, why in ((45.0, "less than 45"), (0.0, "greater than 0"), ("30", "number")):
        with pytest.raises(ValidationError, match=why) as found:
            SandParameters.model_validate({"density": 1600.0, "repose_angle": bad})
        assert found.value.error_count() == 1


def test_angles_that_a_cone_cannot_have_are_refused() -> None:
    """In 3D p (1 - 2 sin(phi) / sqrt(3)) is the least pressure in triaxial extension: tension from 60 degrees on."""
    values = {"density": 1600.0, "friction_angle": 63.0}
    for context in (None, {"dimension": 2}, {"dimension": None}):
        assert SandParameters.model_validate(values, context=context).friction_angle == 63
    with pytest.raises(ValidationError, match=r"at most 60 degrees in 3D.*; found 63"):
        SandParameters.model_validate(values, context={"dimension": 3})
    assert SandParameters.model_validate(values | {"friction_angle": 60.0}, context={"dimension": 3})
    for angle, pulled in ((59.0, False), (61.0, True)):
        parameters = sand(friction_angle=angle)
        p = 1.0
        deviator = shear_strength(parameters, 3, np.array(p)) * np.array([1.0, 1.0, -2.0]) / math.sqrt(6)
        assert (p + deviator.min() < 0) == pulled


def test_the_modulus_is_as_soft_as_the_scene_allows() -> None:
    """lambda + 2 mu / d = density (g H + v^2) / compressibility; at least 500 rho g H (7.5); at most real sand."""
    speed = math.sqrt(2 * 9.81)
    for d in (2, 3):
        parameters = SandParameters(density=1600.0, friction_angle=30.0)
        chosen, notes = parameters.resolve(SceneBounds(d, 0.05, 9.81, speed, 1.0))
        assert bulk(chosen, d) == pytest.approx(1600 * 3 * 9.81 / 0.002)
        assert bulk(chosen, d) > 500 * 1600 * 9.81
        assert "0.2 %" in notes[0] and f"{chosen.youngs_modulus:.4g} Pa" in notes[0]
        deep, notes = parameters.resolve(SceneBounds(d, 0.05, 9.81, 10 * speed, 100.0))
        assert deep.youngs_modulus == REAL_MODULUS and "real sand" in notes[0]
        still, _ = parameters.resolve(SceneBounds(d, 0.05, 0.0, 0.0, 1.0))
        assert 0 < still.youngs_modulus < math.inf
    stone, notes = sand(friction_angle=30.0, cohesion=1e6, youngs_modulus="auto").resolve(
        SceneBounds(2, 0.05, 9.81, speed, 1.0)
    )
    assert stone.youngs_modulus == pytest.approx(2e8) and "cohesion" in notes[0]
    given = sand(friction_angle=30.0)
    delayed, notes = given.resolve(SceneBounds(2, 0.05, 9.81, speed, 1.0))
    assert notes == [] and delayed == given.model_copy(update={"friction_delay": 1.0 / given.sound_speed})


def test_single_precision(backend_of: Callable) -> None:
    """In f32: wild states, no volume lost to 2e-6, stress on the cone. Comes last: it ends the other backend."""
    backend_of("f32", 1)
    for d in (2, 3):
        probe = LawProbe(Sand, sand(**KINDS["damp"]), d)
        check_wild(probe)
        F = strained(states(d)).astype(np.float32).astype(np.float64)
        answer = probe(F)
        volume = np.log(np.linalg.det(answer.deformation)) + answer.internal[:, 0]
        assert np.abs(volume - np.log(np.linalg.det(F))).max() < 2e-6
        mean, deviator = parts(plane_stress(answer, d))
        limit = shear_strength(probe.law.members[0], d, -mean / d)
        assert (lengths(deviator) - limit).max() < 2e-6 * MODULUS
