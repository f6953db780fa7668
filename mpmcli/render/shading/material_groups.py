"""Particles that are drawn as one body: those of one liquid, and those of each solid body."""

from dataclasses import dataclass

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.appearance import Appearance
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.surfaces.reconstruction import drawable


@dataclass(frozen=True)
class Group:
    """Particles of one surface.

    Attributes:
        key: the material, and the body where bodies of one material stay apart.
        appearance: of the material.
        rows: (n,) of the frame.
        position: (n, d) float64, m.
        distance: between neighbouring particles at the start, m; the largest of its bodies.
    """

    key: tuple[int, int]
    appearance: Appearance
    rows: np.ndarray
    position: np.ndarray
    distance: float

    @property
    def hashes(self) -> np.ndarray:
        """Return three numbers from -1 to 1 of each particle, (n, 3) float32: always the same of the same row."""
        words = self.rows.astype(np.uint32)[:, None] * np.uint32(3) + np.arange(3, dtype=np.uint32)
        # The finaliser of MurmurHash3 (Appleby).
        for factor, shift in ((0x85EBCA6B, 16), (0xC2B2AE35, 13)):
            words = (words ^ (words >> np.uint32(shift))) * np.uint32(factor)
        words ^= words >> np.uint32(16)
        return (words.astype(np.float64) / 2.0**31 - 1.0).astype(np.float32)


def groups_of(scene: RenderScene, frame: Frame) -> list[Group]:
    """Return the groups of a frame that have particles to be drawn, in the order of materials and bodies."""
    material_of, distances = np.array(scene.material_of), np.array(scene.distances)
    body = np.clip(frame.body, 0, len(material_of) - 1)
    material = material_of[body]
    sound = drawable(frame.position, scene.lower, scene.upper, max(scene.distances))
    groups = []
    for m, appearance in enumerate(scene.appearances):
        bodies = [b for b in range(len(material_of)) if material_of[b] == m]
        for key, members in [((m, -1), bodies)] if appearance.liquid else [((m, b), [b]) for b in bodies]:
            rows = np.flatnonzero(sound & (material == m) & np.isin(body, members))
            if len(rows):
                distance = float(distances[members].max())
                groups.append(Group(key, appearance, rows, frame.position[rows].astype(np.float64), distance))
    return groups
