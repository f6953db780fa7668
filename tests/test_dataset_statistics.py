"""Statistics of motion against numpy over whole arrays, written straight from the definitions of LagrangeBench."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_dataset import made_trajectory

from mpmcli.dataset.metadata import Moments, motion_statistics


def plain(trajectories: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Two passes: the mean of means, then the mean of mean squared distances from it."""
    found = {}
    velocities = [np.diff(x.astype(np.float64), axis=0) for x in trajectories]
    for name, sets in {"vel": velocities, "acc": [np.diff(v, axis=0) for v in velocities]}.items():
        mean = np.stack([values.mean((0, 1)) for values in sets]).mean(0)
        std = np.stack([np.square(values - mean).mean((0, 1)) for values in sets]).mean(0) ** 0.5
        found |= {f"{name}_mean": mean, f"{name}_std": np.where(std < 1e-7, 1, std)}
    return found


def agree(found, expected: dict[str, np.ndarray]) -> None:
    """Rounding of sums is relative to the spread of what is summed, and so to the deviation."""
    for name, values in expected.items():
        scale = np.abs(values) + expected[name.replace("mean", "std")]
        assert (np.abs(found[name] - values) <= 1e-9 * scale).all(), name


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("block", [1, 2, 3, 4, 100])
def test_streamed_statistics_are_those_of_whole_arrays(dimension, block):
    sets = [made_trajectory(k, dimension=dimension, particles=10 + 7 * k, frames=11 + k).position for k in range(4)]
    streamed = motion_statistics([x[k : k + block] for k in range(0, len(x), block)] for x in sets)
    agree(streamed, plain(sets))


def test_each_trajectory_counts_the_same(dimension=2):
    """So the mean of one that stays and one that moves by 1 is 1/2, however many particles each has."""
    moves = np.arange(4.0)[:, None, None] * np.ones((1, 1, dimension))
    stays = np.zeros((4, 99, dimension))
    found = motion_statistics([[moves], [stays]])
    assert found["vel_mean"].tolist() == [0.5, 0.5] and found["vel_std"].tolist() == [0.5, 0.5]
    assert found["acc_mean"].tolist() == [0.0, 0.0]


def test_only_particles_that_are_there_count():
    """Of a particle that waits, falls and is gone, and one that stays: displacements 1, 2 and 0 three times."""
    nan = np.nan
    position = np.array([[nan, 5.0], [0.0, 5.0], [1.0, 5.0], [3.0, 5.0], [nan, nan]])[..., None]
    for block in (1, 2, 5):
        found = motion_statistics([[position[k : k + block] for k in range(0, 5, block)]])
        v, a = np.array([1.0, 2.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
        agree(found, {"vel_mean": v.mean(), "vel_std": v.std(), "acc_mean": a.mean(), "acc_std": a.std()})
    with pytest.raises(ValueError, match="three frames"):
        motion_statistics([[position[:3, :1]]])


def test_a_deviation_of_zero_becomes_one():
    found = motion_statistics([[np.zeros((5, 3, 2))]])
    assert found["vel_std"].tolist() == found["acc_std"].tolist() == [1.0, 1.0]


def test_two_frames_are_too_few():
    with pytest.raises(ValueError, match="three frames"):
        motion_statistics([[np.zeros((2, 3, 2))]])
    with pytest.raises(ValueError, match="need a trajectory"):
        motion_statistics([])


numbers = st.floats(-1e3, 1e3, allow_subnormal=False)


@given(st.lists(st.lists(numbers, min_size=1, max_size=20), min_size=1, max_size=6), st.floats(-1e4, 1e4))
def test_merged_moments_are_those_of_all_values(parts, offset):
    """An offset far above the spread is where naive sums of squares fail."""
    parts = [np.array(part)[:, None] + offset for part in parts]
    merged = Moments.of(parts[0])
    for part in parts[1:]:
        merged = merged.merged(Moments.of(part))
    whole = np.concatenate(parts)
    # A rounding for each value, of numbers as large as the largest.
    rounding = np.finfo(float).eps * len(whole) * (np.abs(whole).max() + 1)
    assert merged.count == len(whole)
    assert abs(merged.mean[0] - whole.mean()) <= 4 * rounding
    spread = np.ptp(whole) + rounding
    assert abs(merged.variance[0] - whole.var()) <= 8 * rounding * spread
