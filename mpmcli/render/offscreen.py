"""An off-screen window, reused for all frames of a film: one rendering gives colours and depths."""

import weakref
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkDataArray, vtkFloatArray, vtkUnsignedCharArray

from mpmcli.render.render_scene import RenderScene
from mpmcli.render.settings import Theme
from mpmcli.render.view import View, corners_of

if TYPE_CHECKING:
    import pyvista as pv

# Position of the light in the axes of a camera: to the right, up, and towards the viewer.
LAMP = np.array([-0.6, 0.9, 1.6])


class OffscreenRenderer:
    """A window of the size of a view; `samples` of its pixels along each axis are averaged to one."""

    def __init__(self, view: View, theme: Theme, *, samples: int = 1) -> None:
        """Open the window, which is closed with this object."""
        import pyvista as pv

        self.view, self.samples, self._theme = view, samples, theme
        width, height = view.size
        self.plotter = pv.Plotter(off_screen=True, window_size=(width * samples, height * samples), lighting="none")
        self.plotter.render_window.SetMultiSamples(0)
        self._corners = 0, 0, width * samples - 1, height * samples - 1
        self.plotter.background_color = theme.ground
        self.plotter.disable_anti_aliasing()
        # PyVista keeps every plotter that is not closed.
        weakref.finalize(self, self.plotter.close).atexit = False
        view.place(self.plotter)

    def add_box(self, scene: RenderScene, width: float = 1.5) -> None:
        """Draw the edges of the domain except the three in front, which would cross its contents."""
        if not self.view.edges:
            return
        import pyvista as pv

        corners, color = corners_of(scene), self._theme.wall
        front = int((corners @ self.view.axes[2]).argmax())
        edges = [(i, i | 1 << axis) for i in range(8) for axis in range(3) if not i >> axis & 1]
        lines = [[2, *edge] for edge in edges if front not in edge]
        box = pv.PolyData(corners, lines=np.array(lines).ravel())
        self.plotter.add_mesh(box, color=color, line_width=width * self.samples, lighting=False, reset_camera=False)

    def add_dots(self, cloud: "pv.PolyData", *, lit: bool = True) -> "pv.Actor":
        """Draw points as round dots, in the exact colours "rgb" of the cloud unless lit."""
        return self.plotter.add_points(
            cloud,
            scalars="rgb",
            rgb=True,
            render_points_as_spheres=True,
            lighting=lit,
            ambient=0.45 if lit else 1.0,
            diffuse=0.65 if lit else 0.0,
            specular=0.0,
            reset_camera=False,
        )

    def add_light(self) -> None:
        """Add a light above and to the left of the camera; for several cameras one in the scene, and one opposite."""
        import pyvista as pv

        lamps = self.view.lamps
        for place, intensity in ((LAMP, 1.0), (LAMP * [-1.0, 1.0, -1.0], 0.6))[: 2 if lamps else 1]:
            light = pv.Light(light_type="scene light" if lamps else "camera light", intensity=intensity)
            light.position, light.focal_point = tuple(place @ lamps.axes if lamps else place), (0.0, 0.0, 0.0)
            self.plotter.add_light(light)

    def render(self) -> None:
        """Render the window for `picture` and `depth`."""
        if self.plotter.render_window.GetNeverRendered():
            # The first picture of a window lacks settings that plotters make when they are first shown.
            self.view.place(self.plotter)
            self.plotter.show(auto_close=False)
        self.view.place(self.plotter)
        self.plotter.render_window.Render()

    def picture(self) -> np.ndarray:
        """Return the rows from the top, (h, w, 3) uint8, averaged over the samples of each pixel."""
        return np.array(Image.fromarray(self.pixels()).reduce(self.samples))

    def pixels(self) -> np.ndarray:
        """Return the pixels of the window, rows from the top, (h, w, 3) uint8."""
        array = vtkUnsignedCharArray()
        self.plotter.render_window.GetPixelData(*self._corners, 0, array, 0)
        return self._rows(array)

    def depth(self) -> np.ndarray:
        """Return the distance of each sample from the camera, (h, w) float32, m; inf for the background."""
        array = vtkFloatArray()
        self.plotter.render_window.GetZbufferData(*self._corners, array)
        z = self._rows(array)[..., 0]
        near, far = self.plotter.camera.clipping_range
        span = far - near
        distance = near + z * span if self.view.parallel else near * far / (far - z * span)
        return np.where(z >= 1.0, np.float32(np.inf), distance.astype(np.float32))

    def _rows(self, array: vtkDataArray) -> np.ndarray:
        return vtk_to_numpy(array).reshape(self._corners[3] + 1, self._corners[2] + 1, -1)[::-1]
