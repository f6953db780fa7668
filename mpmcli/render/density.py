"""The density of the grid by the kernel of the solver (docs/theory.md, 2.1): an image in 2D, a slice in 3D."""

import numpy as np
from scipy.ndimage import affine_transform

from mpmcli.errors import InputError
from mpmcli.frames.frame import STATUS, Frame
from mpmcli.output.header import RunHeader
from mpmcli.output.result import Result
from mpmcli.render.colliders import FlatColliders
from mpmcli.render.coloring import Coloring, color_map
from mpmcli.render.frame_choice import evenly_spaced
from mpmcli.render.particle_grid import with_images
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.settings import Theme, rgb_bytes
from mpmcli.render.view import Slice, View

GHOSTS = 2  # nodes beyond a wall that receive mass from inside and from its mirror image (docs/theory.md, 3.1)
FADING = 0.1  # fraction of the upper limit below which the picture fades into the background
LOOKED_AT = 8  # maximum number of frames from which the limits are computed
OUTSIDE = 0.01  # fraction of the nodes with mass that may exceed the upper limit


def grid_density(frame: Frame, header: RunHeader, plane: Slice) -> np.ndarray:
    """Return the mass of the grid nodes of a plane over their volume, by quadratic B-splines, walls mirrored.

    It is (a, b) float64 along the axes of the plane, nodes on both walls included, kg/m^3: a 2D scene is a metre deep.
    """
    h, d = header.spacing, header.dimension
    cells = np.rint((header.upper - header.origin) / h).astype(int)
    masses = header.masses(frame.body)
    place = (np.asarray(frame.position, dtype=np.float64) - header.origin) / h
    if frame.present is not None:
        place[~frame.present] = np.nan
    kept = np.isfinite(place).all(axis=1) & (place >= 0).all(axis=1) & (place <= cells).all(axis=1)
    weight = np.ones(len(place)) if masses is None else masses / h**d
    if plane.normal is not None:
        through = (plane.place - header.origin[plane.normal]) / h
        kept &= np.abs(place[:, plane.normal] - through) < 1.5
        # The plane may lie between nodes, where the kernel is defined too.
        weight = weight * _kernel(place[:, plane.normal] - through)
    place, source = with_images(place[kept][:, list(plane.across)], 1.5, (0.0, 0.0), cells[list(plane.across)])
    weight = weight[kept][source]
    size = cells[list(plane.across)] + 1 + 2 * GHOSTS
    base = np.floor(place - 0.5).astype(np.intp)
    total = np.zeros(size[0] * size[1])
    for offset in np.ndindex(3, 3):
        node = base + np.array(offset)
        share = weight * _kernel(place[:, 0] - node[:, 0]) * _kernel(place[:, 1] - node[:, 1])
        index = (node[:, 0] + GHOSTS) * size[1] + node[:, 1] + GHOSTS
        total += np.bincount(index, share, minlength=len(total))
    return total.reshape(size)[GHOSTS:-GHOSTS, GHOSTS:-GHOSTS]


def _kernel(x: np.ndarray) -> np.ndarray:
    """Return the quadratic B-spline at distances x, in cells."""
    r = np.abs(x)
    return np.where(r < 0.5, 0.75 - r * r, 0.5 * np.square(np.clip(1.5 - r, 0.0, None)))


def density_colors(
    result: Result, plane: Slice, theme: Theme, limits: tuple[float, float] | None = None, cmap: str | None = None
) -> Coloring:
    """Return the colouring of a density; by default at most 1 % of the nodes with mass exceed the upper limit."""
    if result.header.drops:
        raise InputError(
            f"{result.path} holds only the particles present (output.drop_retired), from which masses do not follow: "
            "density needs all of them; run the scene without it, or choose another --mode."
        )
    if limits is None:
        highest = 0.0
        for k in evenly_spaced(range(result.frame_count), LOOKED_AT):
            density = grid_density(result.frame(k, {STATUS} & set(result.field_names)), result.header, plane)
            if (density > 0).any():
                highest = max(highest, float(np.quantile(density[density > 0], 1.0 - OUTSIDE)))
        limits = 0.0, highest or 1.0
    return Coloring("density", "kg/m³", (), lambda frame: np.empty(0), color_map(cmap), limits, theme.missing)


class DensityPainter:
    """Draws the density of the grid in a plane; small values fade into the background."""

    fields: tuple[str, ...] = ()

    def __init__(
        self, header: RunHeader, scene: RenderScene, view: View, theme: Theme, plane: Slice, colors: Coloring
    ) -> None:
        self._header, self._plane, self._colors = header, plane, colors
        self._size, self._ground = view.size, np.array(rgb_bytes(theme.ground), dtype=np.float64)
        self._box = view.pixels(plane.corners(scene))[:, :2]
        self._solid = FlatColliders(scene, view, theme, plane)

    def draw(self, frame: Frame) -> np.ndarray:
        """Return (h, w, 3) uint8."""
        density = grid_density(frame, self._header, self._plane)
        width, height = self._size
        (left, bottom), (right, top) = self._box
        u = (np.arange(width) + 0.5 - left) / (right - left) * (density.shape[0] - 1)
        v = (bottom - np.arange(height) - 0.5) / (bottom - top) * (density.shape[1] - 1)
        steps, start, shape = (v[1] - v[0], u[1] - u[0]), (v[0], u[0]), (height, width)
        values = affine_transform(density.T, steps, start, output_shape=shape, order=1, mode="nearest")
        inside = ((v >= 0) & (v <= density.shape[1] - 1))[:, None] & ((u >= 0) & (u <= density.shape[0] - 1))
        alpha = np.clip(values / (FADING * self._colors.limits[1]), 0.0, 1.0) * inside
        picture = self._ground + alpha[:, :, None] * (self._colors.rgb(values) - self._ground)
        picture /= 255.0
        self._solid.draw(picture, frame)
        return (255.0 * picture + 0.5).astype(np.uint8)
