"""Expressions in kernels are those of numpy: every operator and function, in both precisions."""

import sys

import numpy as np
import pytest
import taichi as ti
from test_expression import FUNCTION_CASES

from mpmcli.scene.expression import FUNCTIONS, OPERATORS, derivative, evaluate
from mpmcli.scene.expression_reader import parse
from mpmcli.solver.drive.expressions import KERNELS, DeviceValues, Entries, RunValues, node_of
from mpmcli.solver.engine.batch import RECURSION

NAMES = ("t", "x", "y", "X", "Y")
MORE = {
    "time": "sin(2 * pi * t) * x + (y if t > 0.5 else -y)",
    "initial": "2 * (x - X) + Y**2",
    "whole powers": "x**7 + (y - 5)**3 + x**0 + (2 + x)**-4",
    "power of a negative": "(x - 4)**(2 + 0 * y)",
    "deep": "sin(" * 50 + "x" + ")" * 50,
}
ORIGIN = np.array([0.25, -0.5])
TIME = 0.6


def evaluated(real):
    """Return values of all cases by kernel, (n, k), and by numpy, (n, k), at the same points, and their names."""
    sys.setrecursionlimit(RECURSION)
    texts = [*FUNCTION_CASES.values(), *MORE.values()]
    rng = np.random.default_rng(2)
    n = 300
    points = rng.uniform(-1.4, 1.4, (2, n, 2)).astype(real)
    points[1, :50] = points[0, :50]
    fields = [ti.Vector.field(2, float, shape=n) for _ in points]
    for field, values in zip(fields, points, strict=True):
        field.from_numpy(values)
    entries = Entries(ORIGIN)
    slope = derivative(parse(MORE["deep"], NAMES).tree, "x")
    trees = [*(parse(text, NAMES).tree for text in texts), slope]
    formulas = [entries.placed(tree) for tree in trees]
    # Each node of a derivative is in a kernel once; by paths there are 2^50.
    assert len(formulas[-1].steps) < 10 * 50
    values = DeviceValues(1, len(entries.found))
    nodes = tuple(enumerate(node_of(formula, values) for formula in formulas))
    numbers = RunValues(values, 0, entries.found, 0.1, 1.0)
    found = ti.field(float, shape=(n, len(trees)))

    @ti.kernel
    def run(some: ti.template()):
        for p in range(n):
            for k, node in ti.static(some):
                found[p, k] = node.evaluate(fields[0][p], fields[1][p], 0)

    numbers.write(TIME, TIME)
    # Taichi warns of kernels with more than 32 copies of a loop.
    for first in range(0, len(nodes), 30):
        run(nodes[first : first + 30])
    places = points.astype(np.float64) + ORIGIN
    at = {"t": TIME, "x": places[0, :, 0], "y": places[0, :, 1], "X": places[1, :, 0], "Y": places[1, :, 1]}
    expected = np.stack([np.broadcast_to(evaluate(tree, at), n) for tree in trees], axis=1)
    return found.to_numpy().astype(np.float64), expected, [*FUNCTION_CASES, *MORE, "slope"]


def test_every_function_has_a_kernel():
    assert set(KERNELS) - {"blend"} == set(FUNCTIONS) | set(OPERATORS)


@pytest.mark.parametrize(("precision", "tolerance"), [("f64", 1e-13), ("f32", 1e-6)])
def test_kernels_agree_with_numpy(backend_of, precision, tolerance):
    """To rounding, relative to 1 + |value|, and more where a large value has amplified it (powers, tan).

    Values beside a jump (floor, comparisons) may fall to either side in f32; no more than one in a hundred does.
    """
    real = np.float64 if precision == "f64" else np.float32
    backend_of(precision)
    found, expected, names = evaluated(real)
    for k, name in enumerate(names):
        both = np.isnan(expected[:, k]) & np.isnan(found[:, k])
        error = np.where(both, 0.0, np.abs(found[:, k] - expected[:, k]) / (1 + np.abs(expected[:, k])))
        within = error <= tolerance * np.maximum(1.0, np.abs(expected[:, k]))
        assert within.mean() >= (1.0 if precision == "f64" else 0.99), (name, error.max())
