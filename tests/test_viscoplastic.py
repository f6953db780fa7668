"""The viscoplastic fluid: rest below yield, Bingham and Herschel-Bulkley flow above, tearing, and hard states."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command import run_here
from law_probe import LawProbe, Probes, rotations
from law_tangent import largest_stiffness
from pydantic import ValidationError

from mpmcli.materials.law import StateBound
from mpmcli.materials.viscoplastic import CRUSHED, TEAR_STRAIN, ViscoplasticParameters
from mpmcli.output import open_result
from mpmcli.scene.material import SceneBounds

K, G, YIELD, CONSISTENCY = 1e6, 1e5, 100.0, 10.0


def parameters(**changes: object) -> ViscoplasticParameters:
    given = {"density": 1000.0, "bulk_modulus": K, "shear_modulus": G, "yield_stress": YIELD}
    return ViscoplasticParameters(**{**given, "consistency": CONSISTENCY, "tension_cutoff": True, **changes})


@pytest.fixture(scope="module", params=["f64", "f32"])
def probes(backend_of: Callable, request: pytest.FixtureRequest) -> Probes:
    backend_of(request.param)
    return Probes(parameters, request.param)


def gradients(count: int, d: int, size: float, seed: int = 1) -> np.ndarray:
    """Return F (n, d, d) with det F = 1 near I + size times noise, turned at random."""
    random = np.random.default_rng(seed)
    F = np.eye(d) + size * random.normal(size=(count, d, d))
    F[:, :, 0] *= np.sign(np.linalg.det(F))[:, None]
    F /= (np.linalg.det(F) ** (1 / d))[:, None, None]
    return rotations(random, 1, d) @ F


def trial(F: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return dev b (n, d, d), mean b (n) and q / G (n) of the isochoric b of F."""
    d = F.shape[1]
    b = np.einsum("nik,njk->nij", F, F) / (np.linalg.det(F) ** (2 / d))[:, None, None]
    mean = np.einsum("nii->n", b) / d
    dev = b - mean[:, None, None] * np.eye(d)
    return dev, mean, np.sqrt((dev**2).sum(axis=(1, 2)) / 2)


def flow(probe: LawProbe, C: np.ndarray, dt: float, steps: int) -> np.ndarray:
    """Return tau (n, 3, 3) after these steps of constant velocity gradients C (n, d, d)."""
    F = np.tile(np.eye(probe.dimension), (len(C), 1, 1))
    for _ in range(steps):
        answer = probe((np.eye(probe.dimension) + dt * C) @ F, C=C, dt=dt)
        F = answer.deformation
    return answer.tau


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("n", [1.0, 0.5, 2.0])
def test_steady_shear_flows_by_herschel_and_bulkley(probes: Probes, n: float, d: int) -> None:
    """tau_xy = yield_stress + consistency rate^n, short by the order of e (e + rate dt), e = tau/G the elastic strain.

    The implicit relaxation itself is exact in steady flow, at any step.
    """
    rates = np.array([2.0, 10.0, 30.0])
    expected = YIELD + CONSISTENCY * rates**n
    C = np.zeros((3, d, d))
    C[:, 0, 1] = rates
    dt = 1e-4
    tau = flow(probes(d, flow_index=n), C, dt, 200)
    strain = expected / G
    # A plastic rate short by e^2 leaves n e^2 of the stress.
    tolerance = 3 * max(n, 1) * strain * (strain + rates * dt) + 5 * probes.epsilon / strain
    assert (np.abs(tau[:, 0, 1] / expected - 1) < tolerance).all()


@pytest.mark.parametrize("d", [2, 3])
def test_without_yield_stress_it_is_newtonian(probes: Probes, d: int) -> None:
    """yield_stress = 0 and n = 1: tau = consistency (C + C^T) for any C without trace, to order consistency |C|/G."""
    random = np.random.default_rng(2)
    C = random.uniform(-1, 1, (20, d, d))
    C -= np.einsum("nii->n", C)[:, None, None] / d * np.eye(d)
    tau = flow(probes(d, yield_stress=0.0), C, 2e-4, 100)[:, :d, :d]
    dev = tau - np.einsum("nii->n", tau)[:, None, None] / d * np.eye(d)
    newtonian = CONSISTENCY * (C + C.transpose(0, 2, 1))
    weissenberg = CONSISTENCY * np.linalg.norm(C, axis=(1, 2)).max() / G
    assert np.abs(dev - newtonian).max() < 5 * weissenberg * np.abs(newtonian).max() + 5 * probes.epsilon * G


