"""A block thrown along a rough floor comes to rest, and one on an incline slides or stays: Coulomb's law."""

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Measure, case_text
from mpmcli.validation.tables import Tables, body, box, elastic, problem

LENGTH, HEIGHT = 1.0, 0.25
# With nu = 0 the weight makes one-dimensional compression, in which the block begins.
DENSITY, YOUNG, POISSON = 1000.0, 1e6, 0.0
GRAVITY, FRICTION, SPEED = 9.81, 0.3, 2.0
DECELERATION = FRICTION * GRAVITY
STOP = SPEED / DECELERATION
END, FRAMES = 2.5 * STOP, 250


class SlidingBlock(Case):
    """v = v0 - mu g t along the floor, and rest after v0^2 / (2 mu g)."""

    text = case_text("sliding_block")
    name, title, group = "sliding_block", "Block that slides along a rough floor and stops", "solids"
    levels = {"coarse": (4,), "default": (4, 8), "fine": (4, 8, 16)}  # noqa: RUF012
    varies = ("precision", "kernel", "transfer")
    measures = (
        Measure("distance error: How far it slides, relative to v0^2 / (2 mu g).", 7e-3),
        Measure("deceleration error: While it slides, relative to mu g.", 7e-3),
        Measure("drift (L/s): Speed of what has come to rest, in lengths per second.", 8e-5),
    )

    def tables(self, n: int) -> Tables:
        block = body(
            "block",
            elastic("neo_hookean", DENSITY, YOUNG, POISSON),
            box([2 * HEIGHT, 0.0], [2 * HEIGHT + LENGTH, HEIGHT]),
            velocity=[SPEED, 0.0],
            deformation=[[1.0, 0.0], [0.0, f"1 - {DENSITY * GRAVITY / YOUNG} * ({HEIGHT} - Y)"]],
        )
        domain = {"size": [16 * HEIGHT, 2 * HEIGHT], "spacing": HEIGHT / n, "gravity": [0.0, -GRAVITY]}
        walls = {"walls": "separate", "friction": {"y_min": FRICTION}}
        return problem(domain | walls, (END, FRAMES), "velocity", [block])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        path = np.array([(frame.time, frame.position[:, 0].mean(dtype=np.float64)) for frame, _ in frames]).T
        time, place = path
        sliding, resting = (time > 0.1 * STOP) & (time < 0.9 * STOP), time > 1.1 * STOP
        slowing = -2 * np.polyfit(time[sliding], place[sliding], 2)[0]
        return {
            "distance error": abs(float(place[resting].mean() - place[0]) / (SPEED**2 / (2 * DECELERATION)) - 1),
            "deceleration error": abs(float(slowing) / DECELERATION - 1),
            "drift": abs(float(np.polyfit(time[resting], place[resting], 1)[0])) / LENGTH,
        }


CASES = (SlidingBlock(),)
