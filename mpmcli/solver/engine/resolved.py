"""What the solver reads from a scene before a run: each is computed at its first use, and once."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.scene.sampling import count_sources
from mpmcli.scene.sheets import sheets_in
from mpmcli.solver.contact.layers import Layers
from mpmcli.solver.engine.compiled_kind import CompiledKind


@dataclass(frozen=True, eq=False)
class Resolved:
    """A scene and its `particles`, one entry per source; None until they are sampled."""

    scene: Scene
    particles: Sequence[BodyParticles] | None = None
    # Positions of the particles of bodies that were counted and are not sampled yet.
    _places: dict[int, np.ndarray] = field(default_factory=dict, init=False)

    @staticmethod
    def of(scene: "Scene | Resolved") -> "Resolved":
        """Return a scene resolved, unless it is."""
        return scene if isinstance(scene, Resolved) else Resolved(scene)

    @cached_property
    def layers(self) -> Layers:
        """The layers of nodes."""
        return Layers.of(self.scene)

    @cached_property
    def kind(self) -> CompiledKind:
        """The kind of its runs: with its particles, or as many as `count_sources` finds."""
        scene, found = self.scene, self.particles
        if found is None:
            counts, sheets = count_sources(scene, self._places), sheets_in(scene)
        else:
            counts, sheets = [b.count for b in found], [b.sheets for b in found if b.waits]
        return CompiledKind.of(scene, self.layers, counts, sheets)

    def sampled(self) -> "Resolved":
        """Return it with its particles; InputError: see `sample_bodies`."""
        return self if self.particles else Resolved(self.scene, sample_bodies(self.scene, self._places))
