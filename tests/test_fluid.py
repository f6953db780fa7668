"""The weakly compressible fluid: equations of state, Newtonian viscosity, the tension cut-off, and its stiffness."""

from collections.abc import Callable

import numpy as np
import pytest
from law_probe import Probes
from law_tangent import largest_stiffness, largest_viscosity

from mpmcli.materials.fluid import ATMOSPHERE, CRUSHED, TEARS, Fluid, FluidParameters
from mpmcli.materials.law import StateBound
from mpmcli.scene.material import SceneBounds

K = 2e5
WATER = FluidParameters(density=1000.0, bulk_modulus=K)


def fluid(**changes: object) -> FluidParameters:
    return FluidParameters(**{"density": 1000.0, "bulk_modulus": K, **changes})


def swollen(J: np.ndarray, d: int) -> np.ndarray:
    """Return diagonal F (n, d, d) with det F = J, stretched along x alone."""
    F = np.tile(np.eye(d), (len(J), 1, 1))
    F[:, 0, 0] = J
    return F


def spherical(answer: np.ndarray) -> np.ndarray:
    """Return tau_xx (n) of tau (n, 3, 3) that are multiples of I, and check that."""
    assert np.array_equal(answer, answer[:, :1, :1] * np.eye(3))
    return answer[:, 0, 0]


@pytest.fixture(scope="module", params=["f64", "f32"])
def probes(backend_of: Callable, request: pytest.FixtureRequest) -> Probes:
    backend_of(request.param)
    return Probes(fluid, request.param)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("exponent", [1.0, 7.0])
def test_pressure_follows_the_equation_of_state(probes: Probes, exponent: float, d: int) -> None:
    """tau = -J p I, out of the plane too, with p = K (1/J - 1), and the Tait equation p = K/7 (J^-7 - 1)."""
    J = np.concatenate([[1.0], np.linspace(0.6, 1.0, 50)]).astype(probes.real).astype(float)
    answer = probes(d, exponent=exponent)(swollen(J, d))
    tau = spherical(answer.tau)
    p = K / exponent * (J**-exponent - 1)
    assert np.abs(tau + J * p).max() < 4 * probes.epsilon * exponent * np.abs(p).max()
    assert np.array_equal(answer.deformation, J)
    assert tau[0] == 0


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("exponent", [1.0, 7.0])
def test_stress_is_the_derivative_of_the_energy(probes: Probes, exponent: float, d: int) -> None:
    """J dW/dJ = -J p by central differences (error of order step^2), and W = K/2 (J - 1)^2 at small strain."""
    probe = probes(d, exponent=exponent, tension_cutoff=False)
    if probes.real == np.float64:
        J, step = np.linspace(0.5, 1.5, 41), 1e-5
        plus, minus = probe(swollen(J * (1 + step), d)).energy, probe(swollen(J * (1 - step), d)).energy
        tau = spherical(probe(swollen(J, d)).tau)
        assert np.abs((plus - minus) / (2 * step) - tau).max() < 1e-8 * np.abs(tau).max()
        assert (plus >= 0).all()
    small = 1 + np.array([-1e-2, -1e-3, 1e-3, 1e-2]).astype(probes.real)
    energy = probe(swollen(small, d)).energy
    strain = np.array(small, float) - 1
    # W = K/2 e^2 (1 - (g + 1)/3 e + ...), and J itself knows e to a rounding.
    allowed = np.abs(strain) * (exponent + 2) / 3 + 50 * probes.epsilon / np.abs(strain)
    assert (np.abs(energy / (K / 2 * strain**2) - 1) < allowed).all()
    assert probe(np.eye(d)[None]).energy[0] == 0


def test_equations_of_state_meet(probes: Probes) -> None:
    """An exponent next to 1 gives the stress and energy of the linear law."""
    J = np.linspace(0.8, 1.0, 20)
    linear, near = probes(2, exponent=1.0)(swollen(J, 2)), probes(2, exponent=1 + 1e-6)(swollen(J, 2))
    assert np.abs(linear.tau - near.tau).max() < 1e-6 * K
    assert np.abs(linear.energy - near.energy).max() < 1e-5 * K


@pytest.mark.parametrize("d", [2, 3])
def test_viscous_stress_is_newtonian(probes: Probes, d: int) -> None:
    """tau = mu (C + C^T - 2/3 tr C I) + zeta tr C I for any C, tau_zz = (zeta - 2/3 mu) tr C in 2D; dt says nothing."""
    mu, zeta = 3.0, 5.0
    C = np.random.default_rng(1).uniform(-10, 10, (200, d, d))
    F = np.tile(np.eye(d), (200, 1, 1))
    full = np.zeros((200, 3, 3))
    full[:, :d, :d] = C
    trace = np.einsum("nii->n", C)[:, None, None]
    expected = mu * (full + full.transpose(0, 2, 1) - 2 / 3 * trace * np.eye(3)) + zeta * trace * np.eye(3)
    for dt in (1e-6, 1.0):
        answer = probes(d, viscosity=mu, bulk_viscosity=zeta)(F, C=C, dt=dt)
        assert np.abs(answer.tau - expected).max() < 20 * probes.epsilon * np.abs(expected).max()
    couette = np.zeros((1, d, d))
    couette[0, 0, 1] = 4.0
    tau = probes(d, viscosity=mu)(np.eye(d)[None], C=couette).tau[0]
    assert tau[0, 1] == tau[1, 0] == pytest.approx(mu * 4.0)
    assert not np.delete(tau.ravel(), [1, 3]).any()