@pytest.mark.parametrize("d", [2, 3])
def test_below_yield_it_is_elastic_and_stands_still(probes: Probes, d: int) -> None:
    """tau = K (J - 1) I + G dev b with the state bitwise as it was, and no stress once the strain is undone."""
    probe = probes(d)
    F = gradients(500, d, 2e-4) * np.random.default_rng(3).uniform(0.97, 1.0, 500)[:, None, None]
    F = F.astype(probes.real).astype(np.float64)
    dev, _, q = trial(F)
    J = np.linalg.det(F)
    still = (q * G < 0.99 * YIELD) & (J < 1 - 1e-6)
    assert still.sum() > 100
    answer = probe(F, dt=1e3)
    assert np.array_equal(answer.deformation[still], F[still])
    tau = (K * (J - 1))[:, None, None] * np.eye(d) + G * dev
    assert np.abs(answer.tau[still][:, :d, :d] - tau[still]).max() < 10 * probes.epsilon * K
    if d == 2:
        assert np.abs(answer.tau[still][:, 2, 2] - K * (J[still] - 1)).max() < 10 * probes.epsilon * K
    shear = np.eye(d)[None].copy()
    shear[0, 0, 1] = 0.9 * YIELD / G
    there = probe(shear).deformation
    back = probe(np.linalg.inv(shear) @ there)
    assert np.abs(back.tau).max() < 10 * probes.epsilon * K


