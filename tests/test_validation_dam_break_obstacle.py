"""The heights that were measured in the dam break on an obstacle, and those that are made of particles."""

import math

import numpy as np
import pytest

from mpmcli.validation.cases.dam_break import (
    DAM,
    DEPTH,
    FACE,
    GRAVITY,
    IMPACT,
    MIDDLE,
    WET,
    arrival,
    impact,
    measured_gauges,
    water_height,
)


def test_the_data_are_four_gauges_of_one_flow() -> None:
    """They stand in a row, and get wet from the column on, no sooner than by the fastest front there is."""
    gauges = measured_gauges()
    assert list(gauges) == ["H1", "H2", "H3", "H4"]
    assert [gauge.x for gauge in gauges.values()] == [0.496, 0.992, 1.488, 2.638]
    for gauge in gauges.values():
        assert len(gauge.time) == len(gauge.height) == 22
        dry = gauge.time < gauge.arrival
        assert (gauge.height[dry] <= 1.5e-3).all() and (gauge.height[~dry] > WET).all()
    assert (np.diff(gauges["H4"].height) < 0).all() and gauges["H4"].height[0] < DEPTH
    # A dry dam break runs at 2 sqrt(g h) at most (Ritter 1892).
    for name in ("H3", "H2"):
        assert DAM - gauges[name].x < 2 * math.sqrt(GRAVITY * DEPTH) * gauges[name].arrival
    assert gauges["H2"].arrival < IMPACT < 0.45


@pytest.mark.parametrize("per_cell", [2, 4])
def test_a_level_pool_has_its_depth(per_cell: int) -> None:
    """A hat function over a lattice is 1 on average wherever it stands, its reach a whole number of edges."""
    edge = 0.1 / per_cell
    axis = edge * (np.arange(8 * per_cell) + 0.5)
    position = np.stack(np.meshgrid(axis, axis + MIDDLE - 0.4, axis[: 2 * per_cell]), axis=-1).reshape(-1, 3)
    for x in (0.4, 0.41, 0.4321):
        assert water_height(position, x, edge**3, 0.1) == pytest.approx(0.2, rel=1e-12)


def test_a_lone_drop_adds_what_it_holds() -> None:
    """However high it is, and not more than its volume over the area of the column; beyond the reach nothing."""
    for z in (0.1, 0.9):
        drop = np.array([[1.0, MIDDLE, z]])
        assert water_height(drop, 1.0, 1e-6, 0.1) == pytest.approx(1e-4, rel=1e-12)
        assert water_height(drop, 1.05, 1e-6, 0.1) == pytest.approx(5e-5, rel=1e-12)
        assert water_height(drop, 1.1, 1e-6, 0.1) == pytest.approx(0.0, abs=1e-18)


def test_the_arrival_is_where_a_curve_crosses() -> None:
    time = np.linspace(0, 1, 11)
    assert arrival(time, 0.1 * (time - 0.25)) == pytest.approx(0.35, rel=1e-12)
    assert arrival(time, 0.1 + time) == 0.0
    assert math.isnan(arrival(time, 0 * time))


def test_the_front_meets_the_box_on_its_way() -> None:
    time = np.linspace(0, 1, 11)
    assert impact(time, 2.0 - 3 * time) == pytest.approx((2.0 - FACE) / 3, rel=1e-12)


def test_the_error_is_a_share_of_the_mean_height() -> None:
    for gauge in measured_gauges().values():
        assert gauge.mean_error(gauge.time, gauge.height, 1.1) == 0.0
        assert gauge.mean_error(gauge.time, 1.1 * gauge.height, 1.1) == pytest.approx(0.1, rel=1e-12)
        assert gauge.mean_error(gauge.time, gauge.height, gauge.arrival + 0.1) == 0.0