@pytest.mark.parametrize("d", [2, 3])
def test_tension_cutoff(probes: Probes, d: int) -> None:
    """J > 1, torn: no stress and no energy; J is kept, and falls back to 1 at once without volume correction.

    Without the cut-off there is suction K (J - 1), and J is kept.
    """
    J = np.array([1 + 2.1 * TEARS, 1.5, 27.0])
    for correction, kept in ((True, J), (False, np.ones(3))):
        cut = probes(d, volume_correction=correction)(swollen(J, d))
        assert not cut.tau.any()
        assert not cut.energy.any()
        assert cut.deformation == pytest.approx(kept, rel=2 * probes.epsilon)
    held = probes(d, exponent=1.0, tension_cutoff=False)(swollen(J, d))
    assert spherical(held.tau) == pytest.approx(K * (J - 1), rel=1e-6 if probes.real == np.float64 else 1e-3)
    assert held.deformation == pytest.approx(J, rel=2 * probes.epsilon)
    below = probes(d, volume_correction=False)(swollen(cut.deformation * 0.99, d))
    assert spherical(below.tau) == pytest.approx(-0.01 * K, rel=100 * probes.epsilon)


@pytest.mark.parametrize("exponent", [1.0, 7.0, 15.0])
def test_hard_states_are_defined(probes: Probes, exponent: float) -> None:
    """Crushed to nothing and beyond: finite, and pushing back; Tait's pressure grows no further below J = CRUSHED."""
    J = np.array([0.125, 1e-6, 1e-12, 0.0, -1.0])
    answer = probes(3, exponent=exponent)(swollen(J, 3))
    assert np.isfinite(answer.energy).all()
    tau = spherical(answer.tau)
    assert np.isfinite(tau).all()
    assert (tau <= K * (0.125 - 1)).all()
    if exponent > 1:
        assert tau[1:] == pytest.approx(K * CRUSHED * (1 - CRUSHED**-exponent) / exponent, rel=1e-5)
    bound = StateBound(-1.0, 1.0, 1.0)
    assert all(
        np.isfinite(mode.stiffness) for mode in probes(3, exponent=exponent).law.modes(fluid(exponent=exponent), bound)
    )


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("exponent", [1.0, 7.0])
def test_stiffness_is_the_largest_within_the_bound(probes: Probes, exponent: float, d: int) -> None:
    """`modes` is the differentiated stress where that is largest, at one end of the range of J (J <= 1 if cut off)."""
    if probes.real == np.float32:
        pytest.skip("differences of f32 say nothing")
    for cutoff, ends in ((False, (0.7, 1.3)), (True, (0.7, 0.999))):
        changes = {"exponent": exponent, "tension_cutoff": cutoff}
        J = np.linspace(*ends, 13)
        found = largest_stiffness(probes(d, **changes), swollen(J, d))
        law = probes(d, **changes).law
        stated = law.modes(fluid(**changes), StateBound(*ends, 1.3**2))[0].stiffness
        assert stated == pytest.approx(found.max(), rel=1e-8)
        beyond = law.modes(fluid(**changes), StateBound(1.0, 5.0, 25.0))[0].stiffness
        swollen_most = 1.0 if cutoff else max(1.0, ((exponent - 1) * 5.0 ** (1 - exponent) + 5.0) / exponent)
        assert beyond == pytest.approx(d * K * swollen_most)
        assert law.modes(fluid(**changes), StateBound())[0].stiffness == pytest.approx(d * K)


@pytest.mark.parametrize("d", [2, 3])
def test_viscous_modes(probes: Probes, d: int) -> None:
    """2 mu for shear and (2 - 2d/3) mu + d zeta for volume: the eigenvalues of d tau / dC.

    With zeta = 2/3 mu viscosity acts on tr C like on shear, and the step's bound is that of docs/theory.md, 6.2
    d (c dt/h)^2 + 4 nu dt/h^2 <= 1.
    """
    mu = 3.0
    for zeta in (0.0, 2 / 3 * mu, 5.0):
        changes = {"viscosity": mu, "bulk_viscosity": zeta}
        law = probes(d, **changes).law
        volume, shear = law.modes(fluid(**changes), StateBound())
        assert volume.viscosity == pytest.approx((2 - 2 * d / 3) * mu + d * zeta)
        assert shear == (0.0, pytest.approx(2 * mu))
        if probes.real == np.float64:
            largest = largest_viscosity(probes(d, **changes), np.eye(d)[None])[0]
            assert max(volume.viscosity, shear.viscosity) == pytest.approx(largest)
    volume, _ = probes(d, viscosity=mu, bulk_viscosity=2 / 3 * mu).law.modes(
        fluid(viscosity=mu, bulk_viscosity=2 / 3 * mu), StateBound()
    )
    rho, h, dt = 1000.0, 0.01, 1e-4
    ours = (dt**2 * volume.stiffness + 2 * dt * volume.viscosity) / (rho * h**2)
    assert ours == pytest.approx(d * K / rho * (dt / h) ** 2 + 4 * (mu / rho) * dt / h**2)


