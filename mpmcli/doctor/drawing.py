"""Examines graphics libraries: VTK and its window, PyVista, pysplashsurf, matplotlib, Pillow."""

import importlib.metadata

from mpmcli.doctor.probe_result import ProbeResult


def vtk() -> ProbeResult:
    """Examine VTK by drawing. A missing window may abort the process, so each window is tried in a separate one."""
    from vtkmodules.vtkCommonCore import vtkVersion

    from mpmcli.render.window import remedy, try_windows, why_none

    version = vtkVersion.GetVTKVersion()
    attempts = list(try_windows())
    window = attempts[-1].window
    if window is None:
        return ProbeResult("missing", f"{version}, no OpenGL window opens ({why_none(attempts)})", remedy(attempts))
    return ProbeResult("ok", f"{version}, {window.name} on {window.renderer}, OpenGL {window.version}")


def pyvista() -> ProbeResult:
    """Examine PyVista by importing it."""
    import pyvista

    return ProbeResult("ok", pyvista.__version__)


def pysplashsurf() -> ProbeResult:
    """Examine pysplashsurf by reconstructing the surface of a cube of particles."""
    import numpy as np
    import pysplashsurf

    axis = np.arange(4, dtype=np.float32)
    cube = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    surface, _ = pysplashsurf.reconstruction_pipeline(
        cube, particle_radius=0.5, smoothing_length=2.0, cube_size=1.0, iso_surface_threshold=0.6
    )
    version = importlib.metadata.version("pysplashsurf")
    if not surface.ncells:
        return ProbeResult("broken", f"{version}, finds no surface around a cube of particles")
    return ProbeResult("ok", version)


def matplotlib() -> ProbeResult:
    """Examine matplotlib by importing it."""
    import matplotlib

    return ProbeResult("ok", matplotlib.__version__)


def pillow() -> ProbeResult:
    """Examine Pillow by drawing a letter."""
    import PIL
    from PIL import Image, ImageDraw

    ImageDraw.Draw(Image.new("RGB", (16, 16))).text((0, 0), "a")
    return ProbeResult("ok", PIL.__version__)
