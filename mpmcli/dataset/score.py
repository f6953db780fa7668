"""Scores of predicted trajectories against those of a dataset, by horizon.

A file of rollouts, .npz or HDF5, has an array (T, N, d) for each trajectory, m, named by its number. Beside them it may
have `frames`, (T,), the numbers of the frames that the rows are, `origin`, (d,), m, the point of the domain at which
its coordinates are 0, and `seconds`, the time that a rollout took: one number, or one for each in the order of numbers.
"""

import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import h5py
import numpy as np

from mpmcli.dataset.dataset import Dataset, Trajectory
from mpmcli.error_bars.observables import MAP_CELLS, Map
from mpmcli.errors import InputError
from mpmcli.frames.frame import ACTIVE, STATUS
from mpmcli.output.checksums import DAMAGE, first_line
from mpmcli.output.header import nearest_image
from mpmcli.plain_text import counted, plain_number, text_table

# Rows over which scores are averaged, besides all, as in LagrangeBench (lagrangebench/evaluate/metrics.py).
HORIZONS = (1, 5, 10, 20, 50, 100)
# The divergence is that of every tenth row, as in LagrangeBench, and of at most so many particles.
STRIDE, MOST_PARTICLES = 10, 500
# Regularisation over the mean cost, that of the library that LagrangeBench uses; iterations, and change that ends them.
SMOOTHING, ITERATIONS, CHANGE = 0.05, 500, 1e-6
# Largest cost over the regularisation: a particle farther away counts as that far, since exp(-cost) is then no number.
LARGEST = 600.0
OTHERS = ("frames", "origin", "seconds")
# What is scored, with its unit and its words.
COLUMNS = {
    "mse": ("m^2", "mean of |x - y|^2 over particles: the MSE of LagrangeBench, d times that of GNS"),
    "sinkhorn": ("m^2", "Sinkhorn divergence, squared distances, of every tenth row"),
    "energy": ("", "error of the kinetic energy over its largest value"),
    "momentum": ("", "error of the momentum over the largest sqrt(2 m E)"),
    "centre": ("m", "distance of the centres of mass"),
    "density": ("", f"share of the mass that is elsewhere, on nodes {MAP_CELLS} cells apart"),
    "volume": ("", "error of the number of cells with particles"),
    "outside": ("", "share of the particles beyond walls or inside colliders"),
    "outside_data": ("", "the same of the data"),
}


@dataclass(frozen=True)
class Rollout:
    """A predicted trajectory.

    Attributes:
        number: of the trajectory.
        positions: (T, N, d), m, in the coordinates of the domain.
        frames: (T,), numbers of the dataset's frames.
        seconds: wall time that it took, None if unknown.
    """

    number: int
    positions: np.ndarray
    frames: np.ndarray
    seconds: float | None = None