@pytest.mark.parametrize("modulus", [K, 2e9])
def test_suction_until_the_fluid_tears(probes: Probes, modulus: float) -> None:
    """K (J - 1) up to a strength, then falling as steeply: that at J - 1 = 0.005, at most one atmosphere."""
    strength = min(TEARS * modulus, ATMOSPHERE)
    strain = np.linspace(0.0, 3.0, 40) * strength / modulus
    J = (1 + strain).astype(probes.real).astype(float)
    tau = spherical(probes(2, bulk_modulus=modulus)(swollen(J, 2)).tau)
    assert np.abs(tau - torn(J - 1, modulus)).max() < 8 * probes.epsilon * modulus
    assert tau.max() == pytest.approx(strength, rel=0.1)
    assert not tau[strain > 2.1 * strength / modulus].any()


def torn(strain: np.ndarray, modulus: float) -> np.ndarray:
    """Return the suction, Pa, of a fluid without viscosity whose J - 1 is `strain`."""
    strength = min(TEARS * modulus, ATMOSPHERE)
    return np.interp(strain, np.array([0.0, 1.0, 2.0]) * strength / modulus, [0.0, strength, 0.0])


@pytest.mark.parametrize("d", [2, 3])
def test_suction_that_viscosity_adds(probes: Probes, d: int) -> None:
    """tau = min(K (J - 1), max(suction, 3 mu sqrt(2 D':D'))) I + 2 mu D', D' in 3D, and its suction alone at rest."""
    rng = np.random.default_rng(4)
    J, mu = np.linspace(1.0, 1.02, 40), 5.0
    C = rng.normal(0, 20.0, (len(J), d, d)) * (np.arange(len(J)) > 4)[:, None, None]
    D = np.zeros((len(J), 3, 3))
    D[:, :d, :d] = (C + C.transpose(0, 2, 1)) / 2
    D -= np.trace(D, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    bound = 3 * mu * np.sqrt(2 * (D**2).sum((1, 2)))
    bound = np.maximum(bound, torn(J - 1, K))
    assert (bound < K * (J - 1)).any() and (bound > torn(J - 1, K))[5:].any()
    expected = np.minimum(K * (J - 1), bound)[:, None, None] * np.eye(3) + 2 * mu * D
    found = probes(d, viscosity=mu)(swollen(J, d), C=C).tau
    # J - 1 is rounded against 1.
    assert np.abs(found - expected).max() < 8 * probes.epsilon * K
    assert np.abs(spherical(probes(d)(swollen(J, d), C=C).tau) - torn(J - 1, K)).max() < 8 * probes.epsilon * K


def test_what_is_not_asked_for_is_not_compiled() -> None:
    """A law knows from its members whether any is viscous, nonlinear, or cut off."""
    forgetful = fluid(volume_correction=False)
    for member, projects in ((WATER, False), (forgetful, True)):
        law = Fluid([member], 2)
        assert (law.linear, law.viscous, law.projects, law.relaxes) == (True, False, projects, not projects)
    mixed = Fluid([WATER, forgetful, fluid(exponent=7.0, viscosity=1.0, tension_cutoff=False)], 2)
    assert (mixed.linear, mixed.viscous, mixed.projects, mixed.relaxes) == (False, True, True, True)
    held = Fluid([fluid(tension_cutoff=False)], 2)
    assert not held.projects and not held.relaxes


def test_stiffest_state_follows_the_scene() -> None:
    """Water hammer and weight compress by v/c + g H/c^2; only a fluid without cut-off stretches by as much."""
    bounds = SceneBounds(dimension=2, spacing=0.1, gravity=10.0, speed=1.0, height=2.0)
    c = np.sqrt(K / 1000.0)
    strain = 1 / c + 20 / c**2
    for cutoff, largest in ((True, 1.0), (False, 1 + strain)):
        parameters = fluid(tension_cutoff=cutoff)
        state = Fluid([parameters], 2).stiffest(parameters, bounds)
        assert state.volume_ratio_min == pytest.approx(1 / (1 + strain))
        assert state.volume_ratio_max == pytest.approx(largest)


@pytest.mark.parametrize(
    "changes", [{"viscosity": -1.0}, {"bulk_viscosity": -1.0}, {"exponent": 0.5}, {"bulk_modulus": 0.0}]
)
def test_impossible_fluids_are_refused(changes: dict) -> None:
    with pytest.raises(ValueError):
        fluid(**changes)
