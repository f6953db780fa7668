"""The camera, and the projection of points onto pixels."""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mpmcli.errors import InputError
from mpmcli.render.render_scene import RenderScene
from mpmcli.scene.cameras import PlacedCamera

if TYPE_CHECKING:
    import pyvista as pv

CAMERAS = ("iso", "front", "side", "top")
ANGLE = 24.0  # full vertical angle of a perspective view, degrees; small for little distortion
MARGIN = 0.04  # margin around the domain on each side, as a fraction of the picture
AZIMUTH, ELEVATION = 32.0, 24.0  # angles of the camera "iso" to the right of the front and above the ground, degrees
SQUARE = 1000  # pixels along the sides of the auxiliary picture that gives the aspect ratio
FARTHEST = (
    1e5  # largest distance of a camera, in sizes of the domain, at which the domain covers a hundredth of a pixel
)
CENTRING_ROUNDS = 8  # iterations that centre the projected domain in the picture


@dataclass(frozen=True)
class View:
    """A camera and the size of its picture."""

    size: tuple[int, int]  # pixels, (width, height)
    position: tuple[float, ...]  # of the camera, (3,), m
    focus: tuple[float, ...]  # (3,), m
    up: tuple[float, ...]  # direction (3,)
    height: float  # length at the focus that the full height of the picture shows, m
    parallel: bool  # parallel projection, for which a scale bar is valid
    near: float  # distances from the camera between which the domain lies, m
    far: float
    lamps: "View | None" = None  # the view whose lamps are used; None: its own
    edges: bool = True  # whether the edges of the domain are drawn in 3D

    @property
    def distance(self) -> float:
        """Distance of the camera from its focus, m."""
        return float(np.linalg.norm(np.subtract(self.position, self.focus)))

    @property
    def pixels_per_metre(self) -> float:
        """Pixels per metre, in a perspective view at the focus."""
        return self.size[1] / self.height

    @property
    def axes(self) -> np.ndarray:
        """Directions (3, 3) of the camera as rows: to the right, up, and towards the viewer."""
        return _axes(np.subtract(self.position, self.focus), np.array(self.up))

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Return (n, 3) for points (n, 3), m: pixels from the left and from the top, and the distance, m."""
        right, up, back = np.einsum("ij,nj->in", self.axes, points - np.array(self.position))
        depth = -back
        scale = self.pixels_per_metre * (1.0 if self.parallel else self.distance / depth)
        width, height = self.size
        return np.stack([0.5 * width + right * scale, 0.5 * height - up * scale, depth], axis=1)

    def scale_at(self, distance: np.ndarray) -> np.ndarray:
        """Return pixels per metre at distances from the camera, m."""
        if self.parallel:
            return np.full(np.shape(distance), self.pixels_per_metre)
        return self.pixels_per_metre * self.distance / distance

    def plane(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the coordinates to the right and up from the middle of positions x and y, pixels from left and top.

        They are in metres, in a perspective view in metres at a distance of 1 m.
        """
        width, height = self.size
        unit = 1 / self.pixels_per_metre if self.parallel else 1 / (self.pixels_per_metre * self.distance)
        return (x - 0.5 * width) * unit, (0.5 * height - y) * unit

    def rays(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return starts and directions (..., 3) of lines of sight in the scene: start + z * direction has depth z."""
        across, up = self.plane(x, y)
        right, rise, back = self.axes
        offset = across[..., None] * right + up[..., None] * rise
        start = np.array(self.position)
        if self.parallel:
            return start + offset, np.broadcast_to(-back, offset.shape)
        return np.broadcast_to(start, offset.shape), offset - back

    def place(self, plotter: "pv.Plotter") -> None:
        """Set the camera of a plotter to this view."""
        camera = plotter.camera
        camera.position, camera.focal_point, camera.up = self.position, self.focus, self.up
        camera.parallel_projection = self.parallel
        camera.parallel_scale = 0.5 * self.height
        camera.view_angle = math.degrees(2 * math.atan2(0.5 * self.height, self.distance))
        camera.clipping_range = (self.near, self.far)


def view_of(scene: RenderScene, camera: str, size: tuple[int, int]) -> View:
    """Return the view of the domain of a run from a camera.

    A camera is one of `CAMERAS`, or six comma-separated numbers: its position and its target, m. A 2D scene is always
    seen from the front. InputError: it is none of these, or is not for a 2D scene.
    """
    if scene.dimension == 2 and camera not in ("iso", "front"):
        raise InputError(f"--camera {camera} is for scenes in 3D: this one is in 2D, and drawn in its plane.")
    if camera not in CAMERAS:
        return _free_view(scene, camera, size)
    up = np.array(scene.up)
    right = np.eye(3)[int(np.argmin(np.abs(up)))]
    front = np.cross(right, up)
    if scene.dimension == 2 or camera != "iso":
        back, upright = {"side": (right, up), "top": (up, -front)}.get(camera, (front, up))
        return _framed(scene, back, upright, size, parallel=True)
    turn, rise = math.radians(AZIMUTH), math.radians(ELEVATION)
    level = math.cos(turn) * front + math.sin(turn) * right
    return _framed(scene, math.cos(rise) * level + math.sin(rise) * up, up, size, parallel=False)


@dataclass(frozen=True)
class Slice:
    """A plane through the domain: all of it in 2D."""

    across: tuple[int, int]  # the two axes of the picture, to the right and up
    normal: int | None = None  # the axis through it, None in 2D
    place: float = 0.0  # of the plane along its normal, m

    def corners(self, scene: RenderScene) -> np.ndarray:
        """Return the lower and the upper corner of the domain in the middle plane along the normal, (2, 3), m."""
        low, high = np.array(scene.lower), np.array(scene.upper)
        ends, across = np.tile(0.5 * (low + high), (2, 1)), list(self.across)
        ends[:, across] = np.stack([low, high])[:, across]
        return ends


def slice_of(scene: RenderScene, camera: str) -> Slice:
    """Return the plane in the middle of the domain that a camera faces; "iso" as "front"."""
    if scene.dimension == 2:
        return Slice((0, 1))
    up = int(np.argmax(np.abs(scene.up)))
    right, depth = (axis for axis in range(3) if axis != up)
    across, normal = {"top": ((right, depth), up), "side": ((depth, up), right)}.get(camera, ((right, up), depth))
    return Slice(across, normal, 0.5 * (scene.lower[normal] + scene.upper[normal]))


def aspect_of(scene: RenderScene, camera: str) -> float:
    """Return the ratio of height to width of the domain as seen by a camera, with the margin around it."""
    view = view_of(scene, camera, (SQUARE, SQUARE))
    width, height = np.ptp(view.pixels(corners_of(scene))[:, :2], axis=0) + 2 * MARGIN * SQUARE
    return float(height / width)


def _axes(back: np.ndarray, up: np.ndarray) -> np.ndarray:
    back = back / np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def corners_of(scene: RenderScene) -> np.ndarray:
    """Return the corners (8, 3) of the domain, m; bit k of their number is set at the upper end of axis k."""
    picks = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)])
    return np.where(picks == 1, np.array(scene.upper), np.array(scene.lower))


def _framed(scene: RenderScene, back: np.ndarray, up: np.ndarray, size: tuple[int, int], *, parallel: bool) -> View:
    """Return the nearest view from a direction that shows the whole domain, with its projection centred."""
    corners, axes = corners_of(scene), _axes(back, up)
    focus = corners.mean(axis=0)
    room = 1.0 - 2.0 * MARGIN
    aspect = size[0] / size[1]
    tangent = math.tan(math.radians(0.5 * ANGLE))
    distance = 0.0
    for _ in range(CENTRING_ROUNDS):
        right, rise, towards = (axes @ (corners - focus).T) / room
        if parallel:
            height = 2 * max(np.abs(rise).max(), np.abs(right).max() / aspect)
            distance = height / (2 * tangent)
            break
        towards = towards * room
        distance = float((towards + np.maximum(np.abs(rise), np.abs(right) / aspect) / tangent).max())
        # The middle of the outline moves to the middle of the picture, and the camera with it.
        outline = np.stack([right, rise]) / (distance - towards)
        shift = 0.5 * (outline.min(axis=1) + outline.max(axis=1)) * distance * room
        focus = focus + shift @ axes[:2]
    position = focus + distance * axes[2]
    return _view(scene, size, (position, focus, up), 2 * tangent * distance, parallel)


def _free_view(scene: RenderScene, camera: str, size: tuple[int, int]) -> View:
    """Return the view in perspective of a camera "x,y,z,x,y,z", place and target, m. Raises InputError for others."""
    try:
        numbers = np.array([float(word) for word in camera.split(",")])
    except ValueError:
        numbers = np.empty(0)
    what = f'--camera "{camera}" is not a camera: give {", ".join(CAMERAS)}, or six numbers x,y,z,x,y,z in metres'
    if len(numbers) != 6 or not np.isfinite(numbers).all():
        raise InputError(f"{what}, its position and its target.")
    low, high = np.array(scene.lower), np.array(scene.upper)
    if np.abs(numbers.reshape(2, 3) - 0.5 * (low + high)).max() > FARTHEST * (high - low).max():
        raise InputError(f"{what}: this one is too far from the domain for anything to be seen.")
    position, focus = numbers[:3], numbers[3:]
    back, up = position - focus, np.array(scene.up)
    if np.linalg.norm(back) <= 1e-9 * max(np.abs(numbers).max(), 1e-300):
        raise InputError(f"{what}: its position and its target are equal.")
    up = _upright(back, up)
    height = 2 * math.tan(math.radians(0.5 * ANGLE)) * float(np.linalg.norm(back))
    return _view(scene, size, (position, focus, up), height, parallel=False)


def view_of_camera(scene: RenderScene, camera: PlacedCamera, time: float) -> View:
    """Return the view of a camera of a scene at a time, s, with the lamps of "iso"; InputError: position is target."""
    position, focus = camera.pose(time)
    back, up = position - focus, np.array(camera.up)
    distance = float(np.linalg.norm(back))
    if not distance > 1e-9 * max(np.abs([position, focus]).max(), 1e-300):
        raise InputError(f'camera "{camera.name}" is at its target at {time:.4g} s: move one of them.')
    height = camera.height if camera.focal is None else camera.size[1] / camera.focal * distance
    view = _view(scene, camera.size, (position, focus, _upright(back, up)), height, parallel=camera.focal is None)
    return replace(view, lamps=view_of(scene, "iso", camera.size), edges=False)


def _upright(back: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the upward direction, or another one along an axis for a vertical line of sight."""
    if np.linalg.norm(np.cross(back, up)) > 1e-6 * np.linalg.norm(back) * np.linalg.norm(up):
        return up
    return np.eye(3)[(int(np.argmax(np.abs(up))) + 1) % 3]


def _view(
    scene: RenderScene, size: tuple[int, int], vectors: tuple[np.ndarray, ...], height: float, parallel: bool
) -> View:
    """Return the view from a position to a focus with a direction upwards, the `vectors`."""
    position, focus, up = vectors
    depths = (position - corners_of(scene)) @ _axes(position - focus, up)[2]
    # A margin for shadows and for particles that have left the domain.
    spare = 0.1 * float(np.ptp(corners_of(scene), axis=0).max())
    near, far = float(depths.min()) - spare, float(depths.max()) + spare
    near = max(near, 1e-3 * float(np.linalg.norm(position - focus)))
    plain = [tuple(map(float, vector)) for vector in vectors]
    return View(size, *plain, height, parallel, near, max(far, 1.1 * near))