def read_rollouts(path: Path, dataset: Dataset) -> list[Rollout]:
    """Read a file of rollouts of trajectories of a dataset.

    Raises:
        InputError: the file is missing or of another kind, or its rollouts do not fit the dataset.
    """
    arrays = _arrays(path)
    named = {int(name): array for name, array in arrays.items() if re.fullmatch(r"\d+", name)}
    if unknown := sorted(name for name in arrays if name not in OTHERS and not re.fullmatch(r"\d+", name)):
        raise InputError(
            f'{path} has an array "{unknown[0]}": name rollouts by the numbers of their trajectories, such as "7"; '
            f"other arrays are {', '.join(OTHERS)}."
        )
    if not named:
        raise InputError(f'{path} has no rollout: store an array (frames, particles, d), named by a number as "7".')
    seconds = np.ravel(arrays.get("seconds", np.full(1, np.nan))).astype(float)
    if len(seconds) not in (1, len(named)):
        raise InputError(f"{path}: seconds has {len(seconds)} entries for {counted(len(named), 'rollout')}.")
    seconds = np.broadcast_to(seconds, len(named))
    return [
        _rollout(f"{path}: rollout {number}", dataset, number, named[number], arrays, None if np.isnan(own) else own)
        for number, own in zip(sorted(named), seconds.tolist(), strict=True)
    ]


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a file by name; InputError: it is missing or damaged, or some are not of numbers."""
    if not path.is_file():
        raise InputError(f"{path} does not exist: give a file of rollouts, .npz or HDF5.")
    try:
        if h5py.is_hdf5(path):
            with h5py.File(path) as file:
                arrays = {name: np.asarray(entry) for name, entry in file.items()}
        else:
            # NumPy leaves a damaged file open.
            with path.open("rb") as stored, np.load(stored, allow_pickle=False) as file:
                arrays = dict(file)
    except (*DAMAGE, BadZipFile, zlib.error) as error:
        raise InputError(f"{path} is no file of rollouts, .npz or HDF5 ({first_line(error)}).") from None
    for name in (name for name, array in arrays.items() if array.dtype.kind not in "iuf"):
        raise InputError(f'{path}: the array "{name}" does not hold numbers.')
    return arrays


def _rollout(
    name: str, dataset: Dataset, number: int, x: np.ndarray, arrays: Mapping[str, np.ndarray], seconds: float | None
) -> Rollout:
    """Return a rollout that fits its trajectory; InputError: it does not."""
    if number not in dataset.numbers:
        raise InputError(f"{name} is of no trajectory of {dataset.path}: is it of another dataset?")
    trajectory = dataset[number]
    d, count, known = trajectory.header.dimension, trajectory.particle_count, trajectory.frame_count
    if x.ndim != 3 or x.shape[1:] != (count, d) or not len(x):
        raise InputError(f"{name} has the shape {x.shape}; the trajectory has (frames, {count}, {d}).")
    if "frames" not in arrays and len(x) > known:
        raise InputError(f"{name} has {len(x)} frames, and the trajectory {known}: leave out those beyond its end.")
    if "frames" not in arrays and len(x) < known:
        raise InputError(f"{name} has {len(x)} of {known} frames: say which by an array `frames`, (T,), as 6, 7, ...")
    frames = np.ravel(arrays.get("frames", np.arange(len(x))))
    if len(frames) != len(x) or not np.isin(frames, np.arange(known)).all() or (np.diff(frames) <= 0).any():
        raise InputError(f"{name}: frames has to name its {len(x)} rows by ascending numbers from 0 to {known - 1}.")
    origin = np.ravel(arrays.get("origin", np.zeros(d)))
    if len(origin) != d:
        raise InputError(f"{name}: origin has {len(origin)} coordinates, and the trajectory {d}.")
    if not np.isfinite(x).all():
        row = int(np.flatnonzero(~np.isfinite(x).all(axis=(1, 2)))[0])
        raise InputError(f"{name} has a position that is not finite in row {row}.")
    return Rollout(number, x.astype(float) + origin, frames.astype(int), seconds)


def position_errors(way: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return the mean of the squares of ways, (T, N, d), m, over the particles present, (T, N): (T,), m^2."""
    square = np.where(present, (way**2).sum(-1), 0.0)
    return square.sum(1) / np.maximum(present.sum(1), 1)


def sinkhorn_divergence(x: np.ndarray, y: np.ndarray, period: np.ndarray) -> float:
    """Return the Sinkhorn divergence of two clouds (n, d), m, m^2: OT(x, y) - (OT(x, x) + OT(y, y)) / 2.

    Costs are squared distances between nearest images, regularised by SMOOTHING times the mean cost from x to y
    (Feydy et al. 2019, Interpolating between optimal transport and MMD using Sinkhorn divergences). It is |s|^2 for
    y = x + s without a period.
    """
    costs = [(nearest_image(a[:, None] - b[None], period) ** 2).sum(-1) for a, b in ((x, y), (x, x), (y, y))]
    # Clouds of one point may have no cost.
    smoothing = max(SMOOTHING * costs[0].mean(), np.finfo(float).tiny)
    between, of_x, of_y = (_transport(cost, smoothing) for cost in costs)
    return between - (of_x + of_y) / 2


