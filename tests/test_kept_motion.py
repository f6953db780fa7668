"""What bodies keep of their motion in steps shorter than their own (docs/theory.md, 2.3)."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scenes import ball, block, body, box, scene_of, slow
from solver_state import bodies_of

from mpmcli.scene import Scene, sample_bodies
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.machine.backend import Backend
from mpmcli.solver.machine.costs import law_objects
from mpmcli.solver.transfer.kept_motion import OWN_STEP, kept_share, own_limit
from mpmcli.validation.case import Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runs import scene_of as scene_of_case

SOFT = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e4, "poissons_ratio": 0.3}


def meeting(
    stiffer: float, *, safety: float = 0.8, end: float = 0.4, beside: Sequence[dict] = (), **solver: object
) -> Scene:
    """Return two free balls that meet off centre, the second of a modulus that is `stiffer` times as large."""
    balls = (("soft", [0.7, 0.9], 1.0, 1.0), ("stiff", [1.35, 1.05], -1.0, stiffer))
    return scene_of(
        domain={"size": [2.0, 2.0], "spacing": 0.05},
        time={"end": end, "frames": 4, "safety": safety},
        solver={"precision": "f64", **solver},
        bodies=[
            body(name, SOFT | {"youngs_modulus": 1e4 * factor}, ball(center, 0.2), velocity=[speed, 0.0])
            for name, center, speed, factor in balls
        ]
        + [*beside],
    )


def test_n_short_steps_lose_what_one_does() -> None:
    """To first order; nothing is kept near the own step, and `flip` of it at least with AFLIP."""
    assert kept_share(0.8, 1.0) == kept_share(0.7, 1.0) == 0.0
    for n in (2, 10, 50):
        assert 1 - kept_share(0.8 / n, 1.0) == pytest.approx(1 / n, rel=1e-12)
        assert 1 - kept_share(0.8 / n, 0.25) == pytest.approx(0.25 / n, rel=1e-12)


@pytest.mark.parametrize(
    ("scene", "kept"), [(meeting(1.0), False), (meeting(1.0, safety=0.1), True), (meeting(9.0), True)]
)
def test_only_scenes_with_short_steps_store_shares(backend_of: Callable, scene: Scene, kept: bool) -> None:
    assert (build_run(scene, backend_of("f64", 1)).grid.scheme.keeps_flip_velocity) == kept


@pytest.mark.parametrize(("part", "kept"), [(1.0, 0.85), (0.5, 0.925), (0.1, 0.985)])
def test_sand_keeps_a_share_of_what_nodes_do_not_see(backend_of: Callable, part: float, kept: float) -> None:
    """Rows half a cell apart that move in opposite ways sum to zero at all nodes: a step leaves a share of all of it.

    Sand keeps 0.85 in a step of its own, and loses as much per second in shorter ones.
    """
    sand = {"law": "sand", "density": 1600.0, "youngs_modulus": 1e6, "friction_angle": 35.0}
    shape = box([0.2, 0.2], [0.8, 0.8])
    scene = scene_of(body("sand", sand, shape, sampling="lattice"), size=[1.0, 1.0], spacing=0.1, precision="f64")
    sample = sample_bodies(scene)[0]
    row = np.round(sample.position / 0.05 - 0.5).astype(int)
    velocity = 1e-6 * (-1.0) ** row.sum(axis=1)[:, None] * [1.0, 0.5]
    run = build_run(scene, backend_of("f64", 1), [replace(sample, velocity=velocity)])
    run.step(OWN_STEP * part * own_limit(scene.sources[0], law_objects(scene)[0], scene))
    after = bodies_of(run)["sand"]
    middle = np.abs(after.x - 0.5).max(axis=1) < 0.15
    assert after.v[middle] == pytest.approx(kept * velocity[middle], rel=1e-5)


@pytest.mark.parametrize("solids", ["updated", slow("total")])
def test_bodies_of_unequal_shares_keep_both_momenta(backend_of: Callable, solids: str) -> None:
    run = build_run(meeting(100.0, solids=solids), backend_of("f64", 1))
    rows = [row for _, row in run.frames()]
    shares = run.groups[0].arrays.kept.to_numpy()[:2]
    assert shares[0] > shares[1] + 0.4
    # Contact of total solids does not keep angular momentum.
    for name in ("linear_momentum", "angular_momentum")[: 2 if solids == "updated" else 1]:
        drift = np.subtract(getattr(rows[-1], name), getattr(rows[0], name))
        assert np.abs(drift).max() < 1e-12 * rows[0].mass


def test_deformation_bounds_a_bodys_own_step(backend_of: Callable) -> None:
    """A cell that is stretched at r = 2/s, nearly without stiffness: 0.5 / r; its speed allows twice that."""
    soft = SOFT | {"youngs_modulus": 1e-6}
    scene = scene_of(
        block("cell", soft, [0.5, 0.5], [0.55, 0.55], velocity=["2 * (X - 0.525)", "-2 * (Y - 0.525)"]),
        domain={"size": [1.0, 1.0], "spacing": 0.05},
        step=0.02,
        precision="f64",
    )
    run = build_run(scene, backend_of("f64", 1))
    for _ in range(2):
        run.step(0.02)
    assert run.groups[0].arrays.kept.to_numpy()[0] == pytest.approx(kept_share(0.02 * 2 / 0.5, 1.0), rel=1e-6)


def lost(scene: Scene, backend: Backend) -> float:
    """Return the share of its energy that a scene has lost at its end; no frame has more than the one before.

    The springs between `total` bodies store what the ledger does not have: with them none has more than the first.
    """
    energy = np.array([row.energy for _, row in build_run(scene, backend).frames()])
    before = energy[:1] if scene.solver.solids == "total" else energy[:-1]
    assert (energy[1:] - before).max() < 1e-3 * energy[0]
    return 1 - energy[-1] / energy[0]


def ringing(safety: float, **solver: object) -> Scene:
    """Return a free bar of 16 cells that rings in its first mode for five periods."""
    bar = box([0.32, 0.3], [1.12, 0.5])
    return scene_of(
        body("bar", SOFT, bar, velocity=["0.01 * cos(pi*(X-0.32)/0.8)", 0.0]),
        domain={"size": [1.5, 0.8], "spacing": 0.05},
        time={"end": 2.2, "frames": 11, "safety": safety},
        solver={"precision": "f64", **solver},
    )


def test_a_free_bar_loses_as_much_in_a_second_at_any_step(backend_of: Callable) -> None:
    """At steps of 0.8 of the bound, and of a fifth and a fiftieth of that.

    A plane wave loses as much to 3 % (hard case H19); at free ends short steps take a little more.
    """
    whole = lost(ringing(0.8), backend_of("f64", 1))
    assert 0.005 < whole < 0.1
    for part in (5, 50):
        assert lost(ringing(0.8 / part), backend_of("f64", 1)) == pytest.approx(whole, rel=0.2)


@pytest.mark.parametrize(
    ("solver", "end", "tolerance"),
    [
        slow({"f_bar": False}, 0.4, 0.1),
        ({"f_bar": True}, 0.4, 0.1),
        # At 0.4 s their springs still return energy.
        slow({"solids": "total"}, 0.8, 0.2),
    ],
    ids=str,
)
def test_bodies_that_meet_lose_as_much_at_any_step(
    backend_of: Callable, solver: dict, end: float, tolerance: float
) -> None:
    """Two balls that meet off centre, in steps of 1, 1/5 and 1/50; averaged volumes and contact are as they were."""
    backend = backend_of("f64", 1)
    whole, *parts = (lost(meeting(1.0, safety=0.8 / n, end=end, **solver), backend) for n in (1, 5, 50))
    assert parts == pytest.approx([whole] * 2, rel=tolerance)


@pytest.mark.parametrize(
    ("name", "n", "parts", "measures", "bound"),
    [
        *(slow(f"{name}_blocks", 8, (1, 5, 50), None, 4e-3) for name in ("metal", "paste", "snow", "sand")),
        ("toss", 1, (1, 5), ("volume error",), 0.02),
    ],
)
def test_what_is_known_is_as_far_off_at_any_step(
    backend_of: Callable, name: str, n: int, parts: tuple[int, ...], measures: tuple[str, ...] | None, bound: float
) -> None:
    """In steps of 1, 1/5 and 1/50: the stress of blocks in homogeneous motion, which waves from faces disturb.

    Water that is thrown and falls back has its volume again; its steps of 1/50 take 10 s more.
    """
    case = all_cases()[name]
    for part in parts:
        scene = scene_of_case(case, n, Setting(safety=0.8 / part))
        found = case.measure(n, scene, build_run(scene, backend_of("f64", 1)).frames())
        assert max(abs(found[measure]) for measure in measures or found) < bound, part


@pytest.mark.parametrize(("name", "n", "measure", "tolerance"), [
    slow("two_disks", 20, "energy loss", 0.05),
    slow("conservation_contact", 16, "energy loss", 0.02),
    slow("conservation", 8, "energy loss", 0.02),
    slow("taylor_green", 16, "decay error", 0.05),
    slow("dam_break", 16, "front error", 0.05),
    slow("bar_fixed_fixed", 13, "energy loss", 0.05),
    slow("bar_fixed_free", 13, "energy loss", 0.2),
    slow("spinning_disc", 8, "energy loss", 0.1),
])  # fmt: skip
def test_the_table_of_what_steps_lose(backend_of: Callable, name: str, n: int, measure: str, tolerance: float) -> None:
    """Of docs/theory.md, 2.3: what validation cases lose in steps of 1, 1/5 and 1/50; differences fall with h."""
    case, lost = all_cases()[name], []
    for part in (1, 5, 50):
        scene = scene_of_case(case, n, Setting(safety=0.8 / part))
        lost.append(case.measure(n, scene, build_run(scene, backend_of("f64", 1)).frames())[measure])
    assert lost[1:] == pytest.approx([lost[0]] * 2, rel=tolerance)


def test_a_stiff_bystander_takes_nothing(backend_of: Callable) -> None:
    """Two balls that meet lose as much energy beside a body at rest whose steps are a tenth as long."""
    shape = box([0.9, 1.5], [1.1, 1.7])
    stiff = body("bystander", SOFT | {"youngs_modulus": 1e6}, shape)
    backend = backend_of("f64", 1)
    assert lost(meeting(1.0, beside=[stiff]), backend) == pytest.approx(lost(meeting(1.0), backend), rel=0.1)
