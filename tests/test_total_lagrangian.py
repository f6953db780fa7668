"""Elastic bodies on the grid of their state at rest (docs/theory.md, 2.6)."""

import math
from collections.abc import Callable

import mpm_reference as reference
import numpy as np
import pytest
from contact_scenes import DENSITY, LAMBDA, MU, NU, E, jelly
from elastic_bodies import H, bars, body_scene, stirred
from law_probe import LawProbe
from law_tangent import unit_gradients
from scenes import block, body, scene_of

from mpmcli.errors import InputError
from mpmcli.materials.law import StateBound
from mpmcli.materials.registry import laws
from mpmcli.scene import sample_bodies
from mpmcli.solver.engine.run import build_run

# Of the domains of free bodies, which share a kernel.
CELLS = [40, 40]


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_step_is_that_of_plain_numpy(backend_of: Callable, dimension: int) -> None:
    """P2G with tau F^-T and dv/dX at X, G2P at X, F += dt dv/dX, x += dt v; a force pulls by X; the floor pushes at x.

    In 2D the kernel is that of the bar that is stretched below.
    """
    d, pull = dimension, 30.0
    faces = {"x_min": "slip", "y_min": "separate"}
    gravity = [1.0, -9.81, 0.5][:d]
    cells = [40, 10] if d == 2 else [8, 6, 5]
    shape = {"box": {"min": [0.0] * d, "max": [0.3, 0.2, 0.2][:d]}}
    scene = scene_of(
        body("body", jelly(), shape),
        domain={"size": [n * H for n in cells], "cells": cells, "walls": faces, "gravity": gravity},
        solver={"solids": "total", "precision": "f64"},
        forces=[{"acceleration": [f"{pull} * X", *[0.0] * (d - 1)]}],
    )
    run = build_run(scene, backend_of("f64", 1))
    stirred(run, d)
    group = run.groups[0]
    before, X = group.read(), group.arrays.initial.to_numpy()[: group.count]
    sample = sample_bodies(scene)[0]
    n, kick, dt = group.count, 0.5e-3, 1e-3
    F = before["deformation"]
    # The floor, and in 3D one wall more: a particle reaches by half of its spacing, stretched by F, at most
    # to where the wall is at rest.
    stiffness = (LAMBDA + 2 * MU) * sample.volume / (sample.mass * sample.volume ** (1 / d) * H)
    v = before["v"].copy()
    v[:, 0] += kick * pull * X[:, 0]
    for a in range(1, d):
        reach = np.minimum(0.5 * sample.volume ** (1 / d), X[:, a]) * np.linalg.norm(F[:, a], axis=1)
        overlap = np.maximum(reach - before["x"][:, a], 0.0)
        assert 0 < (overlap > 0).sum() < n
        v[:, a] += kick * stiffness * overlap
    # No wall that lets go is on the grid: here the body is away from all but the one that slips.
    cells = tuple(n + (20 if a else 0) for a, n in enumerate(scene.domain.cells))
    box = reference.Box(cells, H, np.array(gravity), [("slip", "stick")] * d)
    lifted = X + np.array([0.0, *[10 * H] * (d - 1)])
    tau = reference.neo_hookean_stress(np.full(n, MU), np.full(n, LAMBDA))
    particles = reference.Particles(
        lifted,
        v,
        before["C"] @ F,
        F,
        np.full(n, sample.mass),
        np.full(n, sample.volume),
        lambda F, p: tau(F, p) @ np.linalg.inv(F).T,
    )
    velocity = reference.update(*reference.scatter([particles], box, kick), box, kick)
    (after,) = reference.gather([particles], velocity, box, dt)
    F = F + dt * after.C
    run.step(dt)
    found = group.read()
    # The step begins with a sort.
    same = np.argsort(found["id"])[np.argsort(np.argsort(before["id"]))]
    found = {name: values[same] for name, values in found.items()}
    assert np.abs(found["v"] - after.v).max() < 1e-12 * np.abs(after.v).max()
    assert np.abs(found["x"] - (before["x"] + dt * after.v)).max() < 1e-14
    assert np.abs(found["deformation"] - F).max() < 1e-13
    assert np.abs(found["C"] - after.C @ np.linalg.inv(F)).max() < 1e-11 * np.abs(after.C).max()


