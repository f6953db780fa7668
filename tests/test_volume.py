"""The volume of liquids: it follows the density of the grid, and stays (docs/theory.md, 5.11)."""

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
import scenes
from scenes import block, scene, slow, volume_errors
from scipy.stats import norm

from mpmcli.materials.fluid import BESIDE, DEAD_BAND, FREE_DEAD_BAND, FULL, LARGEST_LACK, OPENED, RELAXATION, Fluid
from mpmcli.materials.sand import BAND, Sand
from mpmcli.materials.sand import RELAXATION as GRAINS_RELAXATION
from mpmcli.scene import Scene, sample_bodies
from mpmcli.solver.engine import kernel_store
from mpmcli.solver.engine.plan import make_plan
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.transfer.splines import PAD
from mpmcli.stability.transfer_factors import INTERVAL
from mpmcli.validation.case import Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runs import scene_of

BULK, H = 4e4, 0.1


def liquid(density: float, **more: object) -> dict:
    return {"law": "fluid", "density": density, "bulk_modulus": BULK, "volume_correction": True, **more}


def pool(*densities: float, precision: str = "f64", walls: object = "slip", d: int = 2, alike: bool = False) -> Scene:
    """Return layers of liquid side by side, from wall to wall, in irregular rows of particles.

    Where waves are as fast in all, `alike`, none keeps what nodes do not see.
    """
    width = 1.2 / len(densities)
    bodies = [
        block(
            f"layer {k}",
            liquid(density) | ({"bulk_modulus": BULK * density / densities[0]} if alike else {}),
            [k * width] + [0.0] * (d - 1),
            [(k + 1) * width] + [0.5] * (d - 1),
            sampling="jittered",
            velocity=[0.5, -0.5, 0.2][:d],
        )
        for k, density in enumerate(densities)
    ]
    return unshifted(scene([12, 8, 6][:d], H, bodies, 1.0, walls=walls, precision=precision))


def unshifted(start: Scene) -> Scene:
    """Return a scene whose particles are moved by steps alone."""
    return start.model_copy(update={"solver": start.solver.model_copy(update={"redistribute": False})})


def scattered(x: np.ndarray, volume: np.ndarray, cells: tuple[int, ...]) -> tuple[list, np.ndarray, np.ndarray]:
    """Return the nodes and weights of the stencils, the volumes scattered to nodes over h^d, and x in nodes."""
    d, scaled = len(cells), x / H + PAD
    base = np.floor(scaled - 0.5).astype(int)
    distance = scaled - base
    weights = np.stack([0.5 * (1.5 - distance) ** 2, 0.75 - (distance - 1) ** 2, 0.5 * (distance - 0.5) ** 2])
    stencil = [
        (tuple((base + o).T), np.prod([weights[o[a], :, a] for a in range(d)], axis=0))
        for o in map(np.array, product(range(3), repeat=d))
    ]
    n = np.zeros([count + 2 * PAD + 1 for count in cells])
    for place, w in stencil:
        np.add.at(n, place, w * volume / H**d)
    return stencil, n, scaled


