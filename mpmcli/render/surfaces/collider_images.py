"""Mirror images of particles behind colliders, so that what leans on one has no edge there."""

import numpy as np

from mpmcli.frames.frame import Frame
from mpmcli.render.render_scene import RenderScene
from mpmcli.scene.colliders import Collider

# Distance from a collider within which a particle has an image, in distances between particles.
NEAR = 2.0
# Most by which the mirror is before the collider, in the same measure: bodies are kept about a distance from it.
BEFORE = 0.75
# Depth behind an image that is inside of the collider too, in the same measure: no image is seen beyond a thin one.
BEHIND = 2.0
# Step of differences, in the same measure.
STEP = 1e-3


def with_collider_images(position: np.ndarray, distance: float, scene: RenderScene, frame: Frame) -> np.ndarray:
    """Return particles (n, d) of one distance between neighbours, m, and their images in the colliders of a frame."""
    found = [position]
    for number, collider in enumerate(scene.colliders):
        if scene.shows(number, frame):
            found.append(_images(position, distance, collider, frame.time))
    return np.concatenate(found)


def _images(position: np.ndarray, distance: float, collider: Collider, time: float) -> np.ndarray:
    away = collider.signed_distance(position, time)
    near = (away > 0) & (away < NEAR * distance)
    points, away = position[near], away[near, None]
    step = STEP * distance
    normal = np.stack(
        [
            collider.signed_distance(points + shift, time) - collider.signed_distance(points - shift, time)
            for shift in step * np.eye(position.shape[1])
        ],
        axis=1,
    ) / (2 * step)
    # As far from its image as from another particle, where the mirror may be as far before the collider.
    mirror = np.clip(away - 0.5 * distance, 0.0, BEFORE * distance)
    images = points - 2 * (away - mirror) * normal
    thick = collider.signed_distance(images - BEHIND * distance * normal, time) < 0
    return images[thick]