def test_momenta_stay(backend_of: Callable) -> None:
    """A body that spins and swings keeps its momentum, and its angular momentum to second order in the spacing.

    Nodes have no place of their own: each particle sees them where its own F puts them.
    """

    def turned(cells: int) -> float:
        spacing = 0.4 / cells
        spin = {"velocity": [0.3, -0.4], "velocity_gradient": [[1.0, 4.0], [-6.0, -2.0]]}
        own = block("body", jelly(youngs_modulus=1e4), [0.6, 0.6], [1.2, 1.0], **spin)
        scene = body_scene(own, CELLS, end=0.5, frames=4, spacing=spacing)
        rows = [row for _, row in build_run(scene, backend_of("f64", 1)).frames()]
        assert max(row.volume_ratio_max for row in rows) > 1.2
        linear = np.array([row.linear_momentum for row in rows])
        assert np.abs(linear - linear[0]).max() < 1e-12 * np.abs(linear[0]).max()
        own = [row.angular_momentum[0] for row in rows]
        return max(abs(value - own[0]) for value in own) / abs(own[0])

    coarse, fine = turned(4), turned(8)
    assert fine < 2e-3
    assert coarse / fine > 2**1.9


def test_no_stencil_changes_as_a_body_flies(backend_of: Callable) -> None:
    """Flight over many cells does not change how a body swings: Galilean invariance to round-off."""

    def swing(speed: float) -> np.ndarray:
        own = block("body", jelly(), [0.2, 0.7], [0.6, 1.1], velocity=[speed, 0.0])
        scene = body_scene(own | {"velocity_gradient": [[1.0, 2.0], [0.5, -1.0]]}, CELLS, end=0.4)
        run = build_run(scene, backend_of("f64", 1))
        for _ in range(100):
            run.step(0.004)
        return run.groups[0].read()["deformation"]

    resting, flying = swing(0.0), swing(5.0)
    assert np.abs(resting - np.eye(2)).max() > 0.02
    assert np.abs(flying - resting).max() < 1e-12


def test_a_stretched_bar_does_not_tear(backend_of: Callable) -> None:
    """Pulled to three times its length, when its particles stand 1.5 cells apart, its stress is still that of F."""
    pull = 150.0
    scene = scene_of(
        block("bar", jelly(poissons_ratio=0.0), [0.0, 0.3], [1.0, 0.7], velocity=["4 * X", 0.0]),
        domain={"size": [4.0, 1.0], "spacing": H, "walls": {"x_min": "slip", "x_max": "separate"}},
        end=0.25,
        solver={"solids": "total", "precision": "f64"},
        fields=["velocity", "initial_position", "deformation_gradient"],
        forces=[{"acceleration": [f"{pull} * X", 0.0]}],
    )
    frame = list(build_run(scene, backend_of("f64", 1)).frames())[-1][0]
    X, x = frame.fields["initial_position"], frame.position
    row = np.isclose(X[:, 1], X[:, 1].min())
    order = np.argsort(X[row, 0])
    gaps = np.diff(x[row, 0][order])
    spacing = np.diff(X[row, 0][order])
    assert gaps.max() > 1.3 * H
    # Each gap is that of the stored deformation.
    F = frame.fields["deformation_gradient"].reshape(-1, 2, 2)[row][order, 0, 0]
    assert np.abs(gaps / spacing / (0.5 * (F[1:] + F[:-1])) - 1).max() < 0.01


@pytest.mark.parametrize("safety", [0.98, pytest.param(0.8, marks=pytest.mark.slow)])
def test_a_bar_bounces_off_a_wall_after_a_wave_has_gone_there_and_back(backend_of: Callable, safety: float) -> None:
    """It meets the wall where its surface does, stays for 2 L / c, and gains no energy."""
    n, speed, gap = 16, 0.1, 4
    h = 1 / n
    c = math.sqrt(E / DENSITY)
    start = gap * h / speed
    low, high = [gap * h, 16 * h], [1 + gap * h, 21 * h]
    own = block("body", jelly(poissons_ratio=0.0), low, high, velocity=[-speed, 0.0])
    scene = body_scene(own, CELLS, end=start + 4 / c, frames=400, safety=safety, spacing=h)
    rows = [row for _, row in build_run(scene, backend_of("f64", 1)).frames()]
    times = np.array([row.time for row in rows])
    moving = np.array([row.linear_momentum[0] / row.mass / speed for row in rows])
    energy = np.array([row.kinetic + row.elastic for row in rows])
    assert abs(times[np.argmax(moving > -0.999)] - start) * speed < 0.3 * h
    contact = times[np.argmax(moving > moving[-1] - 0.02)] - times[np.argmax(moving > -0.98)]
    assert contact == pytest.approx(2 / c, rel=0.1)
    assert 0.95 < moving[-1] <= 1
    assert energy.max() <= energy[0] * (1 + 1e-9)


@pytest.mark.parametrize("word", ["separate", pytest.param("slip", marks=pytest.mark.slow)])
def test_a_block_rests_on_a_floor(backend_of: Callable, word: str) -> None:
    """It comes to rest where its weight balances the push: within a hundredth of a cell of the floor."""
    walls = {"y_min": word, "y_max": "separate", "x_min": "separate", "x_max": "separate"}
    own = block("body", jelly(youngs_modulus=1e6), [0.5, 0.21], [1.1, 0.61])
    scene = body_scene(own, CELLS, walls=walls, gravity=[0.0, -9.81], end=4.0, frames=4)
    frame, row = list(build_run(scene, backend_of("f64", 1)).frames())[-1]
    lowest = frame.position[:, 1].min()
    assert row.kinetic < 1e-3 * row.mass * 9.81 * 0.4
    assert abs(lowest - H / 4) < 0.02 * H


