"""The motion of colliders in kernels: where they are in a step, and how fast their points move in it.

A collider stands where it is at the start of a step. Its points have the mean velocity of the step, so that material
that moves with it keeps its place on it exactly. Sums are in double precision.
"""

import math
from collections.abc import Sequence

import numpy as np
import taichi as ti

from mpmcli.boundaries.colliders import Colliders
from mpmcli.scene import Scene
from mpmcli.scene.expression import evaluate

# 2 pi in two parts, as literals have the precision of particles: the first is exact, the second 1e-10.
TURN = (6.28125, 2 * math.pi - 6.28125)


@ti.data_oriented
class ColliderMotion:
    """The colliders of some runs that move.

    Attributes:
        moving: their indices.
        rates: means in the step of the velocity, m/s, and the spin, rad/s: the host sets those that are constant.
    """

    def __init__(self, colliders: Colliders, runs: int) -> None:
        d = colliders.dimension
        self.colliders, self.dimension, self.moving = colliders, d, colliders.kind.moving
        n = runs * len(self.moving)
        self.rates = ti.field(ti.f64, shape=(n, d + 1))
        # Where the pivot is, relative to the lower corner, m, and the angle, rad.
        self.pose = ti.field(ti.f64, shape=(n, d + 1))
        self.axis = ti.Vector.field(3, ti.f64, shape=n)

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the motions of a run, at time 0."""
        for m, k in enumerate(self.moving):
            motion, row = scene.colliders[k].motion, run * len(self.moving) + m
            place = np.array(motion.pivot) + motion.offset - np.array(scene.domain.origin)
            for a, value in enumerate([*place, motion.angle]):
                self.pose[row, a] = value
            self.axis[row] = list(motion.axis)
            self.write_rates(run, m, [float(evaluate(tree, {"t": 0.0})) for tree in motion.rates])

    def write_rates(self, run: int, m: int, rates: Sequence[float]) -> None:
        """Set the rates of the m-th of them in a step, d + 1 numbers."""
        for a, value in enumerate(rates):
            self.rates[run * len(self.moving) + m, a] = value

    @ti.func
    def advance(self, run: int, dt: ti.f64):
        """Begin a step of dt seconds: put colliders where they are, and find where they will be."""
        d = ti.static(self.dimension)
        for m, k in ti.static(enumerate(self.moving)):
            row = run * ti.static(len(self.moving)) + m
            i = run * self.colliders.room + k
            angle, change = self.pose[row, d], dt * self.rates[row, d]
            turned, turning = self.rotation(row, angle), self.rotation(row, change)
            for a in ti.static(range(d)):
                self.colliders.place[i][a] = ti.cast(self.pose[row, a], float)
                self.colliders.velocity[i][a] = ti.cast(self.rates[row, a], float)
                self.pose[row, a] = self.pose[row, a] + dt * self.rates[row, a]
                for b in ti.static(range(d)):
                    own = 1.0 if ti.static(a == b) else 0.0
                    self.colliders.turned[i][a, b] = own + turned[a, b]
                    self.colliders.turning[i][a, b] = turning[a, b] / ti.cast(dt, float)
            self.pose[row, d] = angle + change

    @ti.func
    def rotation(self, row: int, angle: ti.f64):
        """Return R - I, R the rotation by an angle about the axis, d x d; formula of Rodrigues."""
        d = ti.static(self.dimension)
        result = ti.Matrix.zero(float, d, d)
        # Vulkan has sines in single precision only: of a part of a turn they are as good as the result.
        turns = ti.cast(ti.cast(angle * ti.static(0.5 / math.pi), int), ti.f64)
        part = ti.cast((angle - turns * TURN[0]) - turns * TURN[1], float)
        # 1 - cos without cancellation.
        half = ti.sin(0.5 * part)
        s, versine = ti.sin(part), 2.0 * half * half
        if ti.static(d == 2):
            result[0, 0], result[0, 1], result[1, 0], result[1, 1] = -versine, -s, s, -versine
        else:
            axis = ti.cast(self.axis[row], float)
            for a in ti.static(range(3)):
                for b in ti.static(range(3)):
                    result[a, b] = versine * axis[a] * axis[b]
                    if ti.static(a == b):
                        result[a, b] -= versine
                    elif ti.static((a + 1) % 3 == b):
                        result[a, b] -= s * axis[ti.static(3 - a - b)]
                    else:
                        result[a, b] += s * axis[ti.static(3 - a - b)]
        return result

    @ti.kernel
    def step(self, dt: ti.f64):
        """Begin a step of the only run."""
        self.advance(0, dt)
