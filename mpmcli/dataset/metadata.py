"""The contents of metadata.json in all formats of an export, with the statistics of motion for training code."""

import tomllib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mpmcli import __version__
from mpmcli.dataset.certify import divisor
from mpmcli.dataset.shard import SPLITS, group_name
from mpmcli.dataset.subsample import SubsampledTrajectory
from mpmcli.errors import InputError
from mpmcli.frames.frame import ACTIVE, STATUS
from mpmcli.output.header import RunHeader, nearest_image

# Neighbours of a particle on the lattice of the start lie at 1 and sqrt(2) spacings, 8 in 2D and 18 in 3D, and the next
# ones at 2 (2D) and sqrt(3) (3D). LagrangeBench takes about the same (1.45, data_gen/.../gen_dataset.py).
RADIUS_IN_SPACINGS = 1.5
EXPORTED_BY = "exported_by"
FORMAT_KEY, FORMAT = "export_format", 3
# Tolerance as a fraction of the time between frames: steps end at frames exactly, up to the rounding of sums.
UNEVEN = 1e-6
LEAST_FRAMES = 3


def common_facts(trajectories: Sequence[SubsampledTrajectory], stride: int) -> dict[str, Any]:
    """Return the entries of every format, lengths in m and times in s; InputError: the dimensions differ."""
    headers = [each.source.header for each in trajectories]
    first = headers[0]
    for each, header in zip(trajectories, headers, strict=True):
        if header.dimension != first.dimension:
            both = f"trajectory {each.source.number} is {header.dimension}D and the first one {first.dimension}D"
            raise InputError(f"{both}: an export holds trajectories of one dimension.")
    placed = all(header.origin is not None for header in headers)
    bounds = domain_around(headers) if placed else ()
    spacings = [each.spacing for each in trajectories]
    dx = None if None in spacings else max(spacings)
    cells = [header.spacing for header in headers]
    # Numbers in the dataset of the exported trajectories.
    numbers = {split: [e.source.number for e in trajectories if e.source.split == split] for split in SPLITS}
    lengths = {each.frame_count for each in trajectories}
    pauses = [time_between(each) for each in trajectories]
    known = {group_name(each.source.number): facts_of(each) for each in trajectories}
    same = all(pause is not None and abs(pause - pauses[0]) <= UNEVEN * pause for pause in pauses)
    return {
        EXPORTED_BY: f"mpmcli {__version__}",
        FORMAT_KEY: FORMAT,
        "title": first.title,
        "dim": first.dimension,
        # Three entries in 2D too, as in LagrangeBench.
        "periodic_boundary_conditions": [*map(bool, first.periodic), False][:3],
        "bounds": np.transpose(bounds).tolist() if placed else None,
        "dt": pauses[0] if same else None,
        "write_every": 1,
        "stride": stride,
        "t_end": float(max(each.times[-1] for each in trajectories)),
        "dx": dx,
        "cell_size": None if None in cells else max(cells),
        "default_connectivity_radius": None if dx is None else RADIUS_IN_SPACINGS * dx,
        "connectivity_radius_in_dx": RADIUS_IN_SPACINGS,
        "num_particles_max": max(each.whole_count for each in trajectories),
        "num_frames": lengths.pop() if len(lengths) == 1 else None,
        **{f"num_trajs_{split}": len(numbers[split]) for split in SPLITS},
        "trajectories": numbers,
        **{key: {name: facts[key] for name, facts in known.items()} for key in facts_of(trajectories[0])},
    }


def facts_of(trajectory: SubsampledTrajectory) -> dict[str, Any]:
    """Return the names of laws, bodies and colliders, to which numbers in arrays refer, the draws, and the scene.

    The scene is the effective one, as `tomllib` reads it, in SI units: materials, gravity and drives as numbers or
    expressions of the time, impulses, motions of colliders.
    """
    header = trajectory.source.header
    return {
        "laws": [law.name for law in header.laws],
        "bodies": list(header.body_names),
        "colliders": list(header.collider_names),
        "draws": trajectory.source.draws,
        "scene": tomllib.loads(str(header.stored.get("scene", ""))),
    }


