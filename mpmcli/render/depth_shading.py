"""Shading by depth: what lies behind its surroundings is darker, so that dots show the shape of a body.

VTK's eye-dome lighting and SSAO were compared with it, and take three to five times as long (docs/shading.md).
"""

import numpy as np

from mpmcli.render.view import View

# Fraction of the light that a deep gap absorbs.
STRENGTH = 0.55
# Depth of a deep gap, in diameters of a dot.
DEEP = 4.0
# Distance of the compared pixels, in diameters of a dot.
REACH = 1.2
# Upper bound of a gap, in units of `DEEP`: what is farther away is another body.
MOST = 1.5
DIRECTIONS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))


def depth_shaded(
    picture: np.ndarray,
    depth: np.ndarray,
    diameter: float,
    view: View,
    samples: int,
    dots: np.ndarray | None = None,
) -> np.ndarray:
    """Darken what lies deeper than its surroundings (eye-dome lighting, C. Boucheny, PhD thesis, Grenoble 2009).

    Args:
        picture: (h, w, 3) uint8.
        depth: (h * samples, w * samples), m; inf where there is nothing.
        diameter: of the dots, m.
        dots: the same as `depth` of what is compared, where there is more in the picture; the rest is not darkened.

    Returns:
        (h, w, 3) uint8.
    """
    # The nearest of the samples of a pixel: its edges belong to what is in front.
    height, width = view.size[1], view.size[0]
    nearest = first = depth.reshape(height, samples, width, samples).min(axis=(1, 3))
    if dots is not None:
        nearest = dots.reshape(height, samples, width, samples).min(axis=(1, 3))
    solid = np.isfinite(nearest)
    if not solid.any():
        return picture
    # From very near a dot is larger than the picture.
    reach = max(1, min(round(REACH * diameter * view.pixels_per_metre), max(view.size)))
    bare = np.where(solid, nearest, np.float32(view.far))
    padded = np.pad(bare, reach, mode="edge")
    gap = np.zeros_like(bare)
    for i, j in DIRECTIONS:
        other = padded[reach + i * reach :, reach + j * reach :][:height, :width]
        gap += np.clip((bare - other) / np.float32(DEEP * diameter), 0.0, MOST)
    shade = np.exp(-STRENGTH * 2.0 * gap / len(DIRECTIONS) * 2.0)
    shade[~solid | (first < nearest)] = 1.0
    return (picture * shade[:, :, None] + 0.5).astype(np.uint8)
