"""Statistics of motion that learners normalise with, streamed: displacements of frames, and their differences."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

# Standard deviations below it become 1, as in LagrangeBench (data_gen/lagrangebench_data/gen_dataset.py): a
# direction in which nothing moves is not to be divided by.
STD_LEAST = 1e-7


@dataclass(frozen=True, eq=False)
class Moments:
    """Count, mean and sum of squared deviations of vectors, (d,) float64 each.

    Two of them merge without loss (Chan, Golub and LeVeque, "Updating formulae and a pairwise algorithm for
    computing sample variances", 1979); those of single vectors would be Welford's.
    """

    count: int
    mean: np.ndarray
    square: np.ndarray

    @classmethod
    def of(cls, vectors: np.ndarray) -> "Moments":
        """Return the moments of (..., d) vectors, of which there is at least one."""
        rows = vectors.reshape(-1, vectors.shape[-1]).astype(np.float64)
        mean = rows.mean(axis=0)
        return cls(len(rows), mean, np.square(rows - mean).sum(axis=0))

    def merged(self, other: "Moments") -> "Moments":
        """Return the moments of the vectors of both."""
        count, apart = self.count + other.count, other.mean - self.mean
        mean = self.mean + apart * (other.count / count)
        return Moments(count, mean, self.square + other.square + apart**2 * (self.count * other.count / count))

    @property
    def variance(self) -> np.ndarray:
        """(d,), of the population."""
        return self.square / self.count


@dataclass(frozen=True, eq=False)
class MotionStatistics:
    """Of v = x[t+1] - x[t], m, and a = v[t+1] - v[t], m: not divided by the time between frames; (d,) float64 each.

    The mean is that of the means of the trajectories, the deviation the root of the mean over trajectories of the
    mean squared distance from it, so that each trajectory counts the same; a deviation below 1e-7 is given as 1.
    """

    vel_mean: np.ndarray
    vel_std: np.ndarray
    acc_mean: np.ndarray
    acc_std: np.ndarray

    def as_dict(self) -> dict[str, list[float]]:
        """Return lists of numbers, for JSON."""
        return {name: values.tolist() for name, values in asdict(self).items()}


def motion_statistics(
    trajectories: Iterable[Iterable[np.ndarray]], periods: Sequence[np.ndarray] | None = None
) -> MotionStatistics:
    """Compute the statistics of trajectories, each of which is read once.

    Args:
        trajectories: each as consecutive blocks of positions, (t, N, d), m, with three frames or more in all.
        periods: of each trajectory and axis, after what way, m, the domain repeats, infinite where it does not.

    Raises:
        ValueError: there is no trajectory, or one has fewer than three frames.
    """
    moments = [_of_trajectory(blocks, None if periods is None else periods[k]) for k, blocks in enumerate(trajectories)]
    if not moments:
        raise ValueError("statistics need a trajectory")
    velocity, acceleration = zip(*moments, strict=True)
    return MotionStatistics(*_over_trajectories(velocity), *_over_trajectories(acceleration))


def _of_trajectory(blocks: Iterable[np.ndarray], period: np.ndarray | None) -> tuple[Moments, Moments]:
    """Return the moments of displacements, across periodic faces the shorter ones, and of their differences."""
    velocity = acceleration = None
    before: np.ndarray | None = None
    for block in blocks:
        positions = block.astype(np.float64)
        joined = positions if before is None else np.concatenate([before, positions])
        v = np.diff(joined, axis=0)
        if period is not None:
            for a in np.flatnonzero(np.isfinite(period)):
                v[..., a] -= period[a] * np.round(v[..., a] / period[a])
        a = np.diff(v, axis=0)
        # Of the two frames that are carried over, the displacement was counted already.
        new = v if before is None else v[len(before) - 1 :]
        velocity, acceleration = _with(velocity, new), _with(acceleration, a)
        before = joined[-2:]
    if velocity is None or acceleration is None:
        raise ValueError("statistics need three frames of each trajectory")
    return velocity, acceleration


def _with(moments: Moments | None, vectors: np.ndarray) -> Moments | None:
    if vectors.size == 0:
        return moments
    return Moments.of(vectors) if moments is None else moments.merged(Moments.of(vectors))


def _over_trajectories(moments: Iterable[Moments]) -> tuple[np.ndarray, np.ndarray]:
    means = np.array([each.mean for each in moments])
    mean = means.mean(axis=0)
    # The mean squared distance from the overall mean, without a second reading.
    variance = (np.array([each.variance for each in moments]) + np.square(means - mean)).mean(axis=0)
    std = np.sqrt(variance)
    return mean, np.where(std < STD_LEAST, 1.0, std)
