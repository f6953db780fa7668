"""The choice of an OpenGL window that draws without a screen, tried in a separate process first.

VTK takes a window at its first picture, and where the libraries of that window are missing it ends the interpreter by
SIGSEGV, which no `except` catches. So each window is tried in a process of its own before this one opens any. That
takes half a second, which is less than the risk of remembering an answer that a change of drivers has made wrong; but
an environment variable passes the answer to child processes.
"""

import importlib.metadata
import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

from mpmcli.errors import InputError
from mpmcli.processes.questions import Question, ask, module_command
from mpmcli.render.window_probe import NO_VTK

# Environment variable from which VTK reads the class of its windows.
SETTING = "VTK_DEFAULT_OPENGL_WINDOW"
# Environment variable with the window that the parent process has chosen, as JSON.
HANDED_DOWN = "MPMCLI_OPENGL_WINDOW"
EGL, OSMESA, X = "vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow", "vtkXOpenGLRenderWindow"
# Seconds; loading VTK from a cold disk can take most of them.
TIMEOUT = 120.0
# The first version of VTK whose wheel draws without a screen.
OLDEST_WITHOUT_SCREEN = (9, 4)


@dataclass(frozen=True)
class Window:
    """A window that is known to draw.

    Attributes:
        setting: what VTK_DEFAULT_OPENGL_WINDOW says, "" where VTK is left to choose.
        name: the class that came, such as "vtkEGLRenderWindow".
        renderer: what OpenGL calls the device, such as "llvmpipe (LLVM 15.0.6, 256 bits)".
        version: of OpenGL, in the driver's words.
    """

    setting: str
    name: str
    renderer: str
    version: str


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
    DISPLAY. To be called before the first window is opened; the first call takes about half a second.

    Raises:
        InputError: none draws.
    """
    global _chosen
    if _chosen is None:
        _chosen = _handed_down() or _find()
    return _chosen.name


def try_windows(timeout: float = TIMEOUT) -> Iterator[Attempt]:
    """Try each window that may do, in a process of its own with a time limit, and stop at the first that draws."""
    command = module_command("mpmcli.render.window_probe")
    given = users_setting()
    for setting in [given] if given else _candidates():
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
    version = _vtk_version()
    if version and version < OLDEST_WITHOUT_SCREEN:
        wanted, here = (".".join(map(str, numbers)) for numbers in (OLDEST_WITHOUT_SCREEN, version))
        return f'VTK {here} needs a screen; update it by `python -m pip install "vtk>={wanted}"`'
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


def _candidates() -> list[str]:
    if sys.platform != "linux":
        return [""]
    return [EGL, OSMESA, *([X] if os.environ.get("DISPLAY") else [])]


def _vtk_version() -> tuple[int, int] | None:
    try:
        major, minor = importlib.metadata.version("vtk").split(".")[:2]
        return int(major), int(minor)
    except (importlib.metadata.PackageNotFoundError, ValueError):
        return None
