"""Export for GNS: train.npz, valid.npz and test.npz, as its particle data loader reads them.

Source: github.com/geoelements/gns, gns/data_loader.py, gns/train.py and docs/gns_data.md. Each entry is an object array
of (positions (T, N, d) float32, particle type (N,) int64), and, where parameters of the materials differ, (N,) or
(N, m) float64 with those.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.dataset.facts import (
    by_split,
    learning_facts,
    notes_on_domains,
    particle_types,
    require_alike,
    type_numbers,
    wall_types,
)
from mpmcli.dataset.npz_file import write_npz
from mpmcli.dataset.thinned import ThinnedTrajectory

FORM = "GNS"
# As in the data of DeepMind's "Learning to simulate": 5 water, 6 sand, 7 goop; 3 stands for particles whose motion is
# given, here those on walls.
WALL = 3
USUAL = {"fluid": 5, "sand": 6, "viscoplastic": 7, "fixed_corotated": 0, "neo_hookean": 1, "snow": 2, "von_mises": 4}
FREE = (8, 4, 2, 1, 0, 7)
# Of a particle: the last 5 velocities, the distances to 2 d walls, and 16 numbers that stand for its type.
VELOCITIES, WALLS, TYPE_FEATURES = 5, 2, 16


def check(trajectories: Sequence[ThinnedTrajectory]) -> None:
    """Refuse what the format cannot hold.

    Raises:
        InputError: as `require_alike` and `type_numbers`.
    """
    require_alike(trajectories, FORM)
    type_numbers(trajectories, USUAL, FREE, FORM)


def size(trajectories: Sequence[ThinnedTrajectory]) -> int:
    """Return the bytes of the files before compression."""
    m = len(differing_parameters(trajectories))
    return sum(e.whole_count * (4 * e.layout.dimension * e.frame_count + 8 + 8 * m) for e in trajectories)


def write(
    directory: Path, trajectories: Sequence[ThinnedTrajectory], tick: Callable[[], None]
) -> tuple[dict[str, Any], list[str]]:
    """Write the files, and return their part of the metadata, and notes."""
    types, names = type_numbers(trajectories, USUAL, FREE, FORM), differing_parameters(trajectories)
    statistics, notes = learning_facts(trajectories)

    def entries(chosen: Sequence[ThinnedTrajectory]) -> Iterator[tuple[str, np.ndarray]]:
        for each in chosen:
            yield f"trajectory_{each.source.number:06d}", _entry(each, types, names)
            tick()

    splits, left_out = by_split(trajectories, ".npz")
    for name, chosen in splits.items():
        write_npz(directory / name, entries(chosen))
    if len(names) > 1:
        notes.append(
            f"Each particle has {len(names)} parameters of its material ({', '.join(names)}): the loader of GNS takes "
            "one, unless np.full in it is given the shape (N, m)."
        )
    d = trajectories[0].layout.dimension
    values = [value for each in trajectories for value in _of_bodies(each, names)]
    facts = {
        # Every frame counts: a rollout is compared with all that follow the first six.
        "sequence_length": trajectories[0].frame_count,
        "nnode_in": VELOCITIES * d + WALLS * d + TYPE_FEATURES + len(names),
        "nedge_in": d + 1,
        "material_feature_len": len(names),
        "material_feature_names": names,
        "material_feature_min": np.min(values, axis=0).tolist(),
        "material_feature_max": np.max(values, axis=0).tolist(),
        "particle_types": types | wall_types(trajectories, WALL, WALL),
        **statistics,
    }
    return facts, [*notes, *left_out, *notes_on_domains(trajectories)]


def differing_parameters(trajectories: Sequence[ThinnedTrajectory]) -> list[str]:
    """Return the names of numeric parameters whose values differ between bodies of any trajectories."""
    values: dict[str, set[float]] = {}
    for each in trajectories:
        for body in each.source.header.bodies:
            for name, value in body.material.items():
                if isinstance(value, int | float) and math.isfinite(value):
                    values.setdefault(name, set()).add(float(value))
    return sorted(name for name, found in values.items() if len(found) > 1)


def _of_bodies(trajectory: ThinnedTrajectory, names: Sequence[str]) -> np.ndarray:
    """Return the parameters of each body, (bodies, m), in the units of scenes; 0 where a law has no such one."""
    bodies = trajectory.source.header.bodies
    rows = [[body.material.get(name, 0.0) for name in names] for body in bodies]
    numbers = [[float(value) if isinstance(value, int | float) else 0.0 for value in row] for row in rows]
    return np.array(numbers).reshape(len(bodies), len(names))


def _entry(trajectory: ThinnedTrajectory, types: dict[str, int], names: Sequence[str]) -> np.ndarray:
    positions = np.concatenate([block.astype(np.float32) for block in trajectory.whole_blocks()])
    parts = [positions, particle_types(trajectory, types, WALL, WALL)]
    if names:
        # The loader broadcasts a single one to (N,), which it could not do with (N, 1).
        properties = _of_bodies(trajectory, names)[trajectory.label("body")]
        properties = np.concatenate([properties, np.zeros((trajectory.walls.count, len(names)))])
        parts.append(properties[:, 0] if len(names) == 1 else properties)
    # From a tuple of arrays numpy would try to make one array of numbers, and fail.
    entry = np.empty(len(parts), object)
    for k, part in enumerate(parts):
        entry[k] = part
    return entry