def excess(probe: LawProbe, q: np.ndarray, q_trial: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return by how much q misses q = q_trial - G time ((q - yield_stress)/consistency)^(1/n), rising with q."""
    n = probe.law.members[0].flow_index
    return q - q_trial + G * time * (np.maximum(q - YIELD, 0) / CONSISTENCY) ** (1 / n)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("n", [1.0, 0.1, 0.5, 2.0])
def test_relaxation_solves_its_equation_and_never_overshoots(probes: Probes, n: float, d: int) -> None:
    """q = q_trial - G mean(b) dt ((q - yield_stress)/consistency)^(1/n), for any step, along the trial direction.

    And so yield_stress <= q <= q_trial, falling with the step; J and det b stay as they were.
    """
    probe = probes(d, flow_index=n)
    F = np.concatenate([gradients(100, d, size, seed) for seed, size in enumerate((3e-3, 0.03, 0.3, 1.0))])
    F = (0.999 * F).astype(probes.real).astype(np.float64)
    dev, mean, q_trial = trial(F)
    usable = (q_trial * G > 1.01 * YIELD) & (mean < 20)
    F, dev, mean, q_trial = F[usable], dev[usable], mean[usable], G * q_trial[usable]
    before = q_trial
    scale = q_trial + G
    for dt in (0.0, 1e-9, 1e-6, 1e-4, 1e-2, 1.0, 1e6):
        answer = probe(F, dt=dt)
        new_dev, _, new_q = trial(answer.deformation)
        q = G * new_q
        slack = 20 * probes.epsilon * scale * mean**2
        assert (q <= before + slack).all()
        assert (q >= YIELD - slack).all()
        direction = np.abs(new_dev / new_q[:, None, None] - dev * (G / q_trial)[:, None, None]).max(axis=(1, 2))
        assert (direction * q < 5 * slack).all()
        volume = np.linalg.det(answer.deformation) / np.linalg.det(F)
        assert (np.abs(volume - 1) < 5 * probes.epsilon * mean).all()
        if probes.real == np.float64:
            left, right = (excess(probe, value, q_trial, mean * dt) for value in (q - slack, q + slack))
            assert (left <= 0).all()
            assert (right >= 0).all()
        before = q
    if n >= 0.5:
        assert (np.abs(q - YIELD) < 1e-3 * YIELD + slack).all()


@pytest.mark.parametrize("d", [2, 3])
def test_opened_it_tears_and_forgets(probes: Probes, d: int) -> None:
    """J > 1: no pressure, J back to 1, and dev b smaller by J^(-1/TEAR_STRAIN), in one opening or in twenty."""
    probe = probes(d, yield_stress=1e6)
    sheared = np.eye(d)
    sheared[0, 1] = 0.05
    J = np.array([1.001, 1.05, 1.5, 27.0])
    opened = J[:, None, None] ** (1 / d) * sheared
    answer = probe(opened)
    assert np.abs(np.linalg.det(answer.deformation) - 1).max() < 5 * probes.epsilon
    expected = G * 0.05 * J ** (-1 / TEAR_STRAIN)
    assert np.abs(answer.tau[:, 0, 1] - expected).max() < 20 * probes.epsilon * G
    assert np.abs(np.trace(answer.tau[:, :d, :d], axis1=1, axis2=2)).max() < 20 * probes.epsilon * K
    F = np.tile(sheared, (4, 1, 1))
    for _ in range(20):
        again = probe(J[:, None, None] ** (1 / d / 20) * F)
        F = again.deformation
    assert np.abs(again.tau[:, 0, 1] - expected).max() < 200 * probes.epsilon * G
    holding = probes(d, yield_stress=1e6, tension_cutoff=False)(opened)
    assert np.allclose(holding.deformation, opened, atol=2 * probes.epsilon * 3)
    pressure_part = K * (J - 1)
    assert np.trace(holding.tau[:, :d, :d], axis1=1, axis2=2) / d == pytest.approx(pressure_part, rel=1e-3)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("n", [1.0, 0.5])
def test_hard_states_are_defined(probes: Probes, n: float, d: int) -> None:
    """Crushed, torn, flat, inverted and empty states give finite stress, and a state that the next step can use."""
    random = np.random.default_rng(5)
    F = np.array([np.diag(s) for s in random.uniform(-1.0, 3.0, (100, d)) ** 5])
    last = np.eye(d)
    last[-1, -1] = 0.0
    thin = np.eye(d)
    thin[-1, -1] = 1e-6
    special = [0.5 * np.eye(d), 0.01 * np.eye(d), 3.0 * np.eye(d), 1e4 * np.eye(d), np.zeros((d, d)), last, thin]
    F = np.concatenate([F, np.array([*special, -last, np.diag([-1.0] + [1.0] * (d - 1))])])
    for dt in (1e-9, 1e-3, 1e3):
        answer = probes(d, flow_index=n)(F, dt=dt)
        assert np.isfinite(answer.tau).all()
        assert np.isfinite(answer.energy).all()
        assert (answer.energy >= 0).all()
        J = np.linalg.det(answer.deformation)
        assert (J > 0.9 * CRUSHED).all()
        assert (J < 1 + 1e-5).all()
        again = probes(d, flow_index=n)(answer.deformation, dt=dt)
        assert np.isfinite(again.tau).all()
        # Pressure keeps what it was to the rounding of a J that may be small.
        assert np.abs(np.trace(again.tau - answer.tau, axis1=1, axis2=2)).max() < 50 * probes.epsilon * K
    inverted = probes(d, flow_index=n)(np.diag([-1.0] + [1.0] * (d - 1))[None])
    assert inverted.tau[0] == pytest.approx(-K * np.eye(3), rel=1e-6)


@pytest.mark.parametrize("d", [2, 3])
def test_energy_keeps_its_digits(probes: Probes, d: int) -> None:
    """K (J - 1 - ln J) + G/2 (tr b - d), of strains down to 1e-3 and turned states too, as f64 knows it."""
    probe = probes(d, yield_stress=1e6)
    F = np.concatenate([0.999 * gradients(50, d, size) for size in (1e-3, 1e-2, 0.3)]).astype(probes.real)
    F = F.astype(np.float64)
    J = np.linalg.det(F)
    _, mean, _ = trial(F)
    fine = (mean < 5) & (J < 1)
    expected = K * (J - 1 - np.log(J)) + G / 2 * d * (mean - 1)
    energy = probe(F).energy
    tolerance = 50 * probes.epsilon / 1e-3 + 1e-9
    assert np.abs(energy[fine] / expected[fine] - 1).max() < tolerance


@pytest.mark.parametrize("d", [2, 3])
def test_stiffness_bounds_every_state(probes: Probes, d: int) -> None:
    """`modes` is exact at rest, d K for volume and 2 G for shear, and bounds flowing and sheared states.

    Relaxation only softens: the differentiated response to a step stays below the elastic bound.
    """
    if probes.real == np.float32:
        pytest.skip("differences of f32 say nothing")
    rest = 0.99 * np.eye(d)[None]
    for changes, exact in (({}, d * K * 0.99**d), ({"shear_modulus": 1e8, "yield_stress": 1e9}, 2e8)):
        probe = probes(d, **changes)
        assert largest_stiffness(probe, rest)[0] == pytest.approx(exact, rel=1e-4)
        stated = max(m.stiffness for m in probe.law.modes(parameters(**changes), StateBound(0.99**d, 0.99**d, 0.99**2)))
        assert stated == pytest.approx(exact, rel=1e-4)
    stiff = {"shear_modulus": 1e8}
    for changes in (stiff, {**stiff, "yield_stress": 1e9}, {**stiff, "flow_index": 0.5}):
        F = 0.98 * gradients(200, d, 0.2)
        J = np.linalg.det(F)
        bound = StateBound(J.min(), J.max(), (np.linalg.svd(F)[1] ** 2).max())
        probe = probes(d, **changes)
        stated = max(m.stiffness for m in probe.law.modes(parameters(**changes), bound))
        assert largest_stiffness(probe, F).max() <= stated
        assert all(m.viscosity == 0 for m in probe.law.modes(parameters(**changes), bound))


def test_parameters() -> None:
    """Moduli on "auto": the fluid's K, and G = max(K/4, 20 yield_stress), with a sentence each; nonsense is refused."""
    bounds = SceneBounds(dimension=2, spacing=0.1, gravity=9.81, speed=float(np.sqrt(2 * 9.81)), height=1.0)
    mud = ViscoplasticParameters(density=1000.0, yield_stress=50.0, consistency=1.0)
    chosen, notes = mud.resolve(bounds)
    assert chosen.bulk_modulus == pytest.approx(1.962e6)
    assert chosen.shear_modulus == pytest.approx(1.962e6 / 4)
    assert len(notes) == 2
    assert "4.905e+05 Pa" in notes[1]
    # A punch meets 2 + pi of the yield stress (Prandtl).
    firm, _ = mud.model_copy(update={"yield_stress": 1e5}).resolve(bounds)
    assert firm.bulk_modulus == pytest.approx((2 + np.pi) * 1e5 / 0.01)
    given, notes = mud.model_copy(update={"yield_stress": 1e5, "bulk_modulus": 1.962e6}).resolve(bounds)
    assert given.shear_modulus == pytest.approx(2e6)
    assert "5 %" in notes[-1]
    assert parameters().resolve(bounds) == (parameters(), [])
    for wrong in ({"consistency": 0.0}, {"yield_stress": -1.0}, {"flow_index": 0.05}, {"flow_index": 2.5}):
        with pytest.raises(ValidationError):
            parameters(**wrong)


SLUMP = """
[domain]
size = [1.0, 0.4]
spacing = 0.01
gravity = [0.0, -9.81]
walls = { default = "separate", y_min = "stick" }
[time]
end = 2.0
frames = 1
[output]
fields = ["pressure"]
[[bodies]]
name = "mud"
material = "mud"
shape = { box = { min = [0.4, 0.0], max = [0.6, 0.2] } }
"""


@pytest.mark.parametrize(
    "changed", [(), ("bodies.mud.sampling=jittered",), ("time.safety=0.4",)], ids=["", "jittered", "half the step"]
)
def test_pressure_of_mud_at_rest_is_its_weight(tmp_path: Path, changed: tuple[str, ...]) -> None:
    """A block of mud that has spread bears its weight, to a few times its yield stress.

    With volumes of its own each particle keeps what flow leaves of noise: +-50 kPa, a root mean square of 9 kPa.
    """
    (tmp_path / "slump.toml").write_text(SLUMP, encoding="utf-8")
    options = [word for value in changed for word in ("--set", value)]
    assert run_here("simulate", tmp_path / "slump.toml", "-o", tmp_path / "out", "--quiet", *options).status == 0
    frame = open_result(tmp_path / "out").frame(1)
    place, h = frame.position[:, :2].astype(float), 0.01
    column = np.floor(place[:, 0] / h).astype(int)
    top = np.zeros(column.max() + 1)
    np.maximum.at(top, column, place[:, 1] + h / 4)
    inner = (column > column.min() + 2) & (column < column.max() - 2)
    off = (frame.fields["pressure"] - 1600 * 9.81 * (top[column] - place[:, 1]))[inner]
    assert np.ptp(place[:, 0]) > 0.8
    assert np.sqrt((off[place[inner, 1] > h] ** 2).mean()) < 3 * YIELD
    # In the cells on the floor that holds it, mud that the front has rolled over stays compressed.
    assert np.sqrt((off**2).mean()) < 6 * YIELD


LUMP = """
domain = { size = [0.5, 0.5, 0.2], spacing = 0.02, gravity = [0.0, 0.0, -9.81] }
time = { end = 0.33, frames = 1 }
[[bodies]]
name = "lump"
material = "mud"
shape = { ball = { center = [0.25, 0.25, 0.1], radius = 0.08 } }
"""


@pytest.mark.slow
def test_mud_that_spreads_stays_whole(tmp_path: Path) -> None:
    """A ball that flattens on a floor has no gap along its planes of symmetry; on a lattice it splits there."""
    (tmp_path / "lump.toml").write_text(LUMP, encoding="utf-8")
    gaps = {}
    for sampling in ("turned", "lattice"):
        out = tmp_path / sampling
        asked = "--set", f"bodies.lump.sampling={sampling}", "--quiet"
        assert run_here("simulate", tmp_path / "lump.toml", "-o", out, *asked).status == 0
        place = open_result(out).frame(1).position[:, :2].astype(float) - 0.25
        assert np.linalg.norm(place, axis=1).max() > 2 * 0.08
        strips = [place[np.abs(place[:, 1 - a] - 0.1) < 0.02, a] for a in (0, 1)]
        gaps[sampling] = max(np.diff(np.sort(strip[np.abs(strip) < 0.1])).max() for strip in strips)
    assert gaps["turned"] < 0.02 < gaps["lattice"]
