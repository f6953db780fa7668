"""What formats of training code share: a file per split, types of particles, statistics of motion."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from mpmcli.dataset.formats.format import Format, Written
from mpmcli.dataset.metadata import learning_facts, require_alike
from mpmcli.dataset.shard import SPLITS
from mpmcli.dataset.subsample import KINDS, SubsampledTrajectory
from mpmcli.errors import InputError


class TrainingFormat(Format):
    """One file per split; laws get particle types from `usual`, then `free`; `KINDS` are the types of walls."""

    name: ClassVar[str]
    suffix: ClassVar[str]
    usual: ClassVar[Mapping[str, int]]
    free: ClassVar[Sequence[int]]
    wall: ClassVar[int]
    moving_wall: ClassVar[int]
    rigid_body: ClassVar[int]
    parameters: Sequence[str] = ()

    @abstractmethod
    def facts(self) -> Written:
        """Return the entries of this format alone."""

    @abstractmethod
    def write_split(self, path: Path, chosen: Sequence[SubsampledTrajectory], tick: Callable[[], None]) -> None:
        """Write the file of a split."""

    def size(self) -> int:
        return sum(map(self._bytes, self.trajectories))

    def _bytes(self, trajectory: SubsampledTrajectory) -> int:
        position = 4 * trajectory.layout.dimension * trajectory.frame_count
        return trajectory.whole_count * (position + 8 + 8 * len(self.parameters))

    def check(self) -> None:
        require_alike(self.trajectories, self.name)
        _ = self.types

    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        """Write a file per split that has trajectories; return `facts`, particle types and statistics, and notes."""
        statistics, notes = learning_facts(self.trajectories)
        facts, more = self.facts()
        notes += more
        for split in SPLITS:
            file = f"{split}{self.suffix}"
            if chosen := [each for each in self.trajectories if each.source.split == split]:
                self.write_split(directory / file, chosen, tick)
            else:
                notes.append(f"No trajectory is of the split {split}: {file} is left out, as loaders need one.")
        # The metadata has one entry for all domains.
        if self._domains_differ:
            notes.append("The domains of the trajectories differ: bounds is the box around all of them.")
        return facts | {"particle_types": self.types | self._wall_types(), **statistics}, notes

    @property
    def _domains_differ(self) -> bool:
        headers = [each.source.header for each in self.trajectories]
        return len({(tuple(header.origin), tuple(header.upper), tuple(header.periodic)) for header in headers}) > 1

    @cached_property
    def types(self) -> dict[str, int]:
        """The particle type of each law; InputError: there are more laws than types."""
        laws = sorted({law.name for each in self.trajectories for law in each.source.header.laws})
        taken = self._wall_types().values()
        types = {name: self.usual[name] for name in laws if self.usual.get(name, -1) not in {-1, *taken}}
        others = [name for name in laws if name not in types]
        left = [number for number in self.free if number not in {*types.values(), *taken}]
        if others[len(left) :]:
            law = others[len(left)]
            raise InputError(f"{self.name} has no particle type left for {law}, the law of some of the particles.")
        return types | dict(zip(others, left, strict=False))

    def _wall_types(self) -> dict[str, int]:
        found = {KINDS[k] for each in self.trajectories for k in np.unique(each.walls.kinds)}
        known = {name: getattr(self, name) for name in KINDS if name in found}
        return {"wall" if number == self.wall else name: number for name, number in known.items()}

    def particle_types(self, trajectory: SubsampledTrajectory) -> np.ndarray:
        """Return the type of each particle, and then of each on walls, (N + W,) int64."""
        laws = np.array([self.types[law.name] for law in trajectory.source.header.laws], np.int64)
        walls = np.array([getattr(self, name) for name in KINDS], np.int64)[trajectory.walls.kinds]
        return np.concatenate([laws[trajectory.label("material")], walls])
