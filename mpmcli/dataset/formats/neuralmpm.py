"""The format of NeuralMPM."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar

import h5py
import numpy as np

from mpmcli.dataset.formats.format import Written
from mpmcli.dataset.formats.training import TrainingFormat
from mpmcli.dataset.subsample import SubsampledTrajectory
from mpmcli.errors import InputError
from mpmcli.output.durable import ask_for


class NeuralMpm(TrainingFormat):
    """train/sim_0.h5 and so on, as the class NMPMParser of NeuralMPM reads them.

    Source: github.com/OmerRochman/NeuralMPM, neuralmpm/data/parsers/nmpm_parser.py and data_manager.py. A file has
    `particles`, (T, N, d) float32, `boundary`, (T, W, d), and `types`, (N,) int64 from 1 on, as 0 is the boundary; and
    `grav`, (d,) m/s^2, if gravity differs between trajectories. Velocities are differences of positions.
    """

    files = "train|valid|test"
    name, suffix = "NeuralMPM", ""
    usual: ClassVar = {}
    free = tuple(range(1, 10))
    wall = moving_wall = rigid_body = 0

    def check(self) -> None:
        for each in self.trajectories:
            if each.source.header.periodic.any():
                raise InputError(
                    f"trajectory {each.source.number} has periodic faces, where differences of positions jump, and "
                    "NeuralMPM knows no other velocities; --to lagrangebench and --to npz take them."
                )
        super().check()

    def facts(self) -> Written:
        types = {"num_types": 1 + len(self.types)}
        return {"sequence_length": self.trajectories[0].frame_count, **types}, []

    def write_split(self, path: Path, chosen: Sequence[SubsampledTrajectory], tick: Callable[[], None]) -> None:
        """Write an HDF5 file per trajectory: particles, boundary, types, and gravity if it differs between them."""
        found = [each.source.header.steady_gravity for each in self.trajectories]
        differs = all(one is not None for one in found) and len({tuple(one) for one in found}) > 1
        path.mkdir()
        for k, each in enumerate(chosen):
            ask_for(path / f"sim_{k}.h5", self._bytes(each))
            shape = (each.frame_count, each.particle_count, each.layout.dimension)
            with h5py.File(path / f"sim_{k}.h5", "w") as file:
                particles, first = file.create_dataset("particles", shape, np.float32), 0
                for block in each.blocks("position"):
                    particles[first : first + len(block)] = block
                    first += len(block)
                file["boundary"] = each.walls.positions(each.times).astype(np.float32)
                file["types"] = self.particle_types(each)[: each.particle_count]
                if differs:
                    file["grav"] = each.source.header.steady_gravity.astype(np.float32)
            tick()
