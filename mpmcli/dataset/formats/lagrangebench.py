"""The format of LagrangeBench."""

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import h5py
import numpy as np

from mpmcli.dataset.formats.format import Written
from mpmcli.dataset.formats.training import TrainingFormat
from mpmcli.dataset.metadata import RADIUS_IN_SPACINGS, domain_around, outruns_periods
from mpmcli.dataset.subsample import SubsampledTrajectory
from mpmcli.errors import InputError
from mpmcli.output.durable import ask_for


class LagrangeBench(TrainingFormat):
    """train.h5, valid.h5 and test.h5, as the class H5Dataset of LagrangeBench reads them.

    Source: github.com/tumaer/lagrangebench, lagrangebench/data/data.py, utils.py (NodeType) and
    data_gen/lagrangebench_data/gen_dataset.py. Trajectory k of a split is the group f"{k:05d}" with `position`,
    (T, N, d) float32, and `particle_type`, (N,) int64; all have the same T.

    Its search for neighbours sorts positions into cells from 0 to below the extent of bounds, and repeats either no
    axis or all of them (case_setup/case.py; tumaer/jax-sph, jax_md/partition.py): positions are relative to the lower
    corner of the domain, below the upper one, and bounds leave a gap behind walls where another axis is periodic.
    """

    files = r"(train|valid|test)\.h5"

    name, suffix = "LagrangeBench", ".h5"
    # Its own types are 0 fluid, 1 solid wall, 2 moving wall, 3 rigid body, -1 padding, out of 9.
    usual: ClassVar = {"fluid": 0, "sand": 4, "viscoplastic": 5, "snow": 6, "von_mises": 7, "fixed_corotated": 8}
    free = (8, 7, 6, 5, 4)
    wall, moving_wall, rigid_body = 1, 2, 3

    def check(self) -> None:
        """Refuse periodic domains that differ, and particles that cross half of a period between two frames."""
        super().check()
        periodic = np.any([each.source.header.periodic for each in self.trajectories])
        if periodic and self._domains_differ:
            raise InputError(
                "the trajectories differ in their domain or its periodic faces, of which LagrangeBench has one for "
                "all: export them apart, or --to npz."
            )
        fast = next((each for each in self.trajectories if outruns_periods(each)), None) if periodic else None
        if fast is not None:
            raise InputError(
                f"particles of trajectory {fast.source.number} cross half of the periodic domain between two exported "
                "frames, so that LagrangeBench cannot tell which way they went: take a smaller --stride, or store "
                "more frames."
            )

    @cached_property
    def _box(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower corner of all domains, their extent, and that with the gaps behind walls: (d,), m."""
        lower, upper = domain_around([each.source.header for each in self.trajectories])
        for each in self.trajectories:
            if each.walls.count:
                # A collider may extend or move out of the domain.
                points = each.walls.positions(each.times)
                lower, upper = np.minimum(lower, points.min(axis=(0, 1))), np.maximum(upper, points.max(axis=(0, 1)))
        periodic = self.trajectories[0].source.header.periodic
        # Two radii: neighbour lists may use a search radius larger than one.
        gap = 2 * RADIUS_IN_SPACINGS * max(each.spacing for each in self.trajectories)
        return lower, upper - lower, upper - lower + np.where(periodic.any() & ~periodic, gap, 0.0)

    def facts(self) -> Written:
        first = self.trajectories[0]
        lower, extent, box = self._box
        place = {"bounds": [[0.0, side] for side in box.tolist()], "origin": lower.tolist()}
        notes = []
        if (box > extent).any():
            notes.append("LagrangeBench repeats all axes or none: bounds reach beyond the walls of the others.")
        # As in LagrangeBench, the frame that is only the last target does not count.
        length = first.frame_count - 1
        lengths = {"sequence_length_train": length, "sequence_length_test": length}
        return {"solver": "MPM", "case": first.source.header.title, **lengths, **place}, notes

    def write_split(self, path: Path, chosen: Sequence[SubsampledTrajectory], tick: Callable[[], None]) -> None:
        ask_for(path, sum(map(self._bytes, chosen)))
        with h5py.File(path, "w") as file:
            for k, each in enumerate(chosen):
                self._write_trajectory(file.create_group(f"{k:05d}"), each)
                tick()

    def _write_trajectory(self, group: h5py.Group, trajectory: SubsampledTrajectory) -> None:
        """Write positions relative to the lower corner, m, inside the box, and particle types to a group."""
        # The layout of the file depends on the time at which objects are closed: before the next group is made.
        shape = (trajectory.frame_count, trajectory.whole_count, trajectory.layout.dimension)
        # Loaders read windows of several frames: a chunk is one window.
        position = group.create_dataset("position", shape, np.float32, chunks=(1, *shape[1:]), compression="gzip")
        first, (lower, extent, _) = 0, self._box
        periodic = self.trajectories[0].source.header.periodic
        for block in trajectory.whole_blocks():
            placed = block.astype(np.float64) - lower
            placed = np.where(periodic, np.mod(placed, extent), placed)
            # A position on an upper face is moved below it by a few rounding errors of the quotient that determines its
            # cell.
            position[first : first + len(block)] = np.clip(placed, 0.0, extent * (1 - 2.0**-20)).astype(np.float32)
            first += len(block)
        group.create_dataset("particle_type", data=self.particle_types(trajectory))
