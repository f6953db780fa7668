"""The means that the kernels of a batch take from tables are those of `Mean`, which the host takes."""

from collections.abc import Callable

import numpy as np
import pytest
import taichi as ti
from scipy.integrate import quad

from mpmcli.scene.expression import Tree, evaluate
from mpmcli.scene.expression_reader import parse
from mpmcli.scene.quadrature import BOUND, HALF, MIDDLE, Mean
from mpmcli.solver.drive.expressions import ROOM, TimeTables, subsampled

END, PAUSE = 2.0, 0.02
# The last one has more parts in a window than a table has rows for it where all windows must find room.
TREES = {
    text: parse(text, ("t",)).tree
    for text in ("3 * t**2 - 1", "sin(40 * t)", "1e4 if 0.7 < t < 0.70002 else t", "sin(40000 * t)")
}
LAST = TREES["sin(40000 * t)"]


def means_of(tables: TimeTables, intervals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the means and the bounds that a kernel finds for each table, (tables, n)."""
    count = len(TREES)
    found, bounds = np.zeros((count, len(intervals))), np.zeros((count, len(intervals)))

    @ti.kernel
    def run(ends: ti.types.ndarray(ti.f64, 2), found: ti.types.ndarray(ti.f64, 2), bounds: ti.types.ndarray(ti.f64, 2)):
        for k, i in found:
            found[k, i] = tables.mean(count + k, ends[i, 0], ends[i, 1])
            bounds[k, i] = tables.largest(count + k, ends[i, 0], ends[i, 1])

    run(intervals, found, bounds)
    return found, bounds


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_a_kernel_takes_the_means_of_the_host(backend_of: Callable, precision: str) -> None:
    backend_of(precision)
    tables = TimeTables(2, len(TREES))
    means = [Mean(tree, PAUSE, END) for tree in TREES.values()]
    for since in (0.0, 0.69, 1.9):
        horizon = tables.fill(1, means, since, coarse=False)
        assert since < horizon < since + END
        rng = np.random.default_rng(3)
        starts = since + (horizon - since) * np.sort(rng.random((50, 2)), axis=1)
        found, bounds = means_of(tables, starts)
        for k, (tree, mean) in enumerate(zip(TREES.values(), means, strict=True)):
            expected = [mean(*interval) for interval in starts]
            inside = np.linspace(starts[:, 0], starts[:, 1], 101)
            values = np.abs(evaluate(tree, {"t": inside}))
            assert np.abs(found[k] - expected).max() <= 1e-12 * max(1.0, np.abs(expected).max())
            assert (bounds[k] >= values.max(axis=0) * (1 - 1e-12)).all()


def test_all_windows_find_room(backend_of: Callable) -> None:
    """For a kick that takes a large part of a run: the mean over all of it is the integral."""
    backend_of("f64")
    tables = TimeTables(2, len(TREES))
    horizon = tables.fill(1, [Mean(tree, PAUSE, END) for tree in TREES.values()], 0.0, coarse=True)
    assert horizon >= END and (tables.used.to_numpy()[len(TREES) :] <= ROOM).all()
    (found, _) = means_of(tables, np.array([[0.0, END]]))
    for k, tree in enumerate(TREES.values()):

        def value(t: float, tree: Tree = tree) -> float:
            return float(evaluate(tree, {"t": t}))

        exact = quad(value, 0.0, END, points=[0.7, 0.70002], limit=200)[0] / END if tree != LAST else 0.0
        assert found[k, 0] == pytest.approx(exact, rel=1e-8, abs=1e-4)


def test_joined_rows_keep_the_integral() -> None:
    """Rows that are joined hold the integral at their ends, and the largest bound of what they join."""
    rows = Mean(LAST, PAUSE, END).rows(3)
    few = subsampled(rows, 16)
    assert len(rows) > 100 and len(few) <= 16
    assert subsampled(rows, len(rows)) is rows
    for row in few:
        own = (rows[:, MIDDLE] > row[MIDDLE] - row[HALF]) & (rows[:, MIDDLE] < row[MIDDLE] + row[HALF])
        last = rows[own][-1]
        assert row[-2:].sum() == pytest.approx(last[4:].sum(), abs=1e-15)
        assert row[BOUND] == rows[own][:, BOUND].max()