@pytest.mark.parametrize("law", ["neo_hookean", "fixed_corotated"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_no_state_is_stiffer_than_its_bound(backend_of: Callable, law: str, dimension: int) -> None:
    """The eigenvalues of dP/dF, P = tau F^-T, by central differences, against `reference_modes`; exact at rest."""
    member = laws()[law]
    parameters = member.parameters(law=law, density=DENSITY, youngs_modulus=E, poissons_ratio=NU)
    backend_of("f64", 1)
    probe = LawProbe(member, parameters, dimension)
    rng = np.random.default_rng(1)
    d, n, strain = dimension, 200, 1e-6
    F = np.eye(d) + rng.uniform(-0.5, 0.5, (n, d, d)) * rng.uniform(0, 1, (n, 1, 1))
    F = np.concatenate([np.eye(d)[None], F[np.linalg.det(F) > 0.1]])
    internal = probe.at_rest(len(F))

    def first_piola(F: np.ndarray) -> np.ndarray:
        return probe(F, internal).tau[:, :d, :d] @ np.linalg.inv(F).transpose(0, 2, 1)

    columns = [
        (first_piola(F + strain * unit) - first_piola(F - strain * unit)).reshape(len(F), d * d) / (2 * strain)
        for unit in unit_gradients(d)
    ]
    stiffest = np.linalg.eigvals(np.stack(columns, axis=2)).real.max(axis=1)
    J, stretch = np.linalg.det(F), np.linalg.svd(F, compute_uv=False)[:, 0]
    bounds = np.array(
        [
            max(
                mode.stiffness
                for mode in member([parameters], d).reference_modes(
                    parameters, StateBound(min(J, 1.0), max(J, 1.0), max(s, 1.0) ** 2)
                )
            )
            for J, s in zip(J, stretch, strict=True)
        ]
    )
    assert bounds[0] == pytest.approx(d * LAMBDA + 2 * MU)
    assert stiffest[0] == pytest.approx(bounds[0], rel=1e-6)
    assert (stiffest <= bounds * (1 + 1e-6)).all()


@pytest.mark.slow
@pytest.mark.parametrize("asked", ["a body that falls on a floor, turning", "two bars that meet"])
def test_threads_change_no_byte(backend_of: Callable, asked: str) -> None:
    """Of the last positions and of the ledger."""
    own = block("body", jelly(), [0.4, 0.2], [0.9, 0.6], velocity_gradient=[[0.0, 2.0], [-2.0, 0.0]])
    scene = body_scene(own, [16, 10], gravity=[0.5, -9.81], end=0.3, frames=3, precision="f32")
    scene = bars(16, 0.25, precision="f32", frames=5) if asked == "two bars that meet" else scene
    one, several = (list(build_run(scene, backend_of("f32", threads)).frames()) for threads in (1, 3))
    assert one[-1][0].position.tobytes() == several[-1][0].position.tobytes()
    assert [row for _, row in one] == [row for _, row in several]


@pytest.mark.parametrize(("changes", "said"), [
    ({"bodies": [("body", jelly()), ("other", jelly())]}, "it must be 0.3 m"),
    ({"bodies": [("body", jelly()), ("other", jelly(law="fixed_corotated"))]},
     "is for bodies of one law; found fixed_corotated and neo_hookean"),
    ({"bodies": [("body", {"law": "fluid", "density": 1e3, "bulk_modulus": 1e4})]}, "follows fluid"),
    ({"deformation": [[1.1, 0.0], [0.0, 1.0]]}, "must be left out with solver.solids"),
    ({"low": 0.05}, "begins 0.05 m from the wall y_min, which does not separate"),
    ({"low": 0.3, "word": "stick"}, '"body" begins 0.3 m away, and would not stick to it later'),
])  # fmt: skip
def test_what_cannot_be_on_that_grid_is_refused(changes: dict, said: str) -> None:
    low = changes.get("low", 0.0)
    bodies = [
        block(
            name,
            material,
            [0.3 + 0.6 * k, low],
            [0.7 + 0.6 * k, low + 0.4],
            **{"deformation": changes["deformation"]} if "deformation" in changes else {},
        )
        for k, (name, material) in enumerate(changes.get("bodies", [("body", jelly())]))
    ]
    with pytest.raises(InputError, match=said):
        scene_of(
            *bodies,
            domain={"size": [2.0, 1.0], "spacing": H, "walls": {"y_min": changes.get("word", "slip")}},
            solver={"solids": "total", "walls": changes.get("walls", "folded")},
        )
