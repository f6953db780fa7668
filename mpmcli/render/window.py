"""The choice of an OpenGL window that draws without a screen, tried in a separate process first.

VTK takes a window at its first picture, and where the libraries of that window are missing it ends the interpreter by
SIGSEGV, which no `except` catches. So each window is tried in a process of its own before this one opens any. That
takes half a second, which is less than the risk of remembering an answer that a change of drivers has made wrong; but
an environment variable passes the answer to child processes. That process is `python -m mpmcli.render.window [CLASS]`.
"""

import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

from mpmcli.errors import InputError
from mpmcli.processes.questions import Question, answering, ask, module_command

SETTING = "VTK_DEFAULT_OPENGL_WINDOW"  # environment variable from which VTK reads the class of its windows
HANDED_DOWN = "MPMCLI_OPENGL_WINDOW"  # environment variable with the window that the parent process has chosen, as JSON
EGL, OSMESA, X = "vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow", "vtkXOpenGLRenderWindow"
TIMEOUT = 120.0  # seconds; loading VTK from a cold disk can take most of them
# The picture that is tried: sides of the picture and of the point, pixels, and the colours of the point and behind it.
SIZE, POINT_SIZE = 32, 9
RED, BLUE = (255, 0, 0), (0, 0, 255)
COLOR_TOLERANCE = 8  # a device may round; nothing that draws this point in this colour is further off
NO_VTK = "VTK cannot be loaded"


@dataclass(frozen=True)
class Window:
    """A window that is known to draw."""

    setting: str  # what VTK_DEFAULT_OPENGL_WINDOW says, "" where VTK is left to choose
    name: str  # the class that came, such as "vtkEGLRenderWindow"
    renderer: str  # what OpenGL calls the device, such as "llvmpipe (LLVM 15.0.6, 256 bits)"
    version: str  # of OpenGL, in the driver's words


@dataclass(frozen=True)
class Attempt:
    """One class that was tried: the window that came of it, or why there is none."""

    setting: str
    window: Window | None
    reason: str = ""


_chosen: Window | None = None


def choose_window() -> str:
    """Return the class of window that VTK draws with off screen, from now on, here and in processes started here.

    The user's VTK_DEFAULT_OPENGL_WINDOW is kept. Otherwise EGL comes first, then OSMesa, then X where there is a
    DISPLAY. To be called before the first window is opened; the first call takes half a second.

    Raises:
        InputError: none draws.
    """
    global _chosen
    if _chosen is None:
        _chosen = _handed_down() or _find()
    return _chosen.name


def try_windows(timeout: float = TIMEOUT) -> Iterator[Attempt]:
    """Try each window that may do, in a process of its own with a time limit, and stop at the first that draws."""
    command = module_command("mpmcli.render.window")
    given = users_setting()
    candidates = [EGL, OSMESA, *([X] if os.environ.get("DISPLAY") else [])] if sys.platform == "linux" else [""]
    for setting in [given] if given else candidates:
        # VTK may map the class to another one; each of ours is tried in turn.
        wanted = [] if given or not setting else [setting]
        reply = ask(Question([*command, *wanted], timeout, {SETTING: setting or None}))
        answer = reply.answer
        if "window" in answer and not reply.fault:
            named = {key: str(answer.get(key, "")) for key in ("renderer", "version")}
            yield Attempt(setting, Window(setting, str(answer["window"]), **named))
            return
        # An answer before a crash has no meaning.
        yield Attempt(setting, None, reply.fault or str(answer.get("problem", "gave no answer")))


def users_setting() -> str:
    """Return the class that the user set, "" for none; VTK opens no window for an empty one."""
    return os.environ.get(SETTING, "").strip()


def why_none(attempts: Sequence[Attempt]) -> str:
    """Return the reasons, by class."""
    return ", ".join(f"{attempt.setting or 'the default'}: {attempt.reason}" for attempt in attempts)


