"""Every law of the registry: rest, symmetry, objectivity, energy, and the same stress on host and device.

A law that joins the registry is tested from its first day: it needs an entry in PARAMETERS.
"""

from collections.abc import Callable

import numpy as np
import pytest
import taichi as ti
from hypothesis import given
from hypothesis import strategies as st
from solver_state import scene_of

from mpmcli.materials.law import Law
from mpmcli.materials.registry import laws, parameter_models
from mpmcli.scene.material import MaterialParameters, SceneBounds

NAMES = sorted(laws())
PARAMETERS: dict[str, dict] = {
    "fluid": {"density": 1000.0, "bulk_modulus": 2e5},
    "neo_hookean": {"density": 1000.0, "youngs_modulus": 3e5, "poissons_ratio": 0.35},
}
# The scale of all stresses here, Pa.
STIFF = 3e5
seeds = st.integers(0, 2**32 - 1)


def made(name: str) -> tuple[Law, MaterialParameters]:
    """Return the law and its parameters."""
    return laws()[name](), laws()[name].parameters(**PARAMETERS[name])


def rotation(random: np.random.Generator, dimension: int) -> np.ndarray:
    """Return a random rotation, by a QR decomposition."""
    Q, R = np.linalg.qr(random.normal(size=(dimension, dimension)))
    Q = Q * np.sign(np.diag(R))
    Q[:, 0] *= np.sign(np.linalg.det(Q))
    return Q


def gradients(seed: int, dimension: int, count: int = 1) -> np.ndarray:
    """Return random deformation gradients (n, d, d), stretched by 0.6 to 1.6 along random axes."""
    random = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        stretch = np.diag(random.uniform(0.6, 1.6, dimension))
        made.append(rotation(random, dimension) @ stretch @ rotation(random, dimension).T)
    return np.array(made)


def stored(law: Law, F: np.ndarray) -> np.ndarray:
    """Return what a particle of the law stores of F (n, d, d): J (n) or F itself."""
    return F if law.deformation == "F" else np.linalg.det(F)


def kirchhoff(law: Law, parameters: MaterialParameters, F: np.ndarray) -> np.ndarray:
    """Return tau = J sigma (n, 3, 3)."""
    return np.linalg.det(F)[:, None, None] * law.cauchy_stress(parameters, stored(law, F))


def test_every_law_is_tested() -> None:
    """The registry finds each law by its own name, with its parameters and what a particle stores."""
    assert PARAMETERS.keys() == laws().keys()
    assert parameter_models() == tuple(laws()[name].parameters for name in NAMES)
    for name, law in laws().items():
        assert law.name == name
        assert law.deformation in ("J", "F")
        assert law.parameters(**PARAMETERS[name]).law == name


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("name", NAMES)
def test_rest_is_free_of_stress_and_energy(name: str, dimension: int) -> None:
    law, parameters = made(name)
    rest = np.eye(dimension)[None]
    assert not law.cauchy_stress(parameters, stored(law, rest)).any()
    assert not law.energy_density(parameters, stored(law, rest)).any()


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("name", NAMES)
@given(seed=seeds)
def test_stress_is_symmetric_and_turns_with_the_body(name: str, dimension: int, seed: int) -> None:
    """sigma = sigma^T and tau(Q F) = Q tau(F) Q^T for any rotation Q, in plane strain too."""
    law, parameters = made(name)
    F = gradients(seed, dimension)
    tau = kirchhoff(law, parameters, F)[0]
    assert np.abs(tau - tau.T).max() < 1e-12 * STIFF
    Q = np.eye(3)
    Q[:dimension, :dimension] = rotation(np.random.default_rng(seed + 1), dimension)
    turned = kirchhoff(law, parameters, Q[:dimension, :dimension] @ F)[0]
    assert np.abs(turned - Q @ tau @ Q.T).max() < 1e-12 * STIFF
    if dimension == 2:
        assert not tau[2, :2].any()


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("name", NAMES)
@given(seed=seeds)
def test_stress_is_the_derivative_of_the_energy(name: str, dimension: int, seed: int) -> None:
    """tau = dW/dF F^T, W differentiated by central differences (error of order step^2 = 1e-10), and W >= 0."""
    law, parameters = made(name)
    F = gradients(seed, dimension)[0]
    step = 1e-5
    P = np.empty_like(F)
    for i, j in np.ndindex(*F.shape):
        change = np.zeros_like(F)
        change[i, j] = step
        both = np.array([F + change, F - change])
        plus, minus = law.energy_density(parameters, stored(law, both))
        P[i, j] = (plus - minus) / (2 * step)
    tau = kirchhoff(law, parameters, F[None])[0, :dimension, :dimension]
    assert np.abs(tau - P @ F.T).max() < 1e-7 * STIFF
    assert law.energy_density(parameters, stored(law, F[None]))[0] >= 0


