"""The B-splines: partition of unity, linear reproduction, and the moment that APIC divides by."""

from collections.abc import Callable

import numpy as np
import pytest
import taichi as ti

from mpmcli.solver.transfer.splines import PAD, SPLINES

CELLS = 40
SPACING = 0.025
# Round-off of one axis in units of the domain, which is CELLS cells wide.
TOLERANCE = {"f32": 1e-6, "f64": 1e-14}


def evaluate(name: str, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first node (n, d) and the weights (n, nodes, d) of points (n, d), from the device."""
    n, d = points.shape
    spline = SPLINES[name]
    x = ti.Vector.field(d, float, shape=n)
    base = ti.Vector.field(d, int, shape=n)
    weight = ti.Matrix.field(spline.nodes, d, float, shape=n)
    x.from_numpy(points)

    @ti.kernel
    def run():
        for p in range(n):
            first, distance = spline.stencil(x[p], 1 / SPACING)
            w = spline.weights(distance)
            base[p] = first
            for k in ti.static(range(spline.nodes)):
                for a in ti.static(range(d)):
                    weight[p][k, a] = w[k, a]

    run()
    return base.to_numpy(), weight.to_numpy().astype(np.float64)


@pytest.mark.parametrize("precision", ["f64", "f32"])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("name", "inverse_moment"), [("quadratic", 4), ("cubic", 3)])
def test_weights_reproduce_constants_lines_and_the_apic_moment(
    backend_of: Callable, name: str, inverse_moment: int, precision: str, dimension: int
) -> None:
    """sum w = 1, sum w x_i = x, sum w (x_i - x)^2 = h^2/4 or h^2/3, w >= 0, at random points and at special ones."""
    backend_of(precision)
    real = np.float64 if precision == "f64" else np.float32
    special = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.5, CELLS - 0.5, CELLS - 1e-6, CELLS]) * SPACING
    random = np.random.default_rng(1).uniform(0, CELLS * SPACING, (2000, dimension))
    points = np.concatenate([np.tile(special[:, None], (1, dimension)), random]).astype(real)
    base, w = evaluate(name, points)
    nodes = w.shape[1]
    place = (base[:, None, :] + np.arange(nodes)[None, :, None] - PAD) * SPACING
    x = points.astype(np.float64)
    size = CELLS * SPACING
    tolerance = TOLERANCE[precision]
    assert np.abs(w.sum(1) - 1).max() < tolerance
    assert w.min() > -tolerance
    assert np.abs((w * place).sum(1) - x).max() < tolerance * size
    moment = (w * (place - x[:, None, :]) ** 2).sum(1)
    assert np.abs(moment - SPACING**2 / inverse_moment).max() < tolerance * size * SPACING
    # The stencil of a point on a wall stays inside the grid, and what it hands beyond goes to the first node there: a
    # cubic stencil has one more, of no weight.
    assert base.min() >= PAD - 1
    assert base.max() + nodes - 1 <= CELLS + PAD + nodes - 2
    beyond = (place < -1.5 * SPACING) | (place > (CELLS + 1.5) * SPACING)
    assert np.abs(w[beyond]).max(initial=0.0) < tolerance
