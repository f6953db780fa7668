"""Runs one scene with both laws, every kind of wall and many sorts, and stores what happened; its own process.

`python path_run.py ARCH THREADS DIMENSION PRECISION FILE` writes an .npz: the state before and after each of the
first steps with the nodes in between, the state after WATCHED steps, after LONG steps and at the last frame. All
arrays are in the order of the particles' ids. Exit status 77: this machine has no such backend.
"""

import sys
from dataclasses import replace

import numpy as np
import scenes
from scenes import body, box, liquid, solid

from mpmcli.errors import InputError
from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.frames.diagnosis import read_group
from mpmcli.solver.machine.backend import Backend, start_backend

NO_DEVICE = 77
STEP = 0.006
RECORDED, WATCHED, LONG = 6, 60, 300
CELLS = {2: (20, 13), 3: (11, 10, 9)}
SPACING = 0.1
FACES = {"x_min": "slip", "x_max": "stick", "y_min": "separate", "y_max": "slip"}
FACES_3D = {**FACES, "z_min": "stick", "z_max": "separate"}


def scene_of(dimension: int, precision: str) -> Scene:
    """Return a scene whose three bodies fly apart at several cells per sort and meet every face."""
    d = dimension
    size = [n * SPACING for n in CELLS[d]]
    origin = [-0.35, 0.2, 0.1][:d]

    def inside(low: tuple[float, ...], high: tuple[float, ...]) -> dict:
        return box(*([o + s * f for o, s, f in zip(origin, size, end, strict=False)] for end in (low, high)))

    # What is remembered of openings has a test of its own (test_volume.py).
    fluid, per_cell = liquid(8000.0, volume_correction=False), 4 if d == 2 else 3
    # With suction, so that both kinds are stepped.
    oil = fluid | {"density": 500.0, "bulk_modulus": 5000.0, "tension_cutoff": False}
    places = (
        ("jelly", solid(6e3, density=800.0, poissons_ratio=0.3), (0.0, 0.0, 0.0), (0.3, 0.45, 0.5), [1.0, -2.0, 1.5]),
        ("water", fluid, (0.65, 0.5, 0.5), (1.0, 1.0, 1.0), [3.0, 1.0, 1.0]),
        ("oil", oil, (0.65, 0.1, 0.1), (0.9, 0.4, 0.45), [-3.0, 2.0, -2.0]),
    )
    more = {"sampling": "jittered", "particles_per_cell": per_cell}
    return scenes.scene_of(
        *(body(name, law, inside(low, high), velocity=v[:d], **more) for name, law, low, high, v in places),
        domain={"size": size, "origin": origin, "spacing": SPACING, "gravity": [0.4, -9.81, 1.0][:d]},
        walls=FACES if d == 2 else FACES_3D,
        end=2.4,
        precision=precision,
        fields=["velocity", "volume_ratio", "affine", "deformation_gradient"],
    )


def stirred(scene: Scene) -> list[BodyParticles]:
    """Return the particles of the scene with random velocities and affine velocities added."""
    random = np.random.default_rng(7)
    return [
        replace(
            body,
            velocity=body.velocity + random.normal(0, 0.5, body.velocity.shape),
            affine=random.normal(0, 1.0, body.affine.shape),
        )
        for body in sample_bodies(scene)
    ]


def deform(run: Run) -> None:
    """Give every particle a random deformation, the same for every backend."""
    random = np.random.default_rng(11)
    for group in run.groups:
        rest = group.read()["deformation"]
        spread = 0.03 * random.standard_normal(rest.shape)
        group.replace(deformation=rest + spread)
    # The reference neither shifts nor relaxes.
    run.state.unrelaxed_steps = 0


def state(run: Run) -> dict[str, np.ndarray]:
    """Return x, v, C and deformation of each group, by id, as <law>_<name>."""
    found = {}
    for law, group in zip(run.laws, run.groups, strict=True):
        snapshot = read_group(group)
        order = np.argsort(snapshot.id)
        for name in ("x", "v", "C", "deformation"):
            found[f"{law}_{name}"] = getattr(snapshot, name)[order]
    return found


def nodes_of(run: Run) -> np.ndarray:
    """Return the nodes, (..., d + 1): velocity, or momentum after P2G, and mass; any padding is left out."""
    nodes = run.grid.nodes.to_numpy()[:, : run.grid.dimension + 1]
    return nodes.reshape(*run.grid.shape, -1)


def prepare(backend: Backend, dimension: int) -> Run:
    """Return a run of the scene with its random state."""
    scene = scene_of(dimension, backend.precision)
    run = build_run(scene, backend, stirred(scene))
    deform(run)
    return run


def record(backend: Backend, dimension: int) -> dict[str, np.ndarray]:
    """Return the state before and after each of the first steps, and the nodes in between."""
    return record_steps(prepare(backend, dimension))


def record_steps(run: Run) -> dict[str, np.ndarray]:
    """Take the first steps of a run; see `record`."""
    arrays = {f"0_{name}": value for name, value in state(run).items()}
    for k in range(RECORDED):
        run.step(STEP)
        arrays[f"{k}_nodes"] = nodes_of(run)
        for law, group in zip(run.laws, run.groups, strict=True):
            arrays[f"{k}_{law}_kept"] = group.arrays.kept.to_numpy()[group.row :][: len(group.bodies)]
        arrays |= {f"{k + 1}_{name}": value for name, value in state(run).items()}
    return arrays


def order_of(run: Run) -> bytes:
    """Return the order of the particles in memory: it changes when a sort moves one."""
    return b"".join(group.read()["id"].tobytes() for group in run.groups)


def run(backend: Backend, dimension: int) -> dict[str, np.ndarray]:
    """Run the scene on a backend and return every array that it left."""
    run = prepare(backend, dimension)
    arrays = record_steps(run)
    sorts, order = 0, order_of(run)
    for k in range(RECORDED, LONG):
        run.step(STEP)
        sorts, order = sorts + (order_of(run) != order), order_of(run)
        if k + 1 == WATCHED:
            arrays |= {f"watched_{name}": value for name, value in state(run).items()}
    arrays |= {f"long_{name}": value for name, value in state(run).items()}
    arrays["sorts"] = np.array(sorts)
    for frame, row in run.frames():
        arrays |= {"frame_position": frame.position, "frame_velocity": frame.velocity, **frame.fields}
        arrays["ledger"] = np.array([row.steps, row.step_min, row.step_max, row.speed_max, row.kinetic])
    return arrays


if __name__ == "__main__":
    arch, threads, dimension, precision, path = sys.argv[1:]
    try:
        backend = start_backend(arch, int(threads), precision)
    except InputError as error:
        print(error)
        sys.exit(NO_DEVICE)
    np.savez(path, **run(backend, int(dimension)))
