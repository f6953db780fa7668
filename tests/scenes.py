"""Set-ups that tests of whole runs share: scenes in few words, starts of their own, and runs."""

import math
from collections.abc import Sequence

import numpy as np
from solver_state import scene_of

from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.engine.run import Run
from mpmcli.solver.frames.builder import FilledCells

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


def restart(run: Run, samples: Sequence[BodyParticles], end: float) -> None:
    """Begin a run of a scene with one body of each law again, with other particles, as many: kernels stay compiled."""
    for group in run.groups:
        (body,) = group.bodies
        sample, n = samples[body], group.count
        group.replace(
            x=sample.position - run.scene.domain.origin,
            v=sample.velocity,
            C=sample.affine,
            deformation=np.ones(n) if group.law.deformation == "J" else np.tile(np.eye(group.dimension), (n, 1, 1)),
            internal=np.tile([variable.at_rest for variable in group.law.internal], (n, 1)),
            id=np.arange(n) + sum(s.count for s in samples[:body]),
        )
    run.scene = run.scene.model_copy(update={"time": run.scene.time.model_copy(update={"end": end})})
    run.restart()


def volume_errors(
    x: np.ndarray, volume: np.ndarray, flows: np.ndarray, spacing: float, cells: Sequence[int], periodic: Sequence[bool]
) -> np.ndarray:
    """Return the volume errors of (T, n, d) places, the particles added in two parts, which change no bit."""
    halves, whole = (FilledCells(x, spacing, cells, periodic) for _ in range(2))
    for rows in (slice(0, len(flows) // 3), slice(len(flows) // 3, None)):
        halves.add(x[:, rows], volume[:, rows], flows[rows])
    whole.add(x, volume, flows)
    assert np.array_equal(halves.errors(), whole.errors())
    return whole.errors()
