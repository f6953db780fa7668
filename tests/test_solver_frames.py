"""Frames and the ledger: on time, in the particles' own order, and as their formulas say."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import taichi as ti
from scenes import block, body, liquid, scene_of, solid
from solver_state import bodies_of

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import Scene, sample_bodies
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.frames.builder import ledger_sums, sums_of_rows
from mpmcli.solver.frames.columns import FrameArrays, FrameColumns, RunConstants
from mpmcli.solver.frames.diagnosis import read_group

H = 0.1
FIELDS = ["velocity", "density", "pressure", "volume_ratio", "deformation_gradient", "affine", "stress", "mass"]
E, NU, K = 2e4, 0.3, 3e4
GRAVITY = [0.3, -9.81]
Frames = list[tuple[Frame, LedgerRow]]


def tumbling() -> Scene:
    """Return two drops and two blocks, given in turn, that fall, turn and hit the floor."""
    fluid = liquid(K)
    solid = {"law": "neo_hookean", "density": 800.0, "youngs_modulus": E, "poissons_ratio": NU}

    def box(x: float, y: float) -> dict:
        return {"box": {"min": [x, y], "max": [x + 0.35, y + 0.3]}}

    spin = [[0.0, -3.0], [3.0, 0.0]]
    return scene_of(
        body("a", fluid, box(10.1, -4.8), velocity=[2.0, 0.0]),
        body("b", solid, box(10.7, -4.6), velocity_gradient=spin),
        body("c", {**fluid, "density": 500.0}, box(11.6, -4.7)),
        body("d", {**solid, "density": 400.0}, box(12.4, -4.8), velocity=[-2.0, 1.0]),
        domain={"size": [3.0, 1.5], "origin": [10.0, -5.0], "spacing": H, "gravity": GRAVITY},
        time={"end": 0.6, "frames": 7},
        precision="f64",
        fields=FIELDS,
    )


@pytest.fixture(scope="module")
def run(backend_of: Callable) -> Run:
    """Return the run of the tumbling scene, after all of its frames."""
    return build_run(tumbling(), backend_of("f64"))


@pytest.fixture(scope="module")
def frames(run: Run) -> Frames:
    """Return every frame of the tumbling scene."""
    return list(run.frames())


def test_one_launch_reads_what_the_fields_hold(run: Run, frames: Frames) -> None:
    """Every array of a group, against Taichi's own copy of each field."""
    assert frames
    for group in run.groups:
        found = group.read()
        fields, d = group.arrays, group.dimension

        def own(field: ti.Field) -> np.ndarray:
            """Return what a field holds of the particles; there is room for more."""
            return field.to_numpy()[: group.count]  # noqa: B023

        internal = [own(values) for values in fields.internal]
        place = np.zeros(group.count, int) if fields.body is None else own(fields.body)
        if fields.displacement_gradient is None:
            deformation = 1 + own(fields.J_minus_1)
        else:
            deformation = np.eye(d) + own(fields.displacement_gradient)
        expected = {
            "x": own(fields.x), "v": own(fields.v), "C": own(fields.gradient)[:, :, :d].transpose(0, 2, 1),
            "deformation": deformation, "internal": np.array(internal).reshape(len(internal), group.count).T,
            "id": own(fields.id), "body": np.array(group.bodies)[place],
        }  # fmt: skip
        assert found.keys() == expected.keys()
        for name, array in expected.items():
            assert found[name].shape == array.shape and np.array_equal(found[name], array), name