def domain_around(headers: Sequence[RunHeader]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner of the box around the domains of runs, (d,), m; all must be known."""
    return np.min([h.origin for h in headers], axis=0), np.max([h.upper for h in headers], axis=0)


def outruns_periods(trajectory: SubsampledTrajectory) -> bool:
    """Return whether a particle moves by half of a period or more from one exported frame to the next.

    Then its direction is ambiguous from positions alone. All frames are read, and displacements between them add up.
    """
    header, stride = trajectory.source.header, trajectory.stride
    if not header.periodic.any():
        return False
    period = header.period
    longest = np.diff(trajectory.source.times).max(initial=0.0)
    whole = SubsampledTrajectory(trajectory.source)
    number, position, way = 0, None, 0.0
    for block, velocity in zip(whole.blocks("position"), whole.blocks("velocity"), strict=True):
        if (np.abs(velocity) * longest >= period / 2).any():
            return True
        for after in block.astype(float):
            if position is not None:
                way = way + nearest_image(after - position, period)
            if number % stride == 0:
                if (np.abs(way) >= period / 2).any():
                    return True
                way = 0.0
            number, position = number + 1, after
    return False


def learning_facts(trajectories: Sequence[SubsampledTrajectory]) -> tuple[dict[str, list[float]], list[str]]:
    """Return the statistics of motion of the training split, or, with a note, of all trajectories if it is empty."""
    train = [each for each in trajectories if each.source.split == "train"]
    notes = [] if train else ["No trajectory is of the training split: the statistics are those of all trajectories."]
    chosen = train or trajectories
    headers = [each.source.header for each in chosen]
    periods = [header.period for header in headers]
    statistics = motion_statistics(map(_present, chosen), periods)
    return {name: vector.tolist() for name, vector in statistics.items()}, notes


def _present(trajectory: SubsampledTrajectory) -> Iterator[np.ndarray]:
    """Yield the positions as `blocks` does, nan where a particle is not active: it waits, or has gone."""
    source, stride, first = trajectory.source, trajectory.stride, 0
    for block in trajectory.blocks("position"):
        frames = slice(first * stride, (first + len(block)) * stride, stride)
        first += len(block)
        if source.header.particle_count_varies:
            status = source.read(STATUS, frames, trajectory.particles)
            block = np.where((status == ACTIVE)[..., None], block, np.nan)
        yield block


def require_alike(trajectories: Sequence[SubsampledTrajectory], form: str) -> None:
    """Raise an InputError for trajectories that training code cannot or should not load as one set."""
    first, remedy = trajectories[0], "--to npz takes any trajectories."
    dt = time_between(first)
    if first.frame_count < LEAST_FRAMES:
        raise InputError(
            f"trajectory {first.source.number} has {first.frame_count} of the {LEAST_FRAMES} or more frames that "
            f"accelerations in {form} need: take a smaller --stride, or store more frames."
        )
    for each in trajectories:
        number, header = each.source.number, each.source.header
        if each.particle_count == 0:
            raise InputError(f"trajectory {number} has no particles, which {form} needs; {remedy}")
        if header.particle_count_varies and not each.always:
            raise InputError(
                f"trajectory {number} has particles that come or go, and {form} cannot say which are there: --present "
                'always takes those that are there in all frames; npz, parquet and zarr keep the field "status" of all.'
            )
        if each.frame_count != first.frame_count:
            raise InputError(
                f"trajectory {number} has {each.frame_count} frames and trajectory {first.source.number} "
                f"{first.frame_count}: {form} needs the same number in all; {remedy}"
            )
        if (np.abs(np.diff(each.times) - dt) > UNEVEN * dt).any():
            raise InputError(
                f"trajectory {number} has frames that are not {dt:.6g} s apart, as those of trajectory "
                f"{first.source.number} are at first: {form} has one time between frames; {remedy}"
            )
        if header.origin is None or each.spacing is None:
            raise InputError(f"trajectory {number} lacks domain and bodies in its header, which {form} needs; {remedy}")


def time_between(trajectory: SubsampledTrajectory) -> float | None:
    """Return the mean time between frames, s; None for a single frame."""
    times = trajectory.times
    return float((times[-1] - times[0]) / (len(times) - 1)) if len(times) > 1 else None


@dataclass(frozen=True, eq=False)
class Moments:
    """Count, mean and squared deviations of vectors, (d,), mergeable without loss (Chan, Golub and LeVeque 1979)."""

    count: int
    mean: np.ndarray
    square: np.ndarray

    @classmethod
    def of(cls, vectors: np.ndarray) -> "Moments":
        """Return the moments of (..., d) vectors, at least one."""
        rows = vectors.reshape(-1, vectors.shape[-1]).astype(np.float64, copy=False)
        mean = rows.mean(axis=0)
        return cls(len(rows), mean, np.square(rows - mean).sum(axis=0))

    def merged(self, other: "Moments") -> "Moments":
        """Return the moments of the vectors of both."""
        count, apart = self.count + other.count, other.mean - self.mean
        mean = self.mean + apart * (other.count / count)
        return Moments(count, mean, self.square + other.square + apart**2 * (self.count * other.count / count))

    @property
    def variance(self) -> np.ndarray:
        """Population variance, (d,)."""
        return self.square / self.count


def motion_statistics(
    trajectories: Iterable[Iterable[np.ndarray]], periods: Sequence[np.ndarray] | None = None
) -> dict[str, np.ndarray]:
    """Return mean and deviation, (d,), m, of x[t+1] - x[t] and its differences; trajectories have equal weights.

    Positions that are nan are left out. ValueError: a trajectory has no particle in three consecutive frames.
    """
    moments = [_of_trajectory(blocks, None if periods is None else periods[k]) for k, blocks in enumerate(trajectories)]
    if not moments:
        raise ValueError("statistics need a trajectory")
    velocity, acceleration = map(_over_trajectories, zip(*moments, strict=True))
    return dict(zip(("vel_mean", "vel_std", "acc_mean", "acc_std"), velocity + acceleration, strict=True))


def _of_trajectory(blocks: Iterable[np.ndarray], period: np.ndarray | None) -> tuple[Moments, Moments]:
    """Return the moments of displacements, unwrapped at periodic faces, and of their differences."""
    velocity = acceleration = None
    before: np.ndarray | None = None
    for block in blocks:
        positions = block.astype(np.float64)
        joined = positions if before is None else np.concatenate([before, positions])
        v = np.diff(joined, axis=0)
        if period is not None:
            v = nearest_image(v, period)
        a = np.diff(v, axis=0)
        # The displacement between the two frames that are carried over was already counted.
        new = v if before is None else v[len(before) - 1 :]
        velocity, acceleration = _with(velocity, new), _with(acceleration, a)
        before = joined[-2:]
    if velocity is None or acceleration is None:
        raise ValueError("statistics need a particle in three frames of each trajectory")
    return velocity, acceleration


def _with(moments: Moments | None, vectors: np.ndarray) -> Moments | None:
    finite = np.isfinite(vectors)
    found = vectors if finite.all() else vectors[finite.all(axis=-1)]
    if found.size == 0:
        return moments
    return Moments.of(found) if moments is None else moments.merged(Moments.of(found))


def _over_trajectories(moments: Iterable[Moments]) -> tuple[np.ndarray, np.ndarray]:
    means = np.array([each.mean for each in moments])
    mean = means.mean(axis=0)
    # The mean squared distance from the overall mean, without a second pass.
    variance = (np.array([each.variance for each in moments]) + np.square(means - mean)).mean(axis=0)
    std = np.sqrt(variance)
    return mean, divisor(std)