def _transport(cost: np.ndarray, smoothing: float) -> float:
    """Return the regularised cost of transport between uniform clouds, from costs (n, m)."""
    n, m = cost.shape
    kernel = np.exp(-np.minimum(cost / smoothing, LARGEST))
    u, v = np.ones(n), np.ones(m)
    for _ in range(ITERATIONS):
        before, u = u, 1 / (kernel @ v / m)
        v = 1 / (u @ kernel / n)
        if np.abs(np.log(u / before)).max() < CHANGE:
            break
    return smoothing * float(np.log(u).mean() + np.log(v).mean())


def score(trajectory: Trajectory, rollout: Rollout) -> dict[str, np.ndarray]:
    """Return the columns of COLUMNS for each row of a rollout, (T,); NaN where there is none."""
    header, rows = trajectory.header, rollout.frames
    x, y = trajectory.position[rows].astype(float), rollout.positions
    present = np.ones(x.shape[:2], bool)
    if STATUS in trajectory.field_names:
        present = trajectory.read(STATUS)[rows] == ACTIVE
    mass = header.masses(trajectory.body)
    mass = np.ones(x.shape[1]) if mass is None else mass
    way = nearest_image(y - x, header.period)
    total = np.maximum((mass * present).sum(1), np.finfo(float).tiny)
    centre = ((mass * present)[..., None] * way).sum(1) / total[:, None]
    chosen = np.linspace(0, x.shape[1] - 1, min(x.shape[1], MOST_PARTICLES)).astype(int)
    divergence = np.full(len(x), np.nan)
    for k in range(0, len(x), STRIDE):
        own = chosen[present[k, chosen]]
        divergence[k] = sinkhorn_divergence(x[k, own], y[k, own], header.period) if len(own) else 0.0
    outside = [_outside(trajectory, rows, z, present) for z in (y, x)]
    found = {"mse": position_errors(way, present), "sinkhorn": divergence, "centre": np.linalg.norm(centre, axis=-1)}
    found |= _motion(x, y, mass, present, trajectory.times[rows], header.period)
    found |= _places(trajectory, x, y, mass, present)
    return found | {"outside": outside[0], "outside_data": outside[1]}


