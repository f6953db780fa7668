"""The format of GNS (Graph Network Simulator)."""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from mpmcli.dataset.formats.format import Written
from mpmcli.dataset.formats.npz import write_npz
from mpmcli.dataset.formats.training import TrainingFormat
from mpmcli.dataset.subsample import SubsampledTrajectory
from mpmcli.errors import InputError
from mpmcli.scene.problem import listed


class Gns(TrainingFormat):
    """train.npz, valid.npz and test.npz, as the particle data loader of GNS reads them.

    Source: github.com/geoelements/gns, gns/data_loader.py, gns/train.py and docs/gns_data.md. Each entry is an object
        array of (positions (T, N, d) float32, particle type (N,) int64), and, if parameters differ within a law, (N,)
        or (N, m) float64 with the parameters.
    """

    files = r"(train|valid|test)\.npz"

    name, suffix = "GNS", ".npz"
    # As in the data of DeepMind's "Learning to simulate": 5 water, 6 sand, 7 goop; 3 is for particles with prescribed
    # motion, here those on walls, and 0 for rigid bodies.
    usual: ClassVar = dict(fluid=5, sand=6, viscoplastic=7, fixed_corotated=0, neo_hookean=1, snow=2, von_mises=4)
    free = (8, 4, 2, 1, 0, 7)
    wall = moving_wall = 3
    rigid_body = 0

    def check(self) -> None:
        """Refuse periodic faces, and features that are unknown or ambiguous."""
        for each in self.trajectories:
            if each.source.header.periodic.any():
                raise InputError(
                    f"trajectory {each.source.number} has periodic faces, which GNS does not support: velocities would "
                    "jump there, and particles at them lack neighbours; --to lagrangebench and --to npz take them."
                )
        super().check()
        known = [*self._differing]
        if self._features is None and len(known) > 1:
            raise InputError(
                f"{listed(known, 'and')} differ between bodies of one law, and the loader of GNS takes one parameter: "
                f"give --features {known[0]}, several with commas for a loader whose np.full has the shape (N, m), or "
                "--features none."
            )
        for name in self._features or ():
            if name not in known:
                has = f"; {listed(known, 'and')} {'do' if len(known) > 1 else 'does'}" if known else ""
                raise InputError(f'--features: "{name}" does not differ between bodies of one law{has}.')

    @property
    def parameters(self) -> list[str]:
        """Names of the material parameters that particles have."""
        return self._differing if self._features is None else list(self._features)

    @cached_property
    def _differing(self) -> list[str]:
        """Names of numeric parameters that scenes state differently for bodies of one law, over all trajectories."""
        values: dict[tuple[str, str], set[float]] = {}
        for each in self.trajectories:
            for body in each.source.header.bodies:
                for name, value in body.material.items():
                    # A modulus that mpmcli has chosen follows from the scene.
                    if isinstance(value, int | float) and math.isfinite(value) and name not in body.chosen:
                        values.setdefault((str(body.material.get("law")), name), set()).add(float(value))
        return sorted({name for (_, name), different in values.items() if len(different) > 1})

    def facts(self) -> Written:
        """Return what determines the sizes of a GNS network, with the range of each material parameter, and notes."""
        names, d = self.parameters, self.trajectories[0].layout.dimension
        notes = [
            f"Each particle has {len(names)} parameters of its material ({', '.join(names)}): the loader of GNS takes "
            "one, unless np.full in it is given the shape (N, m)."
        ]
        values = np.concatenate([self._parameters_of_bodies(each) for each in self.trajectories])
        return {
            # Every frame counts: a rollout is compared with all frames after the first six.
            "sequence_length": self.trajectories[0].frame_count,
            # Per particle: the last 5 velocities, the distances to 2 d walls, and an embedding of its type in 16
            # numbers.
            "nnode_in": 5 * d + 2 * d + 16 + len(names),
            "nedge_in": d + 1,
            "material_feature_len": len(names),
            "material_feature_names": names,
            "material_feature_min": np.min(values, axis=0).tolist(),
            "material_feature_max": np.max(values, axis=0).tolist(),
        }, notes if len(names) > 1 else []

    def _parameters_of_bodies(self, trajectory: SubsampledTrajectory) -> np.ndarray:
        """Return the parameters of each body, (bodies, m), in the units of scenes; 0 if a law has no such parameter."""
        bodies = trajectory.source.header.bodies
        rows = [[body.material.get(name, 0.0) for name in self.parameters] for body in bodies]
        numbers = [[float(value) if isinstance(value, int | float) else 0.0 for value in row] for row in rows]
        return np.array(numbers).reshape(len(bodies), len(self.parameters))

    def write_split(self, path: Path, chosen: Sequence[SubsampledTrajectory], tick: Callable[[], None]) -> None:
        """Write an NPZ file with an object array per trajectory: positions, types, and maybe material parameters."""

        def entries() -> Iterable[tuple[str, np.ndarray]]:
            """Yield the name and the object array of each trajectory, one at a time in memory."""
            m = len(self.parameters)
            for each in chosen:
                positions = np.concatenate([block.astype(np.float32) for block in each.whole_blocks()])
                parts = [positions, self.particle_types(each)]
                if m:
                    # The loader broadcasts a single parameter to (N,), which fails with (N, 1).
                    properties = self._parameters_of_bodies(each)[each.label("body")]
                    properties = np.concatenate([properties, np.zeros((each.walls.count, m))])
                    parts.append(properties[:, 0] if m == 1 else properties)
                # numpy would try to convert a tuple of arrays to one numeric array, and fail.
                entry = np.empty(len(parts), object)
                for k, part in enumerate(parts):
                    entry[k] = part
                yield f"trajectory_{each.source.number:06d}", entry
                tick()

        write_npz(path, entries())