def test_plane_strain_carries_stress_out_of_plane() -> None:
    """sigma_zz of a 2D state is that of the 3D state with F_zz = 1, for every law."""
    F = gradients(5, 2, 20)
    full = np.tile(np.eye(3), (20, 1, 1))
    full[:, :2, :2] = F
    for name in NAMES:
        law, parameters = made(name)
        flat = law.cauchy_stress(parameters, stored(law, F))
        assert np.abs(flat - law.cauchy_stress(parameters, stored(law, full))).max() < 1e-12 * STIFF


def on_device(law: Law, parameters: MaterialParameters, F: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return tau (n, d, d) as the kernels compute it."""
    n, d = len(F), F.shape[1]
    constants = law.constants(parameters)
    table = ti.Vector.field(len(constants), float, shape=())
    deformation = ti.Matrix.field(d, d, float, shape=n) if law.deformation == "F" else ti.field(float, shape=n)
    gradient = ti.Matrix.field(d, d, float, shape=n)
    tau = ti.Matrix.field(d, d, float, shape=n)
    table.from_numpy(np.array(constants))
    deformation.from_numpy(stored(law, F))
    gradient.from_numpy(C)

    @ti.kernel
    def run():
        for p in range(n):
            tau[p] = law.kirchhoff_stress(deformation[p], gradient[p], table[None])

    run()
    return tau.to_numpy().astype(np.float64)


@pytest.mark.filterwarnings("ignore:.*:UserWarning")
@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_device_and_host_agree(backend_of: Callable, precision: str) -> None:
    """tau = J sigma to round-off, in 2D and 3D, for every law; at rest exactly zero; f32 within 1e-6 of the scale."""
    backend_of(precision)
    tolerance = {"f64": 1e-14, "f32": 1e-6}[precision]
    for name in NAMES:
        for dimension in (2, 3):
            law, parameters = made(name)
            F = np.concatenate([np.eye(dimension)[None], gradients(9, dimension, 200)])
            tau = on_device(law, parameters, F, np.zeros_like(F))
            expected = kirchhoff(law, parameters, F)[:, :dimension, :dimension]
            assert not tau[0].any()
            assert np.abs(tau - expected).max() < tolerance * np.abs(expected).max() * 4


def test_fluid_is_linear_in_its_density() -> None:
    """p = K (rho / rho0 - 1) = K (1/J - 1): the same in every direction."""
    law, parameters = made("fluid")
    J = np.array([0.9, 1.0, 1.05])
    expected = -2e5 * (1 / J - 1)
    stress = law.cauchy_stress(parameters, J)
    assert stress == pytest.approx(expected[:, None, None] * np.eye(3))


def test_fluid_chooses_the_softest_modulus_that_is_stiff_enough() -> None:
    """K = rho v^2 / compressibility, so c = 10 v at 1 %: 1.962 MPa for a metre of falling water (6.1)."""
    model = laws()["fluid"].parameters
    bounds = SceneBounds(dimension=2, spacing=0.1, gravity=9.81, speed=float(np.sqrt(2 * 9.81)), height=1.0)
    chosen, notes = model(density=1000.0).resolve(bounds)
    assert chosen.bulk_modulus == pytest.approx(1.962e6)
    assert "1.962e+06 Pa" in notes[0]
    assert "44.29 m/s" in notes[0]
    stiffer, _ = model(density=1000.0, compressibility=0.001).resolve(bounds)
    assert stiffer.bulk_modulus == pytest.approx(1.962e7)
    given = model(density=1000.0, bulk_modulus=5e5)
    assert given.resolve(bounds) == (given, [])
    still, _ = model(density=1000.0).resolve(SceneBounds(2, 0.1, 0.0, 0.0, 1.0))
    assert np.isfinite(still.bulk_modulus)
    assert still.bulk_modulus > 0


def test_scene_resolves_the_modulus() -> None:
    """A loaded scene holds the number, and an effective scene never says "auto"."""
    scene = scene_of(
        domain={"size": [2.0, 2.0], "spacing": 0.1, "gravity": [0.0, -9.81]},
        time={"end": 1.0, "frames": 1},
        bodies=[
            {
                "name": "water",
                "material": {"law": "fluid", "density": 1000.0},
                "shape": {"box": {"min": [0.0, 0.0], "max": [1.0, 1.0]}},
            }
        ],
    )
    assert scene.bodies[0].material.bulk_modulus == pytest.approx(1.962e6)


def test_neo_hookean_moduli() -> None:
    """mu = E / (2 (1 + nu)), lambda = E nu / ((1 + nu)(1 - 2 nu)); at small strain the Hooke's law of them."""
    law, parameters = made("neo_hookean")
    assert parameters.shear_modulus == pytest.approx(3e5 / 2.7)
    assert parameters.lame_lambda == pytest.approx(3e5 * 0.35 / (1.35 * 0.3))
    strain = 1e-7 * np.array([[1.0, 0.5, 0.0], [0.5, -2.0, 0.3], [0.0, 0.3, 1.5]])
    hooke = parameters.lame_lambda * np.trace(strain) * np.eye(3) + 2 * parameters.shear_modulus * strain
    stress = law.cauchy_stress(parameters, (np.eye(3) + strain)[None])[0]
    assert np.abs(stress - hooke).max() < 1e-6 * np.abs(hooke).max()