def test_a_kernel_sums_and_orders_as_numpy_does(run: Run, frames: Frames) -> None:
    """The frame by one launch against the arrays of the groups, and the ledger against sums in numpy."""
    frame, row = run.frame(7)
    columns = FrameColumns(2, 2, ("affine", "deformation_gradient"))
    shown = FrameArrays(columns, np.zeros((1, len(frame.body), columns.count)))
    run._read(shown)
    assert np.array_equal(frame.velocity, shown["v"][0])
    assert np.array_equal(frame.position, shown["x"][0] + np.array(run.scene.domain.origin))
    for group in run.groups:
        own = read_group(group)
        assert np.array_equal(frame.body[own.id], own.body)
        assert {run.laws[m] for m in frame.material[own.id]} == {group.law.name}
        for name, values in (("x", own.x), ("v", own.v), ("affine", own.C.reshape(-1, 4))):
            assert np.array_equal(shown[name][0, own.id], values), name
        J = own.deformation if own.deformation.ndim == 1 else np.linalg.det(own.deformation)
        F = np.sqrt(J)[:, None, None] * np.eye(2) if own.deformation.ndim == 1 else own.deformation
        np.testing.assert_allclose(shown["J"][0, own.id], J, rtol=1e-13)
        np.testing.assert_allclose(shown["gradient"][0, own.id], F.reshape(-1, 4), atol=1e-13)
    constants = RunConstants(run.groups, [body.count for body in sample_bodies(run.scene)])
    sums = sums_of_rows(shown, constants.of_rows(slice(0, len(frame.body))), total=False)
    gravity, last_step = np.array([run.scene.domain.gravity]), np.array([run.last_step])
    for name, expected in ledger_sums(sums, gravity, run.spacing, last_step).items():
        np.testing.assert_allclose(getattr(row, name), expected[0], rtol=1e-12, err_msg=name)
    ratios = shown["J"][0]
    assert (row.volume_ratio_min, row.volume_ratio_max) == pytest.approx((ratios.min(), ratios.max()), rel=1e-12)
    assert np.abs(frames[-1][1].angular_momentum[0]) > 0 and row.elastic > 0


def test_frames_land_on_their_times(frames: Frames) -> None:
    """t_k = end k / frames, exactly, from 0 on; the steps of an interval sum to it."""
    assert [frame.index for frame, _ in frames] == list(range(8))
    assert [frame.time for frame, _ in frames] == [0.6 * k / 7 for k in range(8)]
    taken = 0
    for frame, row in frames:
        taken += row.steps
        assert frame.step == taken
        assert row.time == frame.time
        if row.steps:
            assert row.step_min <= 0.6 / 7 / row.steps * (1 + 1e-9)
            assert row.step_max >= 0.6 / 7 / row.steps * (1 - 1e-9)


def test_every_row_is_the_same_particle_in_every_frame(frames: Frames, run: Run) -> None:
    """Rows start at the lattice of the bodies in the scene's order, and move by less than v dt between frames."""
    samples = sample_bodies(run.scene)
    first = frames[0][0]
    assert np.array_equal(first.position, np.concatenate([s.position for s in samples]))
    assert np.array_equal(first.velocity, np.concatenate([s.velocity for s in samples]))
    body = np.repeat(np.arange(4), [s.count for s in samples])
    law = np.array([run.laws.index(b.material.law) for b in run.scene.bodies])
    for (before, _), (frame, _) in pairwise(frames):
        assert np.array_equal(frame.body, body)
        assert np.array_equal(frame.material, law[body])
        assert frame.body.dtype == frame.material.dtype == np.int32
        moved = np.linalg.norm(frame.position - before.position, axis=1)
        # 5 m/s is more than any particle reaches here; a mixed-up row would jump by up to 3 m.
        assert moved.max() < 5 * 0.6 / 7
        assert np.isfinite(frame.position).all()
    # The sort did move particles in memory, or this would show nothing.
    assert any((np.diff(group.read()["id"]) < 0).any() for group in run.groups)


def test_neighbours_of_a_lattice_stay_neighbours_in_a_solid(frames: Frames, run: Run) -> None:
    """In an elastic body x_q - x_p = F_p (X_q - X_p) to second order: rows, positions and F belong together."""
    first, last = frames[0][0], frames[-1][0]
    for b in (1, 3):
        rows = np.flatnonzero(first.body == b)
        X, x = first.position[rows], last.position[rows]
        F = last.fields["deformation_gradient"][rows].reshape(-1, 2, 2)
        distance = np.linalg.norm(X[:, None] - X[None], axis=2)
        p, q = np.nonzero((distance > 0) & (distance < 0.06))
        expected = np.einsum("nij,nj->ni", (F[p] + F[q]) / 2, X[q] - X[p])
        error = np.linalg.norm(x[q] - x[p] - expected, axis=1) / distance[p, q]
        assert np.median(error) < 0.05
        assert error.max() < 0.5