def remedy(attempts: Sequence[Attempt]) -> str:
    """Return what the user can do so that a window opens."""
    if any(NO_VTK in attempt.reason for attempt in attempts):
        return "install it again by `python -m pip install --force-reinstall vtk`"
    if users_setting():
        return f"unset {SETTING}, so that a window is looked for"
    if sys.platform != "linux":
        return "install a graphics driver with OpenGL 3.2 or newer"
    return (
        "install Mesa's software renderer, on Debian and Ubuntu by `apt-get install libegl1 libgl1-mesa-dri` "
        "or `libosmesa6`"
    )


def _handed_down() -> Window | None:
    try:
        window = Window(**json.loads(os.environ.get(HANDED_DOWN, "")))
    except (ValueError, TypeError):
        return None
    return window if window.setting == users_setting() else None


def _find() -> Window:
    attempts = list(try_windows())
    window = attempts[-1].window
    if window is None:
        raise InputError(
            f"nothing can be drawn here, since no OpenGL window opens ({why_none(attempts)}): {remedy(attempts)}; "
            "`mpmcli doctor` says more."
        )
    if window.setting:
        os.environ[SETTING] = window.setting
    else:
        os.environ.pop(SETTING, None)
    os.environ[HANDED_DOWN] = json.dumps(asdict(window))
    return window


def draw_point(wanted: str | None) -> dict[str, str]:
    """Draw a red point on blue, and return what window and device drew it, or what is wrong.

    It answers {"window": class that came, "renderer": ..., "version": ...}, of OpenGL, or {"problem": "a sentence"};
    also where another class than the `wanted` one came.
    """
    try:
        import vtkmodules.vtkRenderingOpenGL2  # noqa: F401 (brings the classes that draw)
        from vtkmodules.vtkFiltersSources import vtkPointSource
        from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper, vtkRenderer, vtkRenderWindow
    except ImportError as error:
        return {"problem": f"{NO_VTK} ({error})"}
    window = vtkRenderWindow()
    came = window.GetClassName()
    # Where none opens VTK hands out one that crashes as soon as it draws.
    if wanted is not None and came != wanted:
        return {"problem": "does not open"}
    cloud, mapper, actor, renderer = vtkPointSource(), vtkPolyDataMapper(), vtkActor(), vtkRenderer()
    cloud.SetNumberOfPoints(1)
    cloud.SetRadius(0.0)
    mapper.SetInputConnection(cloud.GetOutputPort())
    actor.SetMapper(mapper)
    actor.GetProperty().SetPointSize(POINT_SIZE)
    actor.GetProperty().SetColor(1.0, 0.0, 0.0)
    actor.GetProperty().LightingOff()
    renderer.SetBackground(0.0, 0.0, 1.0)
    renderer.AddActor(actor)
    renderer.ResetCamera(-1.0, 1.0, -1.0, 1.0, -1.0, 1.0)
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(0)
    window.SetSize(SIZE, SIZE)
    window.AddRenderer(renderer)
    window.Render()
    problem = picture_problem(_pixel(window, SIZE // 2), _pixel(window, 1))
    if problem:
        return {"problem": problem}
    facts = dict(line.split(" string:", 1) for line in window.ReportCapabilities().splitlines() if " string:" in line)
    return {"window": came, **{name: facts.get(f"OpenGL {name}", "").strip() for name in ("renderer", "version")}}


def picture_problem(middle: tuple[int, ...], corner: tuple[int, ...]) -> str:
    """Return what is wrong with the colours, 0 to 255, of the point and of its background; "" for nothing."""
    for color, wanted in ((middle, RED), (corner, BLUE)):
        if len(color) != 3 or any(abs(a - b) > COLOR_TOLERANCE for a, b in zip(color, wanted, strict=True)):
            return f"draws {middle} on {corner} instead of {RED} on {BLUE}"
    return ""


def _pixel(window: object, place: int) -> tuple[int, ...]:
    from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

    values = vtkUnsignedCharArray()
    window.GetPixelData(place, place, place, place, 0, values, 0)
    return tuple(int(values.GetValue(channel)) for channel in range(values.GetNumberOfValues()))


if __name__ == "__main__":
    with answering() as answer:
        answer(**draw_point(sys.argv[1] if len(sys.argv) > 1 else None))
