"""An off-screen window, reused for all frames of a film: one rendering gives colours and depths."""

from typing import TYPE_CHECKING

import numpy as np

from mpmcli.render.theme import Theme
from mpmcli.render.view import View

if TYPE_CHECKING:
    from vtkmodules.vtkRenderingCore import vtkRenderWindow

# Edges of the domain, as pairs of its corners; bit i of a corner's number is its side along axis i.
EDGES = [(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1]


class OffscreenRenderer:
    """A window of the size of a view, with the edges of the domain in it.

    Args:
        samples: pixels along each axis that are averaged to one.
    """

    def __init__(self, view: View, theme: Theme, *, samples: int = 1) -> None:
        import pyvista as pv

        self.view = view
        self.samples = samples
        width, height = view.size
        self.plotter = pv.Plotter(off_screen=True, window_size=(width * samples, height * samples), lighting="none")
        self.plotter.render_window.SetMultiSamples(0)
        self.plotter.background_color = theme.ground
        self.plotter.disable_anti_aliasing()
        view.place(self.plotter)

    def add_box(self, lower: tuple[float, ...], upper: tuple[float, ...], color: str, width: float = 1.5) -> None:
        """Draw the edges of the domain."""
        import pyvista as pv

        low, high = np.array(lower), np.array(upper)
        corners = np.array([[high[i] if a >> i & 1 else low[i] for i in range(3)] for a in range(8)])
        cells = np.array([(2, a, b) for a, b in EDGES]).ravel()
        box = pv.PolyData(corners, lines=cells)
        self.plotter.add_mesh(box, color=color, line_width=width * self.samples, lighting=False, reset_camera=False)

    def add_light(self) -> None:
        """Light the scene from over the left shoulder of the camera."""
        import pyvista as pv

        light = pv.Light(light_type="camera light", intensity=1.0)
        light.position, light.focal_point = (-0.6, 0.9, 1.6), (0.0, 0.0, 0.0)
        self.plotter.add_light(light)

    def render(self) -> None:
        """Render the window, for `picture` and `depth` to read."""
        self.view.place(self.plotter)
        if self.plotter.render_window.GetNeverRendered():
            # The first picture of a window is drawn without what plotters set up when they are first shown.
            self.plotter.show(auto_close=False)
            self.view.place(self.plotter)
        self.plotter.render_window.Render()

    def picture(self) -> np.ndarray:
        """Return the rows from the top, (h, w, 3) uint8, averaged over the samples of each pixel."""
        return averaged(window_pixels(self.plotter.render_window), self.samples)

    def depth(self) -> np.ndarray:
        """Return the distance of each sample from the camera, (h, w) float32, m; inf where nothing is drawn."""
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkCommonCore import vtkFloatArray

        width, height = (length * self.samples for length in self.view.size)
        array = vtkFloatArray()
        self.plotter.render_window.GetZbufferData(0, 0, width - 1, height - 1, array)
        z = vtk_to_numpy(array).reshape(height, width)[::-1]
        near, far = self.plotter.camera.clipping_range
        span = far - near
        distance = near + z * span if self.view.parallel else near * far / (far - z * span)
        return np.where(z >= 1.0, np.float32(np.inf), distance.astype(np.float32))

    def close(self) -> None:
        """Release the window."""
        self.plotter.close()


def window_pixels(window: "vtkRenderWindow") -> np.ndarray:
    """Return the pixels of a window, rows from the top, (h, w, 3) uint8."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

    width, height = window.GetSize()
    array = vtkUnsignedCharArray()
    window.GetPixelData(0, 0, width - 1, height - 1, 0, array, 0)
    return vtk_to_numpy(array).reshape(height, width, 3)[::-1]


def averaged(image: np.ndarray, step: int) -> np.ndarray:
    """Return the means over blocks of `step` by `step` pixels, (h, w, 3) uint8."""
    if step == 1:
        return np.ascontiguousarray(image)
    height, width = (length // step for length in image.shape[:2])
    total = np.zeros((height, width, 3), np.uint16)
    for i in range(step):
        for j in range(step):
            total += image[i::step, j::step]
    return ((total + step * step // 2) // (step * step)).astype(np.uint8)
