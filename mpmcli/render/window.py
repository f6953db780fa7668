"""Selects the OpenGL window class for VTK's off-screen drawing."""

import ctypes
import os
import sys

from mpmcli.errors import InputError

# Environment variable from which VTK reads the class of its windows.
SETTING = "VTK_DEFAULT_OPENGL_WINDOW"
# VTK falls back to the second if the first is not available, and ends the process at the first picture if its library
# is missing.
EGL, OSMESA = "vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow"
OSMESA_LIBRARIES = ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")


def choose_window() -> str:
    """Return the class of VTK's off-screen window, for this process and its children.

    The user's VTK_DEFAULT_OPENGL_WINDOW is kept. Otherwise it is EGL on Linux, or OSMesa if EGL does not work.
    InputError: no window opens.
    """
    given = os.environ.get(SETTING, "").strip()
    if sys.platform == "linux":
        os.environ[SETTING] = given or EGL
    import vtkmodules.vtkRenderingOpenGL2  # noqa: F401 (brings the classes that draw)
    from vtkmodules.vtkCommonCore import vtkLogger
    from vtkmodules.vtkRenderingCore import vtkRenderWindow

    said = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    name = vtkRenderWindow().GetClassName()
    vtkLogger.SetStderrVerbosity(said)
    if name == OSMESA and not any(map(_loads, OSMESA_LIBRARIES)):
        remedy = "install Mesa's software renderer, on Debian and Ubuntu by `apt-get install libegl1 libgl1-mesa-dri`"
        remedy = f"unset {SETTING}" if given else remedy
        raise InputError(f"nothing can be drawn here, since no OpenGL window opens: {remedy}.")
    return name


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