def test_fields_are_their_formulas(frames: Frames, run: Run) -> None:
    """density = rho0 / J, p = -tr(sigma) / 3, sigma of each law or a share of it, J = det F, mass = rho0 V0."""
    samples = sample_bodies(run.scene)
    counts = [s.count for s in samples]
    rho0 = np.repeat([b.material.density for b in run.scene.bodies], counts)
    for frame, _ in frames:
        fields = frame.fields
        assert set(fields) == set(FIELDS) - {"velocity"}
        n = len(frame.position)
        assert {name: value.shape for name, value in fields.items()} == {
            "density": (n,),
            "pressure": (n,),
            "volume_ratio": (n,),
            "mass": (n,),
            "deformation_gradient": (n, 4),
            "affine": (n, 4),
            "stress": (n, 9),
        }
        J = fields["volume_ratio"]
        F = fields["deformation_gradient"].reshape(n, 2, 2)
        sigma = fields["stress"].reshape(n, 3, 3)
        assert np.linalg.det(F) == pytest.approx(J, rel=1e-12)
        assert fields["density"] == pytest.approx(rho0 / J, rel=1e-12)
        assert fields["mass"] == pytest.approx(np.repeat([s.mass for s in samples], counts), rel=1e-15)
        assert fields["pressure"] == pytest.approx(-np.trace(sigma, axis1=1, axis2=2) / 3, abs=1e-9 * K)
        fluid = np.isin(frame.body, [0, 2])
        opened = J[fluid] - 1
        # Suction rises until the fluid tears, at J = 1.005, and is gone at 1.01.
        tau = np.where(opened < 0, K * opened, np.maximum(np.minimum(K * opened, K * (0.01 - opened)), 0))
        pressure = -tau / J[fluid]
        # A particle bears a share of it, from 1 / 1.5^2 alone to 1 among others (test_easing.py).
        loaded = np.abs(pressure) > 1e-6 * K
        share = fields["pressure"][fluid][loaded] / pressure[loaded]
        assert np.abs(fields["pressure"][fluid][~loaded]).max(initial=0.0) <= 1e-6 * K
        assert (share > 1.5**-2 - 1e-9).all() and (share < 1 + 1e-9).all()
        mu, lam = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
        b = np.tile(np.eye(3), (n, 1, 1))
        b[:, :2, :2] = F @ F.transpose(0, 2, 1)
        expected = (mu * (b - np.eye(3)) + lam * np.log(J)[:, None, None] * np.eye(3)) / J[:, None, None]
        assert np.abs(sigma - expected)[~fluid].max() < 1e-9 * E


def test_the_ledger_adds_up(frames: Frames, run: Run) -> None:
    """Mass, energies and momenta are the sums over the frame's own particles; nothing gains energy (9.9)."""
    for frame, row in frames:
        m, v = frame.fields["mass"], frame.velocity
        x = frame.position - np.array(run.scene.domain.origin)
        C = frame.fields["affine"].reshape(-1, 2, 2)
        kinetic = m @ ((v**2).sum(1) + H * H / 4 * (C**2).sum((1, 2))) / 2
        spin = m @ (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0] + H * H / 4 * (C[:, 1, 0] - C[:, 0, 1]))
        assert row.mass == pytest.approx(m.sum(), rel=1e-12)
        assert row.kinetic == pytest.approx(kinetic, rel=1e-12)
        # Half a step back, as the velocities are; the last step is known within step_min and step_max.
        weight = m @ (x @ np.array(GRAVITY)), 0.5 * (m @ (v @ np.array(GRAVITY)))
        unknown = abs(weight[1]) * (row.step_max - row.step_min) + 1e-12 * abs(weight[0])
        assert row.potential == pytest.approx(row.step_max * weight[1] - weight[0], abs=unknown)
        assert row.linear_momentum == pytest.approx(m @ v, rel=1e-9)
        assert row.angular_momentum == pytest.approx([spin], rel=1e-9)
        assert row.speed_max == pytest.approx(np.linalg.norm(v, axis=1).max())
        assert row.volume_ratio_min == frame.fields["volume_ratio"].min()
        assert row.volume_ratio_max == frame.fields["volume_ratio"].max()
        assert row.elastic >= 0
    energies = [row.energy for _, row in frames]
    assert max(energies) <= energies[0] * (1 + 1e-3)
    first = frames[0][1]
    assert (first.steps, first.step_min, first.step_max, first.limit, first.courant_max) == (0, 0.0, 0.0, "", 0.0)
    assert all(row.limit in ("wave", "speed", "deformation") for _, row in frames[1:])
    numbers = ("time", "step_min", "step_max", "speed_max", "courant_max", "kinetic", "elastic", "potential")
    for _, row in frames:
        assert {name: type(getattr(row, name)) for name in numbers} == dict.fromkeys(numbers, float)


