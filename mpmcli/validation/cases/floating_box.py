"""A rigid box that floats in a tank."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, case_text
from mpmcli.validation.tables import Tables, body, box, fluid, problem

GRAVITY, DENSITY, SHARE = 9.81, 1000.0, 0.5
# Of the box, m; of the tank, in heights of the box; its angle at the start, degrees.
HEIGHT, TANK, TILT = 0.4, (6.0, 4.0), 10.0
END, FRAMES, STILL = 4.0, 80, 60


class FloatingBox(Case):
    """A box twice as wide as it is high, let go from a tilt; it is measured over the last second."""

    text = case_text("floating_box")
    name, title, group = "floating_box", "Rigid box that floats", "fluids"
    levels = {"coarse": (8,), "default": (8, 16), "fine": (8, 16, 32)}  # noqa: RUF012
    varies = ("precision", "per_axis")
    # Nodes meet colliders up to three quarters of a cell outside.
    measures = (
        text.measure("draught error", lambda n: 0.35 / n, expected=1.0),
        text.measure("force error", 0.01, rounding=1e-3),
        text.measure("tilt (degrees)", 3.0),
    )

    def tables(self, n: int) -> Tables:
        (width, depth), angle = TANK, math.radians(TILT)
        turned = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        corners = HEIGHT * (np.array([[-1, -0.5], [1, -0.5], [1, 0.5], [-1, 0.5]]) @ turned.T + [width / 2, depth / 2])
        shape = {"polygon": {"vertices": corners.tolist()}}
        pool = box([0.0, 0.0], [width * HEIGHT, depth / 2 * HEIGHT]) | {"subtract": [shape]}
        domain = {"size": [width * HEIGHT, depth * HEIGHT], "spacing": HEIGHT / n, "gravity": [0.0, -GRAVITY]}
        water = body("water", fluid(DENSITY, 1e5), pool, initial_pressure="hydrostatic")
        raft = {"name": "box", "shape": shape, "density": SHARE * DENSITY}
        return problem(domain, (END, FRAMES), "velocity", [water], colliders=[raft])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        rows = [row for _, row in frames][STILL:]
        pose = np.array([row.rigid_pose[0] for row in rows]).mean(axis=0)
        mass = scene.colliders[0].moments.mass
        # Water, and what the box displaces, below the level.
        level = (rows[0].mass + mass) / DENSITY / scene.domain.size[0]
        force = float(np.mean([row.collider_force[0][1] for row in rows]))
        return {
            "draught error": (level - pose[1]) / HEIGHT + 0.5 - SHARE,
            "force error": force / (mass * GRAVITY) - 1,
            "tilt": math.degrees(pose[2]) + TILT,
        }


CASES = (FloatingBox(),)