def seen_ratio(x: np.ndarray, volume: np.ndarray, cells: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """Return 1 / sum(w n), the smallest n of the stencil and of the nodes beside it, walls mirrored."""
    stencil, n, scaled = scattered(x, volume, cells)
    d = len(cells)
    base = np.floor(scaled - 0.5).astype(int)
    for axis, count in enumerate(cells):
        line = np.moveaxis(n, axis, 0)
        for wall, inwards in ((PAD, 1), (PAD + count, -1)):
            for k in (1, 2):
                line[wall + k * inwards] += line[wall - k * inwards]
                line[wall - k * inwards] = line[wall + k * inwards]
            line[wall] *= 2
    beside = []
    for axis in range(d):
        for offset in (-1, 3):
            node = (base + np.where(np.arange(d) == axis, offset, 1)).T
            inside = [np.where(i < PAD, 2 * PAD - i, i) for i in node]
            beside.append(
                n[tuple(np.where(i > PAD + c, 2 * (PAD + c) - i, i) for i, c in zip(inside, cells, strict=True))]
            )
    return (
        1 / sum(w * n[place] for place, w in stencil),
        np.min([n[place] for place, _ in stencil], axis=0),
        np.min(beside, axis=0),
    )


def filling(x: np.ndarray, volume: np.ndarray, cells: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return sum(w n) and |sum(w n (x_i - x))| / D, per cell, with D = 1/4, where all is full behind walls."""
    stencil, n, scaled = scattered(x, volume, cells)
    free = np.ones(1)
    for count in cells:
        # Integral of the spline of a node over the domain: 1/2 on a wall, 1 - 1/48 beside it.
        inside = np.interp(np.arange(count + 2 * PAD + 1) - PAD, [-2, -1, 0, 1, 2], [0, 1 / 48, 1 / 2, 47 / 48, 1])
        free = np.multiply.outer(free, inside * inside[::-1])
    n += 1 - free[0]
    moment = sum((w * n[place])[:, None] * (np.transpose(place) - scaled) for place, w in stencil)
    return sum(w * n[place] for place, w in stencil), 4 * np.linalg.norm(moment, axis=1)


def grown(J: np.ndarray, C: np.ndarray, dt: float) -> np.ndarray:
    """Return J det(I + dt C), opened to OPENED at most."""
    return np.minimum(J * np.linalg.det(np.eye(C.shape[-1]) + dt * C), np.maximum(J, OPENED))


def test_openings_are_remembered(backend_of: Callable) -> None:
    """J of a fluid in one group with one that bears suction and one without correction: each keeps its rule."""
    kinds = [liquid(1000.0), liquid(1000.0, tension_cutoff=False), liquid(1000.0, volume_correction=False)]
    bodies = [
        block(
            f"fluid {k}",
            kind,
            [(4 * k + 1) * H, H],
            [(4 * k + 3) * H, 3 * H],
            velocity=[f"20 * (X - {4 * k * H}) - 10 * Y", f"10 * (X - {4 * k * H}) - 25 * Y"],
        )
        for k, kind in enumerate(kinds)
    ]
    run = build_run(unshifted(scene([13, 5], H, bodies, 1.0, precision="f64")), backend_of("f64"))
    (group,) = run.groups
    before = np.random.default_rng(5).choice([0.99, 1.003, 1.01, 1.5, 1.999, 3.0], group.count)
    run.state.unrelaxed_steps = 0
    for sign in (1, -1):
        moving = group.read()
        group.replace(v=sign * moving["v"], C=sign * moving["C"], deformation=before)
        run.state_was_replaced()
        run.step(dt := 1e-3)
        after = group.read()
        J, C, body = after["deformation"], after["C"], after["body"]
        free = before * np.linalg.det(np.eye(2) + dt * C)
        assert J[body == 0] == pytest.approx(grown(before, C, dt)[body == 0], rel=1e-14)
        assert J[body == 1] == pytest.approx(free[body == 1], rel=1e-14)
        assert J[body == 2] == pytest.approx((free * np.minimum(1 / before, 1))[body == 2], rel=1e-14)
        # What opens does so up to OPENED.
        assert (np.abs(grown(before, C, dt) - free)[body == 0] > 1e-5).any() == (sign < 0)


# For how long nothing was relaxed before the step of `stepped`, s.
UNRELAXED = 2e-3


def stepped(run: Run, dt: float) -> tuple[dict, dict, dict]:
    """Return a law's particles, and those after a step that relaxes volumes, and after one that does not."""
    saved, found = run.save().copied(), [run.groups[0].read()]
    for steps in (INTERVAL - 1, 0):
        run.load(saved)
        run.state.unrelaxed_steps = steps
        run.state.unrelaxed = UNRELAXED
        run.step(dt)
        found.append(run.groups[0].read())
    return tuple(found)


@pytest.mark.parametrize(
    ("densities", "walls", "d"),
    [
        slow((1000.0,), "slip", 2, id="one density"),
        pytest.param((1000.0, 400.0), {"default": "stick", "x_max": "slip"}, 2, id="two densities"),
        slow((1000.0,), "slip", 3, id="3D"),
    ],
)
def test_volume_follows_the_grid(
    backend_of: Callable, monkeypatch: pytest.MonkeyPatch, densities: tuple[float, ...], walls: object, d: int
) -> None:
    """J += share sgn(g) max(|g| - band, 0), g = 1/sum(w n) - J, where all n > FULL; share = a/(1 + a), a = rate c t/h.

    Down to J = 1 all of g - DEAD_BAND or g + FREE_DEAD_BAND instead, and below it at least to LARGEST_LACK less than
    1/sum(w n) or 1. It grows only where the nodes beside the stencil are filled, too.

    The same step without relaxation differs by that alone: positions, velocities and gradients have the same bytes.
    """
    # Steps that relax also measure the share of its stress that a particle bears.
    monkeypatch.setattr(Fluid, "eases", ())
    monkeypatch.setenv(kernel_store.SWITCH, "off")
    run = build_run(pool(*densities, walls=walls, d=d), backend_of("f64"))
    (group,) = run.groups
    # Too dense by a seventh, on average.
    random = np.random.default_rng(3)
    group.replace(x=group.read()["x"] * [1.0, 0.85, 1.0][:d], deformation=random.uniform(0.7, 1.2, group.count))
    run.state_was_replaced()
    run.step(1e-4)
    before, relaxed, plain = stepped(run, 1e-4)
    volume = np.array([b.volume for b in sample_bodies(run.scene)])[before["body"]]
    seen, least, beside = seen_ratio(before["x"], volume, run.scene.domain.cells)
    crossings = np.sqrt(BULK / np.array(densities))[before["body"]] * (UNRELAXED + 1e-4) / H
    J = before["deformation"]
    moves = (least > FULL) & ((seen < J) | (beside * seen > BESIDE))
    gap = (seen - J) * moves
    free = np.maximum(J + np.maximum(gap - DEAD_BAND, 0) + np.minimum(gap + FREE_DEAD_BAND, 0), 1)
    free = np.where(J >= 1, free, J)
    gap = np.maximum(seen - free, np.minimum(1 - free, 0) - LARGEST_LACK) * moves
    gap = np.where(gap > 0, np.clip(seen - 1, 0, gap), gap)
    share = RELAXATION * crossings / (1 + RELAXATION * crossings)
    expected = free + share * np.sign(gap) * np.maximum(np.abs(gap) - DEAD_BAND, 0)
    held = np.where(moves & (seen > J), np.minimum(seen, 1) - LARGEST_LACK, 0)
    for changed in (free[J >= 1] != J[J >= 1], expected != free, seen < free - LARGEST_LACK, held > expected):
        assert 0.02 < changed.mean() < 0.98
    expected = np.maximum(expected, held)
    if len(densities) == 1:
        # Of two layers one keeps a share of its C, which is not the one by which volumes grow.
        assert plain["deformation"] == pytest.approx(grown(J, plain["C"], 1e-4), abs=1e-13)
    factor = plain["deformation"] / J
    assert relaxed["deformation"] == pytest.approx(expected * factor, rel=1e-12)
    for name in ("x", "v", "C"):
        assert relaxed[name].tobytes() == plain[name].tobytes()


def test_sand_follows_the_grid(backend_of: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """v += max(min(g, ln s) + ln N, 0) + min(g + band, 0), at least 0; g = ln s - v - tr e, s = 1/sum(w n).

    Behind walls n = 1. N is the normal distribution function of z, with exp(-z^2 / (4 a)) = slope sqrt(2 pi a) and
    a = 1/2 - 1/30. Pressed sand, tr e < 0, opens by a share of it. What follows no grid keeps its v.
    """
    # Grains by themselves have v = 0.
    monkeypatch.setattr(Sand, "eases", ())
    monkeypatch.setenv(kernel_store.SWITCH, "off")
    sand = {"law": "sand", "density": 1600.0, "youngs_modulus": 1e6, "friction_angle": 30.0, "poissons_ratio": 0.3}
    bodies = [
        block(f"sand {k}", law, [0.6 * k, 0.0], [0.6 * (k + 1), 0.5], sampling="jittered")
        for k, law in enumerate(sand | {"volume_correction": corrected} for corrected in (True, False))
    ]
    run = build_run(unshifted(scene([12, 8], H, bodies, 1.0, walls="slip", precision="f64")), backend_of("f64"))
    (group,) = run.groups
    # Too thin by an eighth, on average.
    group.replace(x=group.read()["x"] * [1.0, 1.15])
    run.state_was_replaced()
    # Sorts the particles.
    run.step(1e-5)
    random = np.random.default_rng(3)
    strain = np.where(random.uniform(size=group.count) < 0.5, -0.02, 0.0)
    opened = np.where(strain < 0, 0.0, random.uniform(0, 0.3, group.count))
    group.replace(deformation=np.exp(strain / 2)[:, None, None] * np.eye(2), internal=np.stack([opened, 0 * opened], 1))
    # What is at rest stays as it is.
    group.replace(v=np.zeros((group.count, 2)), C=random.normal(size=(group.count, 2, 2)))
    before, relaxed, plain = stepped(run, 1e-5)
    x, body = before["x"], before["body"]
    volume = np.array([b.volume for b in sample_bodies(run.scene)])[body]
    filled, slope = filling(x, volume, run.scene.domain.cells)
    seen = 1 / filled
    gap = np.log(seen) - opened - strain
    narrow = 1 / 2 - 1 / 30
    z = np.sqrt(-4 * narrow * np.log(np.clip(slope * np.sqrt(2 * np.pi * narrow), 1e-6, 1)))
    below = np.log(norm.cdf(z))
    crossings = np.sqrt(sound_modulus(1e6, 0.3) / 1600.0) * (UNRELAXED + 1e-5) / H
    share = np.where(strain < 0, GRAINS_RELAXATION * crossings / (1 + GRAINS_RELAXATION * crossings), 1.0)
    opening = np.maximum(np.minimum(gap, np.log(seen)) + below, 0) * share
    closing = np.minimum(gap + BAND, 0)
    moves = body == 0
    expected = np.where(moves, np.maximum(opened + opening + closing, 0), opened)
    at_surface = moves & (below < -0.1)
    for where in (moves, at_surface):
        assert min((where & (opening > 0) & (strain < 0)).sum(), (where & (opening > 0) & (strain == 0)).sum()) > 3
    assert (moves & (closing < 0)).sum() > 5
    # Kernels have N to 2e-4.
    assert relaxed["internal"][:, 0] == pytest.approx(expected, abs=3e-4)
    assert plain["internal"][:, 0] == pytest.approx(opened, abs=1e-15)
    for name in ("x", "v", "C", "deformation"):
        assert relaxed[name].tobytes() == plain[name].tobytes()


def sound_modulus(youngs_modulus: float, nu: float) -> float:
    """Return lambda + 2 mu, Pa."""
    return youngs_modulus * (1 - nu) / ((1 + nu) * (1 - 2 * nu))


def test_nodes_keep_volume_only_where_densities_differ(backend_of: Callable) -> None:
    """The plan counts it; liquids of one density and those that are not relaxed do without."""
    backend = backend_of("f32")
    held = pool(1000.0, 400.0, alike=True)
    off = held.model_copy(
        update={
            "bodies": [
                body.model_copy(update={"material": body.material.model_copy(update={"volume_correction": False})})
                for body in held.bodies
            ]
        }
    )
    one = make_plan(pool(1000.0, 1000.0), backend).bytes_per_node
    assert [make_plan(each, backend).bytes_per_node / one for each in (held, off)] == [2, 1]
    assert [build_run(each, backend).grid.filling is not None for each in (held, off)] == [True, False]


def uncorrected(tables: dict) -> Scene:
    bodies = [{**body, "material": {**body["material"], "volume_correction": False}} for body in tables["bodies"]]
    return scenes.scene_of(**{"contact": {}} | tables | {"bodies": bodies})


@pytest.mark.parametrize(
    ("name", "least"),
    [slow("toss", 0.3), slow("sand_toss", 0.3), slow("dam_at_rest", 0.05), slow("stirred_pool", 0.05)],
)
def test_a_case_of_volume_fails_without_the_correction(
    backend_of: Callable, record_property: Callable, name: str, least: float
) -> None:
    """Nothing else keeps it; the cases hold 2 % (test_validation_cases)."""
    case = all_cases()[name]
    asked = uncorrected(case.scene_tables(1, Setting()))
    error = case.measure(1, asked, build_run(asked, backend_of("f64", 1)).frames())["volume error"]
    record_property("volume error", error)
    assert abs(error) > least


@pytest.mark.slow
def test_shorter_steps_change_nothing(backend_of: Callable) -> None:
    """At a quarter of the step a tossed pool has its depth to 2 % as well.

    The two differ by 1.9 %, which is not explained: relaxation under pressure goes by time, and above J = 1 the same
    difference remains where following goes by time, too.
    """
    case = all_cases()["toss"]
    errors = []
    for safety in (0.8, 0.2):
        asked = scene_of(case, 1, Setting(safety=safety))
        errors.append(case.measure(1, asked, build_run(asked, backend_of("f64", 1)).frames())["volume error"])
    assert np.abs(errors).max() < 0.02


def test_volume_error_of_known_blocks() -> None:
    """Particles of h^2/4 on a lattice that is stretched by s: the cells inside hold s^2 as much per particle.

    The block stands in a corner; neither the cells at its free sides nor those beside another material are inside. The
    edge of what is inside is sharp to a particle, one in 60 along each axis.
    """
    cells = (45, 45)

    def error_of(x: np.ndarray, volume: np.ndarray, flows: np.ndarray) -> float:
        """Return the error at the second of three times, of which the others are empty corners."""
        times = [np.zeros_like(x), x, np.zeros_like(x)]
        alone = volume_errors(x[None], volume[None], flows, H, cells, (False,) * len(cells))
        found = volume_errors(np.stack(times), np.tile(volume, (3, 1)), flows, H, cells, (False,) * len(cells))
        assert found.tolist() == [0.0, alone[0], 0.0]
        return alone[0]

    for stretch in (1.0, 0.8, 1.25):
        grid = (np.arange(60) + 0.5) * H / 2 * stretch
        x = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
        volume = np.full(len(x), H * H / 4)
        flows = np.ones(len(x), bool)
        sharp = 2 * 2 / 60 * stretch**2
        assert error_of(x, volume, flows) == pytest.approx(stretch**2 - 1, abs=sharp)
        assert error_of(x, volume * stretch**2, flows) == pytest.approx(0, abs=sharp / stretch**2)
        assert error_of(x, volume, ~flows) == 0
        beside = x[:, 0] > 15 * H * stretch
        both = np.where(beside, 100 * volume, volume)
        assert error_of(x, both, ~beside) == pytest.approx(stretch**2 - 1, abs=2 * sharp)
    few = (x < 4 * H).all(1)
    assert error_of(x[few], volume[few], flows[few]) == 0