def _motion(
    x: np.ndarray, y: np.ndarray, mass: np.ndarray, present: np.ndarray, times: np.ndarray, period: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the errors of kinetic energy and momentum, by velocities between rows; NaN in the first row."""
    both, pause = present[1:] & present[:-1], np.diff(times)[:, None, None]
    v, w = (nearest_image(np.diff(z, axis=0), period) / pause for z in (x, y))
    energies = [0.5 * (mass * both * (u**2).sum(-1)).sum(1) for u in (v, w)]
    change = ((mass * both)[..., None] * (w - v)).sum(1)
    least, most = np.finfo(float).tiny, energies[0].max(initial=0.0)
    heaviest = (mass * both).sum(1).max(initial=0.0)
    errors = {
        "energy": np.abs(energies[1] - energies[0]) / max(most, least),
        "momentum": np.linalg.norm(change, axis=-1) / np.sqrt(max(2 * heaviest * most, least)),
    }
    return {name: np.concatenate([[np.nan], error]) for name, error in errors.items()}


def _places(
    trajectory: Trajectory, x: np.ndarray, y: np.ndarray, mass: np.ndarray, present: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the share of the mass that is elsewhere, and the error of the number of cells with particles."""
    header = trajectory.header
    low, h = header.origin, header.spacing
    edge = MAP_CELLS * h
    nodes = Map(low - edge, edge, tuple(int(n) + 4 for n in np.ceil((header.upper - low) / edge)))
    # Cells, numbered; predictions may leave the domain.
    strides = (2**20) ** np.arange(x.shape[-1])
    density, volume = np.zeros(len(x)), np.zeros(len(x))
    for k, here in enumerate(present):
        shares = [nodes.shares(z[k, here], mass[here]) for z in (x, y)]
        density[k] = 0.5 * np.abs(shares[1] - shares[0]).sum()
        filled = [len(np.unique(np.floor((z[k, here] - low) / h).astype(int) @ strides)) for z in (x, y)]
        volume[k] = filled[1] / max(filled[0], 1) - 1
    return {"density": density, "volume": np.abs(volume)}


def _outside(trajectory: Trajectory, rows: np.ndarray, x: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return the share of the particles present that are beyond walls or inside colliders, (T,)."""
    header = trajectory.header
    closed = ~(np.array(header.open_axes) | header.periodic)
    gone = (((x < header.origin) | (x > header.upper)) & closed).any(-1)
    for one in trajectory.colliders:
        if one is not None and not one.holds:
            gone |= [one.signed_distance(z, float(t)) < 0 for z, t in zip(x, trajectory.times[rows], strict=True)]
    return (gone & present).sum(1) / np.maximum(present.sum(1), 1)


@dataclass(frozen=True)
class Score:
    """The scores of rollouts: means over trajectories, by horizon.

    Attributes:
        path: of the dataset.
        numbers: trajectories with a rollout.
        horizons: columns of COLUMNS by the number of rows over which they are averaged; of the last, all.
        left: when the error of a rollout first exceeds that of the simulator, s; None: never; empty without [certify].
        seconds: mean time of a rollout, None if unknown.
    """

    path: Path
    numbers: tuple[int, ...]
    horizons: dict[int, dict[str, float]]
    left: tuple[float | None, ...]
    seconds: float | None

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            "dataset": str(self.path),
            "trajectories": list(self.numbers),
            "horizons": {str(rows): found for rows, found in self.horizons.items()},
            "left_error_bar_s": list(self.left),
            "seconds": self.seconds,
        }

    def text(self) -> str:
        """Return a table, a row per horizon, what its columns are, and when rollouts leave the error bar."""
        names = [name for name in COLUMNS if name != "outside_data"]
        rows = [
            (str(n), *("-" if np.isnan(found[name]) else plain_number(found[name]) for name in names))
            for n, found in self.horizons.items()
        ]
        lines = [f"{self.path}: {counted(len(self.numbers), 'rollout')}, means over the first rows of each", ""]
        lines += [text_table(("rows", *names), rows, set()), ""]
        lines += [f"{name}: {COLUMNS[name][1]}{f', {unit}' if (unit := COLUMNS[name][0]) else ''}" for name in names]
        data = self.horizons[max(self.horizons)]["outside_data"]
        lines[-1] += f"; of the data {plain_number(data)}"
        if self.left:
            times = [t for t in self.left if t is not None]
            when = f", the median after {plain_number(float(np.median(times)))} s" if times else ""
            lines.append(f"{len(times)} of {len(self.left)} leave the error bar of the simulator{when}")
        if self.seconds is not None:
            lines.append(f"seconds: {plain_number(self.seconds)} per rollout")
        return "\n".join(lines)


def score_rollouts(dataset: Dataset, rollouts: Sequence[Rollout]) -> Score:
    """Score rollouts against their trajectories; InputError: a shard is damaged."""
    found = {one.number: score(dataset[one.number], one) for one in rollouts}
    longest = max(len(one.frames) for one in rollouts)
    horizons = {}
    for rows in (*(n for n in HORIZONS if n < longest), longest):
        each = [{name: _mean(values[:rows]) for name, values in own.items()} for own in found.values()]
        horizons[rows] = {name: _mean([one[name] for one in each]) for name in COLUMNS}
    bar, left = (dataset.error or {}).get("position_m", {}).get("grid"), []
    for one in rollouts if bar else ():
        known = one.frames < len(bar)
        beyond = one.frames[known][np.sqrt(found[one.number]["mse"][known]) > np.array(bar)[one.frames[known]]]
        left.append(float(dataset[one.number].times[beyond[0]]) if len(beyond) else None)
    times = [one.seconds for one in rollouts if one.seconds is not None]
    return Score(dataset.path, tuple(found), horizons, tuple(left), float(np.mean(times)) if times else None)


def _mean(values: Any) -> float:
    """Return the mean of the values that are not NaN; NaN if there are none."""
    known = np.asarray(values)[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")
