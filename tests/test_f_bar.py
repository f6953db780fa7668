"""Particles of a cell share their change of volume (docs/theory.md, 4.4)."""

from collections.abc import Callable

import mpm_reference as reference
import numpy as np
import pytest
from rounding import farthest
from scenes import ball, body, box, scene_of, slow
from test_batch import batch_of, outputs_of, same

from mpmcli.scene import Scene, sample_bodies
from mpmcli.solver.engine.run import build_run

H = 0.1
E, NU, DENSITY = 1e5, 0.49, 1000.0
MU, LAMBDA = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))


def block(
    dimension: int = 2, *, law: str = "neo_hookean", solids: str = "updated", gravity: float = 0.0, **more: object
) -> Scene:
    """Return a block that flies freely."""
    material = {"law": law, "density": DENSITY, "youngs_modulus": E, "poissons_ratio": NU} | more.pop("material", {})
    d, end, spacing = dimension, more.pop("end", 0.3), more.pop("spacing", H)
    solver = {"precision": "f64", "solids": solids} | more.pop("solver", {})
    return scene_of(
        body("block", material, box([0.33] * d, [0.63] * d), velocity=["sin(9*Y)", "-sin(7*X)", "0.4*sin(8*Y)"][:d])
        | more,
        domain={"size": [1.0] * d, "spacing": spacing, "gravity": [*[0.0] * (d - 1), -gravity]},
        time={"end": end, "frames": 6},
        solver=solver,
        fields=["velocity", "pressure", "volume_ratio"],
    )


def mean_of_cell(x: np.ndarray, values: np.ndarray, volume: np.ndarray) -> np.ndarray:
    """Return the mean of values over the particles of each one's cell, weighted by their volumes at rest."""
    cells = np.unique(np.floor(x / H).astype(int), axis=0, return_inverse=True)[1].ravel()
    return (np.bincount(cells, volume * values) / np.bincount(cells, volume))[cells]


def shared(x: np.ndarray, F: np.ndarray, volume: np.ndarray) -> np.ndarray:
    """Return F with ln J replaced by its mean over the particles of a cell."""
    theta = np.log(np.linalg.det(F))
    return F * np.exp((mean_of_cell(x, theta, volume) - theta) / x.shape[1])[:, None, None]


@pytest.mark.parametrize(
    ("dimension", "solids"), [(2, "updated"), *(slow(*how) for how in ((2, "total"), (3, "updated")))]
)
def test_steps_are_those_of_plain_numpy(backend_of: Callable, dimension: int, solids: str) -> None:
    """Stress of F with the mean of ln J of the cell, the one at rest where bodies are on the grid at rest.

    In the second step F has the mean growth of the cell in which it was in the first, but on the grid at rest.
    """
    d = dimension
    scene = block(d, solids=solids)
    run = build_run(scene, backend_of("f64", 1))
    group, rng = run.groups[0], np.random.default_rng(1)
    n = group.count
    v, C = rng.uniform(-1, 1, (n, d)), rng.uniform(-3, 3, (n, d, d))
    deformation = np.eye(d) + rng.uniform(-0.2, 0.2, (n, d, d))
    group.replace(x=group.read()["x"] + rng.uniform(-0.02, 0.02, (n, d)), v=v, C=C, deformation=deformation)
    run.state_was_replaced()
    rest = group.arrays.initial.to_numpy()[:n][np.argsort(group.read()["id"])] if solids == "total" else None
    sample, dt = sample_bodies(scene)[0], 2e-3
    mass, volume = np.full(n, sample.mass), np.full(n, sample.volume)
    tau = reference.neo_hookean_stress(np.full(n, MU), np.full(n, LAMBDA))
    box = reference.Box(scene.domain.cells, H, np.zeros(d), [("slip", "slip")] * d)
    growth, earlier = np.zeros(n), None
    for kick in (0.5 * dt, dt):
        before = group.read()
        before = {name: values[np.argsort(before["id"])] for name, values in before.items()}
        F, C = before["deformation"], before["C"]
        place = before["x"] if solids == "updated" else rest[before["id"]]
        seen = shared(place, F, volume)
        assert np.abs(np.linalg.det(seen) - np.linalg.det(F)).max() > 0.05
        if solids == "updated":
            stress = lambda _, p, seen=seen: tau(seen[p], p)  # noqa: E731
        else:
            C = C @ F
            stress = lambda F, p, seen=seen: tau(seen[p], p) @ np.linalg.inv(F).T  # noqa: E731
        particles = reference.Particles(place, before["v"], C, F, mass, volume, stress)
        velocity = reference.update(*reference.scatter([particles], box, kick), box, kick)
        (after,) = reference.gather([particles], velocity, box, dt)
        run.step(dt)
        found = group.read()
        found = {name: values[np.argsort(found["id"])] for name, values in found.items()}
        assert np.abs(found["v"] - after.v).max() < 1e-12 * np.abs(after.v).max()
        if solids == "updated":
            missing = mean_of_cell(place if earlier is None else earlier, growth, volume) - growth
            crossed = earlier is not None and (np.floor(place / H) != np.floor(earlier / H)).any()
            assert crossed == (kick == dt)
            assert kick < dt or np.abs(missing).max() > 1e-5
            F = F * np.exp(missing / d)[:, None, None]
        grown = F + dt * (after.C @ F if solids == "updated" else after.C)
        assert np.abs(found["deformation"] - grown).max() < 1e-13
        growth, earlier = np.log(np.linalg.det(grown) / np.linalg.det(F)), place
    # What a frame shows is what the law sees, at the places of the frame.
    place = found["x"] if solids == "updated" else rest
    J = np.linalg.det(shared(place, found["deformation"], volume))
    frame, _ = run.frame()
    assert np.abs(frame.fields["volume_ratio"][found["id"]] - J).max() < 1e-6


