"""Set-ups that tests of whole runs share: scenes in few words, starts of their own, and runs."""

import math
from collections.abc import Sequence

import numpy as np
from solver_state import scene_of

from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.frame_arrays import FrameArrays, RunConstants
from mpmcli.solver.solver import Solver
from mpmcli.solver.sums import ledger_sums
from mpmcli.solver.volume_error import FilledCells

GRAVITY = 9.81


def block(name: str, material: dict, low: Sequence[float], high: Sequence[float], **more: object) -> dict:
    """Return the table of a body that is a box."""
    box = {"min": [float(x) for x in low], "max": [float(x) for x in high]}
    return {"name": name, "material": material, "shape": {"box": box}, **more}


def scene(
    cells: Sequence[int],
    spacing: float,
    bodies: Sequence[dict],
    end: float,
    *,
    frames: int = 1,
    gravity: Sequence[float] = (),
    walls: object = "separate",
    friction: object = 0.0,
    precision: str = "f32",
    fields: Sequence[str] = ("velocity",),
) -> Scene:
    """Return a scene with a number of cells."""
    domain = {"size": [n * spacing for n in cells], "spacing": spacing, "walls": walls, "friction": friction}
    if len(gravity) > 0:
        domain["gravity"] = [float(g) for g in gravity]
    return scene_of(
        domain=domain,
        time={"end": float(end), "frames": frames},
        output={"fields": list(fields)},
        solver={"precision": precision},
        bodies=list(bodies),
    )


def tilted(degrees: float) -> list[float]:
    """Return gravity in the axes of a slope: x down the slope, y away from it."""
    theta = math.radians(degrees)
    return [GRAVITY * math.sin(theta), -GRAVITY * math.cos(theta)]


def row_means(values: np.ndarray, rows: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the mean of the chosen values in each row of particles; rows (n,) are their heights at the start."""
    keys = np.round(rows, 9)
    return np.array([values[chosen & (keys == key)].mean(0) for key in np.unique(keys)])


def stresses(fields: dict[str, np.ndarray]) -> np.ndarray:
    """Return the Cauchy stress of a frame as matrices, (n, 3, 3), Pa."""
    return fields["stress"].reshape(-1, 3, 3)


def restart(solver: Solver, samples: Sequence[BodyParticles], end: float) -> None:
    """Begin a run of a scene with one body of each law again, with other particles, as many: kernels stay compiled."""
    for group in solver.groups:
        (body,) = group.bodies
        sample, d = samples[body], group.dimension
        group.x.from_numpy((sample.position - solver.scene.domain.origin).astype(group.real))
        group.set_motion(sample.velocity, sample.affine)
        group.set_deformation(
            np.ones(group.count) if group.law.deformation == "J" else np.tile(np.eye(d), (group.count, 1, 1))
        )
        for variable, values in zip(group.law.internal, group.internal, strict=True):
            values.fill(variable.at_rest)
        group.id.from_numpy(np.arange(group.count, dtype=np.int32) + sum(s.count for s in samples[:body]))
    solver.scene = solver.scene.model_copy(update={"time": solver.scene.time.model_copy(update={"end": end})})
    solver.restart()


def sums(solver: Solver) -> dict:
    """Return what the ledger sums at this moment, in float64."""
    columns = solver._builder.columns
    arrays = FrameArrays(columns, np.empty((1, solver.particle_count, columns.count), solver.groups[0].real))
    # As on a GPU: in numpy.
    found = solver._observe(arrays)
    everything = slice(0, solver.particle_count)
    constants = RunConstants(solver.groups, [len(b.position) for b in solver._particles]).of_rows(everything)
    gravity, dt = np.array([solver.scene.domain.gravity]), np.array([solver.last_step])
    ratios = constants.volume_ratios(arrays)
    result = ledger_sums(found, gravity, solver.spacing, dt)
    result |= {"volume_ratio_min": ratios.min(axis=1), "volume_ratio_max": ratios.max(axis=1)}
    return {name: values[0] for name, values in result.items()}


def total_energy(solver: Solver) -> float:
    """Return the total energy as the ledger gives it, J."""
    found = sums(solver)
    return found["kinetic"] + found["elastic"] + found["potential"]


def volume_errors(
    x: np.ndarray,
    volume: np.ndarray,
    flows: np.ndarray,
    spacing: float,
    cells: Sequence[int],
    periodic: Sequence[bool],
) -> np.ndarray:
    """Return the volume errors of (T, n, d) places, the particles added in two parts, which change no bit."""
    halves, whole = (FilledCells(x, spacing, cells, periodic) for _ in range(2))
    for rows in (slice(0, len(flows) // 3), slice(len(flows) // 3, None)):
        halves.add(x[:, rows], volume[:, rows], flows[rows])
    whole.add(x, volume, flows)
    assert np.array_equal(halves.errors(), whole.errors())
    return whole.errors()
