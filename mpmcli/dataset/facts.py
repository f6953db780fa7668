"""What metadata.json says of an export, whatever its format."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mpmcli import __version__
from mpmcli.dataset.shard import SPLITS
from mpmcli.dataset.statistics import motion_statistics
from mpmcli.dataset.thinned import ThinnedTrajectory
from mpmcli.errors import InputError
from mpmcli.output.header import RunHeader

# Neighbours of a particle on the lattice of the start lie at 1 and sqrt(2) spacings, 8 in 2D and 18 in 3D, and the next
# ones at 2 (2D) and sqrt(3) (3D). LagrangeBench takes about the same (1.45, data_gen/.../gen_dataset.py).
RADIUS_IN_SPACINGS = 1.5
EXPORTED_BY = "exported_by"
# Exports without it have no checksums.
FORMAT_KEY, FORMAT = "export_format", 2
# Of the time between frames: they are landed on exactly, up to the rounding of sums.
UNEVEN = 1e-6
LEAST_FRAMES = 3


def common_facts(trajectories: Sequence[ThinnedTrajectory], stride: int) -> dict[str, Any]:
    """Return what every format says: the domain, lengths, numbers of trajectories. Lengths are in m, times in s.

    Raises:
        InputError: trajectories have different dimensions.
    """
    headers = [each.source.header for each in trajectories]
    first = headers[0]
    for each, header in zip(trajectories, headers, strict=True):
        if header.dimension != first.dimension:
            raise InputError(
                f"trajectory {each.source.number} is {header.dimension}D and the first one {first.dimension}D: "
                "an export holds trajectories of one dimension."
            )
    placed = all(header.origin is not None for header in headers)
    bounds = [np.min([h.origin for h in headers], axis=0), np.max([h.upper for h in headers], axis=0)] if placed else []
    spacings = [each.spacing for each in trajectories]
    dx = None if None in spacings else max(spacings)
    cells = [header.spacing for header in headers]
    # Which trajectory of the dataset is which one of the export.
    numbers = {split: [e.source.number for e in trajectories if e.source.split == split] for split in SPLITS}
    lengths = {each.frame_count for each in trajectories}
    return {
        EXPORTED_BY: f"mpmcli {__version__}",
        FORMAT_KEY: FORMAT,
        "title": first.title,
        "dim": first.dimension,
        # Three entries in 2D too, as LagrangeBench has it.
        "periodic_boundary_conditions": [*map(bool, first.periodic), False][:3],
        "bounds": np.transpose(bounds).tolist() if placed else None,
        "dt": time_between(trajectories[0]),
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
    }


def notes_on_domains(trajectories: Sequence[ThinnedTrajectory]) -> list[str]:
    """Return a sentence where the trajectories lie in different domains, for which metadata has one entry."""
    domains = {(tuple(e.source.header.origin), tuple(e.source.header.upper)) for e in trajectories}
    notes = (
        ["The domains of the trajectories differ: bounds is the box around all of them."] if len(domains) > 1 else []
    )
    if len({tuple(e.source.header.periodic) for e in trajectories}) > 1:
        notes.append("The trajectories differ in periodic faces: metadata has those of the first.")
    return notes


def learning_facts(trajectories: Sequence[ThinnedTrajectory]) -> tuple[dict[str, list[float]], list[str]]:
    """Return the statistics of motion of the training split, or of all where it is empty, and a note if so."""
    train = [each for each in trajectories if each.source.split == "train"]
    notes = [] if train else ["No trajectory is of the training split: the statistics are those of all trajectories."]
    chosen = train or trajectories
    periods = [_period(each.source.header) for each in chosen]
    known = periods if np.isfinite(periods).any() else None
    return motion_statistics((each.blocks("position") for each in chosen), known).as_dict(), notes


def _period(header: RunHeader) -> np.ndarray:
    """Return after what way the domain repeats along each axis, (d,), m, infinite where it does not."""
    return np.where(header.periodic, header.upper - header.origin, np.inf)


def require_alike(trajectories: Sequence[ThinnedTrajectory], form: str) -> None:
    """Refuse trajectories of which a learner's loader could not, or should not, make one set.

    Raises:
        InputError: they have different numbers of frames, too few, frames at different distances in time, or no
            known domain.
    """
    first, remedy = trajectories[0], "--to npz takes trajectories that differ."
    dt = time_between(first)
    if first.frame_count < LEAST_FRAMES:
        raise InputError(
            f"trajectory {first.source.number} has {first.frame_count} of the {LEAST_FRAMES} or more frames that "
            f"accelerations in {form} need: take a smaller --stride, or store more frames."
        )
    for each in trajectories:
        number, header = each.source.number, each.source.header
        if header.comes_and_goes:
            raise InputError(
                f"trajectory {number} has particles that come or go, and {form} cannot say which are there: --to npz "
                'and --to vtkhdf keep their field "status".'
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
            raise InputError(f"trajectory {number} does not say its domain and bodies, which {form} needs; {remedy}")


def time_between(trajectory: ThinnedTrajectory) -> float | None:
    """Return the mean time between frames, s; None of a single frame."""
    times = trajectory.times
    return float((times[-1] - times[0]) / (len(times) - 1)) if len(times) > 1 else None


def by_split(
    trajectories: Sequence[ThinnedTrajectory], suffix: str
) -> tuple[dict[str, list[ThinnedTrajectory]], list[str]]:
    """Return the trajectories by the file of their split, and a note on each split without any."""
    found = {f"{split}{suffix}": [e for e in trajectories if e.source.split == split] for split in SPLITS}
    notes = [
        f"No trajectory is of the split {name.removesuffix(suffix)}: {name} is left out, as loaders need one."
        for name, chosen in found.items()
        if not chosen
    ]
    return {name: chosen for name, chosen in found.items() if chosen}, notes


def type_numbers(
    trajectories: Sequence[ThinnedTrajectory], usual: Mapping[str, int], free: Sequence[int], form: str
) -> dict[str, int]:
    """Return the particle type of each law of the trajectories.

    Args:
        usual: the types of the laws that have one.
        free: what the other laws take, in order of their names, unless a usual one of the trajectories has it.

    Raises:
        InputError: there are more laws than types.
    """
    laws = sorted({law.name for each in trajectories for law in each.source.header.laws})
    types = {name: usual[name] for name in laws if name in usual}
    others = [name for name in laws if name not in usual]
    left = [number for number in free if number not in types.values()]
    if len(others) > len(left):
        raise InputError(f"{form} has no particle type left for {others[len(left)]}, the law of some of the particles.")
    return types | dict(zip(others, left, strict=False))


def wall_types(trajectories: Sequence[ThinnedTrajectory], rests: int, moves: int) -> dict[str, int]:
    """Return the types of particles on walls that rest and that move, by name; of those that there are."""
    moving = [bool(moves) for each in trajectories for moves in np.unique(each.walls.moving)]
    if rests == moves:
        return {"wall": rests} if moving else {}
    return ({"wall": rests} if False in moving else {}) | ({"moving_wall": moves} if True in moving else {})


def particle_types(trajectory: ThinnedTrajectory, types: Mapping[str, int], rests: int, moves: int) -> np.ndarray:
    """Return the type of each particle, (N + W,) int64; those on walls have one that `rests` or `moves`."""
    laws = np.array([types[law.name] for law in trajectory.source.header.laws], np.int64)
    walls = np.where(trajectory.walls.moving, moves, rests).astype(np.int64)
    return np.concatenate([laws[trajectory.label("material")], walls])