@pytest.mark.parametrize("law", ["neo_hookean", *(slow(law) for law in ("fixed_corotated", "von_mises"))])
def test_momenta_stay_and_energy_does_not_grow(backend_of: Callable, law: str) -> None:
    """The mean of the strain and that of the stress are the same projection, so that the force is that of an energy."""
    more = {"poissons_ratio": 0.4999} | ({"yield_stress": 3e3} if law == "von_mises" else {})
    scene = block(law=law, material=more, end=0.2)
    rows = [row for _, row in build_run(scene, backend_of("f64", 1)).frames()]
    momentum = np.array([row.linear_momentum for row in rows])
    assert np.abs(momentum - momentum[0]).max() < 1e-13 * scene.bodies[0].material.density
    spin = np.array([row.angular_momentum[0] for row in rows])
    assert np.abs(spin - spin[0]).max() < 1e-11 * abs(spin[0])
    energy = np.array([row.energy for row in rows])
    assert (energy < 1.001 * energy[0]).all() and energy[-1] > 0.2 * energy[0]


@pytest.mark.parametrize(
    ("ratio", "spacing", "rate", "end", "least"),
    [
        (0.49, 0.05, 20.0, 4.0, 0.98),
        slow(0.499, 0.05, 20.0, 4.0, 0.98),
        # That of docs/theory.md, 4.4.
        slow(0.49, 0.02, 12.95, 10.0, 0.995),
    ],
)
def test_a_disc_that_spins_across_the_cells_gains_no_energy(
    backend_of: Callable, ratio: float, spacing: float, rate: float, end: float, least: float
) -> None:
    """13 and 20 revolutions; its radius stays. With its own growth F gains 1.6 % in the first, and the last tears."""
    disc = ball([0.503, 0.497], 0.2)
    spin = [f"-{rate}*(Y-0.497)", f"{rate}*(X-0.503)"]
    scene = block(material={"poissons_ratio": ratio}, shape=disc, velocity=spin, end=end, spacing=spacing)
    frames = list(build_run(scene, backend_of("f64", 1)).frames())
    energy = np.array([row.energy for _, row in frames])
    assert (np.diff(energy) < 1e-6 * energy[0]).all()
    assert energy[-1] > least * energy[0]
    first, last = (
        np.sqrt(((frame.position - frame.position.mean(axis=0)) ** 2).sum(axis=1).mean())
        for frame in (frames[0][0], frames[-1][0])
    )
    assert last == pytest.approx(first, rel=0.01)


@pytest.mark.parametrize("end", [0.8, 1.2])
def test_a_disc_whose_particles_lie_between_cells_gains_no_energy(backend_of: Callable, end: float) -> None:
    """A rubber disc whose middle is a node falls, bounces and flies at the default step: 210 times its energy before.

    Its particles lie on faces of cells and change cells in every step: F has the growth of the cell where stress acted.
    """
    scene = block(
        shape=ball([0.5, 0.48], 0.32),
        velocity=[0.0, 0.0],
        material={"youngs_modulus": 9.6e6, "poissons_ratio": 0.47, "density": 950.0},
        gravity=9.81,
        end=end,
    )
    energy = np.array([row.energy for _, row in build_run(scene, backend_of("f64", 1)).frames()])
    assert (np.diff(energy) < 2e-4 * energy[0]).all()


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.3, 0.49, 0.4999])
@pytest.mark.parametrize("law", ["neo_hookean", "fixed_corotated", "von_mises"])
def test_a_ball_that_bounces_gains_no_energy(backend_of: Callable, law: str, ratio: float) -> None:
    """In flight and at the floor; frames count velocities half a step back, which may show 1e-4 of it."""
    material = {"poissons_ratio": ratio} | ({"yield_stress": 2e3} if law == "von_mises" else {})
    scene = block(
        law=law, material=material, shape=ball([0.5, 0.6], 0.3), solver={"f_bar": True}, velocity=[0.1, -2.0], end=1.0
    )
    energy = np.array([row.energy for _, row in build_run(scene, backend_of("f64", 1)).frames()])
    assert (np.diff(energy) < 2e-4 * energy[0]).all()
    assert energy[-1] < 0.95 * energy[0]


