"""Signed distances in kernels that are read from a grid: of meshes, and of unions and differences of forms."""

from functools import lru_cache

import numpy as np
import taichi as ti

from mpmcli.scene.distance_grid import distance_grid
from mpmcli.scene.shapes import Form

# Nodes of such a grid per cell of the scene, cells that it reaches beyond the form, and the nodes above which it has
# one per cell.
FINE, MARGIN, MANY = 2, 2, 8_000_000


@lru_cache(maxsize=8)
def samples_of(form: Form, h: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the signed distances from a form for a scene with cells of h metres, see `distance_grid`."""
    lower, upper = form.bounds()
    cells = float(np.prod((upper - lower) / h + 2 * MARGIN))
    fine = FINE if cells * FINE ** len(lower) <= MANY else 1
    return distance_grid(form, h / fine, MARGIN * h)


@ti.data_oriented
class GridDistance:
    """A form by its distances at the nodes of a grid: first node, spacing, nodes per axis; multilinear between them.

    Beyond the grid the distance to it is added.
    """

    def __init__(self, dimension: int, samples: ti.Field) -> None:
        """Read distances from the samples of all such forms."""
        self.dimension, self.samples = dimension, samples

    @staticmethod
    def numbers(form: Form, pivot: np.ndarray, h: float) -> list[float]:
        """Return what a kernel needs beside the samples."""
        values, origin, spacing = samples_of(form, h)
        return [*(origin - pivot), spacing, *map(float, values.shape)]

    @ti.func
    def at(self, numbers: ti.template(), first: int, sample: int, y: ti.template()):
        """Return the signed distance of y from the form, and the normal; its samples begin at `sample`."""
        d = ti.static(self.dimension)
        spacing = numbers[first + d]
        base = ti.Vector.zero(int, d)
        share = ti.Vector.zero(float, d)
        beyond = 0.0
        for a in ti.static(range(d)):
            last = numbers[first + d + 1 + a] - 1.0
            u = (y[a] - numbers[first + a]) / spacing
            clamped = ti.min(ti.max(u, 0.0), last)
            beyond += (u - clamped) ** 2
            base[a] = ti.cast(ti.min(ti.floor(clamped), last - 1.0), int)
            share[a] = clamped - ti.cast(base[a], float)
        phi = 0.0
        slope = ti.Vector.zero(float, d)
        for corner in range(ti.static(2**d)):
            index = 0
            weight = 1.0
            for a in ti.static(range(d)):
                up = corner >> a & 1
                index = index * ti.cast(numbers[first + d + 1 + a], int) + base[a] + up
                weight *= share[a] if up == 1 else 1.0 - share[a]
            value = self.samples[sample + index]
            phi += weight * value
            for a in ti.static(range(d)):
                part = value if corner >> a & 1 == 1 else -value
                for b in ti.static(range(d)):
                    if ti.static(b != a):
                        part *= share[b] if corner >> b & 1 == 1 else 1.0 - share[b]
                slope[a] += part
        size = slope.norm()
        normal = slope * 0.0
        normal[0] = 1.0
        if size > 0:
            normal = slope / size
        return phi + spacing * ti.sqrt(beyond), normal