def test_courant_number_is_that_of_the_fastest_particle(backend_of: Callable) -> None:
    """A heavy block slides along a slip floor at v: every node moves at v, and courant_max = v dt / h.

    The nodes beyond the floor hold momentum until the wall folds it, and momentum is no speed.
    """
    speed = 0.3
    scene = scene_of(
        block("block", solid(1e6, density=1e5), [0.6, 0.0], [1.0, 0.4], velocity=[speed, 0.0]),
        domain={"size": [2.0, 1.0], "spacing": H, "walls": "slip"},
        time={"end": 0.05, "frames": 2},
        precision="f64",
    )
    for _, row in list(build_run(scene, backend_of("f64")).frames())[1:]:
        assert row.courant_max == pytest.approx(speed * row.step_max / H, rel=1e-9)


def test_a_step_given_in_the_scene_is_a_maximum(backend_of: Callable) -> None:
    """time.step bounds every step and is named as its limit; the frames still land on their times."""
    data = tumbling().model_dump()
    data["time"] |= {"step": 1e-3, "end": 0.01, "frames": 3}
    del data["domain"]["cells"]
    rows = [row for _, row in build_run(scene_of(**data), backend_of("f64")).frames()]
    assert [row.steps for row in rows[1:]] == [4, 4, 4]
    assert all(row.step_max <= 1e-3 * (1 + 1e-6) for row in rows)
    assert all(row.limit == "maximum" for row in rows[1:])
    assert [row.time for row in rows] == [0.01 * k / 3 for k in range(4)]


def test_energies_of_bodies_at_rest(backend_of: Callable) -> None:
    """Bitwise rest: with no gravity and no motion nothing ever changes (H22)."""
    data = tumbling().model_dump()
    data["domain"]["gravity"] = [0.0, 0.0]
    del data["domain"]["cells"]
    for one in data["bodies"]:
        one["velocity"] = [0.0, 0.0]
        one["velocity_gradient"] = None
    run = build_run(scene_of(**data), backend_of("f64"))
    start = bodies_of(run)
    for _ in range(500):
        run.step(2e-3)
    for name, one in bodies_of(run).items():
        assert np.array_equal(one.x, start[name].x)
        assert np.array_equal(one.deformation, start[name].deformation)
        assert not one.v.any()


def falling(**time: object) -> dict:
    """Return a scene of a block of rubber that falls freely from 0.5 m."""
    return {
        "domain": {"size": [1.0, 1.0], "spacing": H, "gravity": [0.0, -9.81]},
        "time": {"end": 0.2, "frames": 4} | time,
        "solver": {"precision": "f64"},
        "bodies": [block("block", solid(1e6), [0.4, 0.5], [0.6, 0.7])],
    }


def test_the_energy_of_free_fall_is_constant(backend_of: Callable) -> None:
    """Half a step back, with the velocities, kinetic and potential energy add up to m g^2 dt^2 / 8 less than at t = 0.

    That is v = g (t - dt/2), and x + v dt/2 = x_0 - g t^2/2 + (g dt/2) (t - dt/2). With the positions as they are, the
    sum would be off by m g^2 t dt / 2.
    """
    rows = [row for _, row in build_run(scene_of(**falling()), backend_of("f64")).frames()]
    fallen = rows[0].potential - rows[-1].potential
    weight = rows[-1].mass * 9.81**2
    assert fallen == pytest.approx(weight * (0.2 - rows[-1].step_min / 2) ** 2 / 2, rel=1e-4)
    for row in rows[1:]:
        assert rows[0].energy - row.energy == pytest.approx(weight * row.step_max**2 / 8, abs=1e-10 * fallen, rel=1e-6)


def test_a_forced_step_is_taken_above_the_stable_one(backend_of: Callable) -> None:
    data = scene_of(**falling(end=0.01, frames=1, step=2e-3))
    _, (_, row) = build_run(data, backend_of("f64"), force=True).frames()
    assert (row.steps, row.step_max, row.limit) == (5, pytest.approx(2e-3), "forced")
    _, (_, row) = build_run(data, backend_of("f64")).frames()
    assert row.limit == "wave" and row.step_max < 2e-3


def test_a_run_can_be_stopped_between_two_frames(backend_of: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame may take hours: an interrupt does not wait for it, only for the launch, the first of which is a step."""
    monkeypatch.setattr("mpmcli.solver.engine.run.FIRST", 1)
    run, asked = build_run(scene_of(**falling(frames=1)), backend_of("f64")), []

    def at_the_second_launch() -> bool:
        asked.append(run.step_count)
        return len(asked) == 2

    with pytest.raises(KeyboardInterrupt):
        list(run.frames(at_the_second_launch))
    assert asked == [0, 1]