@pytest.mark.slow
def test_a_uniform_change_of_volume_is_not_changed(backend_of: Callable) -> None:
    """Where all particles have one J the mean is J, and the run is that without averaging, to round-off."""

    def run(f_bar: bool) -> np.ndarray:
        scene = block(deformation=[[1.1, 0.0], [0.0, 1.2]], velocity=[0.0, 0.0], solver={"f_bar": f_bar})
        solver = build_run(scene, backend_of("f64", 1))
        solver.step(1e-4)
        return solver.groups[0].read()["v"]

    plain, averaged = run(False), run(True)
    assert np.abs(plain).max() > 1e-3
    assert np.abs(averaged - plain).max() < 1e-12 * np.abs(plain).max()


@pytest.mark.parametrize(("material", "setting", "averages"), [
    ({"law": "neo_hookean", "poissons_ratio": 0.45}, "auto", False),
    ({"law": "neo_hookean", "poissons_ratio": 0.46}, "auto", True),
    ({"law": "neo_hookean", "poissons_ratio": 0.2}, True, True),
    ({"law": "neo_hookean", "poissons_ratio": 0.49}, False, False),
    ({"law": "sand", "friction_angle": 30.0, "poissons_ratio": 0.46}, "auto", False),
])  # fmt: skip
def test_who_averages(backend_of: Callable, material: dict, setting: object, averages: bool) -> None:
    run = build_run(block(material=material, law=material["law"], solver={"f_bar": setting}), backend_of("f64", 1))
    assert run.groups[0].arrays.uses_f_bar == averages
    # The plan says so, and what does not average has no field for it.
    assert (run.groups[0].arrays.to_mean is not None) == averages == bool(run.grid.kept_means)


@pytest.mark.gpu
@pytest.mark.parametrize("solids", ["updated", slow("total")])
def test_a_gpu_follows_the_cpu(backend_of: Callable, solids: str) -> None:
    """Alone and in a batch, with what frames show, to the rounding of sums in another order."""
    scene = block(solids=solids, solver={"precision": "f32"}, end=0.05)
    expected = [frame for frame, _ in build_run(scene, backend_of("f32", 1)).frames()]
    backend = backend_of("f32", 1, "vulkan")
    alone = [frame for frame, _ in build_run(scene, backend).frames()]
    (batched,) = outputs_of(batch_of([scene], backend), [scene])
    for found in (alone, [frame for frame, _ in batched]):
        assert len(found) == len(expected) == 7
        for frame, other in zip(found, expected, strict=True):
            apart = farthest(other.position, other.velocity, expected[-1].step, other.time)
            assert np.abs(frame.position - other.position).max() < apart
            scale = max(np.abs(other.fields["pressure"]).max(), 1.0)
            assert np.abs(frame.fields["pressure"] - other.fields["pressure"]).max() < 5e-3 * scale


@pytest.mark.slow
def test_threads_change_no_byte(backend_of: Callable) -> None:
    """Frames included, which average once more."""
    scene = block(solver={"precision": "f32"}, end=0.05)
    (found,) = outputs_of(batch_of([scene], backend_of("f32", 3)), [scene])
    assert list(same(found, list(build_run(scene, backend_of("f32", 1)).frames()))) == []


def test_plastic_flow_keeps_the_volume_of_the_particle(backend_of: Callable) -> None:
    """Metal flows at constant volume, out of the plane too: the mean of the cell changes no particle's own J."""
    scene = block(law="von_mises", material={"yield_stress": 3e3}, solver={"f_bar": True}, velocity=[0.0, 0.0])
    run = build_run(scene, backend_of("f64", 1))
    group, rng = run.groups[0], np.random.default_rng(1)
    group.replace(deformation=np.eye(2) + rng.uniform(-0.2, 0.2, (group.count, 2, 2)))
    run.state_was_replaced()

    def volume_ratios() -> np.ndarray:
        state = group.read()
        along_z = np.exp(state["internal"][:, 1])
        return (np.linalg.det(state["deformation"]) * along_z)[np.argsort(state["id"])]

    before = volume_ratios()
    # So short that nothing deforms by more than 1e-6.
    run.step(1e-9)
    assert group.read()["internal"][:, 0].mean() > 0.01
    assert np.abs(volume_ratios() - before).max() < 1e-6
