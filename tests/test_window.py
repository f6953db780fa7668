"""The window that draws without a screen: tried where a crash does no harm, chosen in order, told to children."""

import ctypes.util
import json
import os
import sys
from collections.abc import Callable

import pytest
from asked_process import CRASH, HANG, answering, running

from mpmcli.errors import InputError
from mpmcli.render import window
from mpmcli.render.window import (
    BLUE,
    EGL,
    HANDED_DOWN,
    OSMESA,
    RED,
    SETTING,
    X,
    choose_window,
    picture_problem,
    try_windows,
)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere VTK has one window, and no choice")

DREW = answering('{"window": "vtkFakeWindow", "renderer": "a pencil", "version": "4.5"}')
BLACK = answering('{"problem": "draws (0, 0, 0) on (0, 0, 0)"}')


@pytest.fixture(autouse=True)
def fresh(monkeypatch) -> None:
    """A process that has not chosen, where nobody has said anything; what it chooses is forgotten after the test."""
    monkeypatch.setattr(window, "_chosen", None)
    for name in (SETTING, HANDED_DOWN, "DISPLAY"):
        # Set and taken away, so that it is taken away again.
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


@pytest.fixture
def probe(monkeypatch) -> Callable[[str], None]:
    """Return `put(code)`, which lets code run where the window would be tried."""

    def put(code: str) -> None:
        monkeypatch.setattr(window, "module_command", lambda module: running(code))

    return put


def drawing_with(*settings: str) -> str:
    """Return code that draws with these classes, and otherwise crashes as VTK does."""
    return f"import os\nif os.environ.get({SETTING!r}) not in {settings!r}:\n    os.kill(os.getpid(), 11)\n" + DREW


def test_egl_comes_first(probe):
    probe(drawing_with(EGL, OSMESA, X))
    assert choose_window() == "vtkFakeWindow"
    assert os.environ[SETTING] == EGL


def test_osmesa_comes_where_egl_crashes(probe):
    probe(drawing_with(OSMESA))
    choose_window()
    assert os.environ[SETTING] == OSMESA


def test_x_comes_last_and_only_with_a_display(probe, monkeypatch):
    probe(drawing_with(X))
    with pytest.raises(InputError):
        choose_window()
    assert SETTING not in os.environ
    monkeypatch.setenv("DISPLAY", ":0")
    choose_window()
    assert os.environ[SETTING] == X


@pytest.mark.parametrize(
    ("code", "timeout", "reason"),
    [
        (CRASH, 60.0, "died by SIGSEGV"),
        (HANG, 0.3, "took longer than 0.3 s"),
        (BLACK, 60.0, "draws (0, 0, 0) on (0, 0, 0)"),
        ("raise SystemExit(1)", 60.0, "exited with 1"),
        # Whoever crashes at the end would crash in a run, too.
        (DREW.replace(")\n", ", flush=True)\n") + CRASH, 60.0, "died by SIGSEGV"),
    ],
)
def test_what_does_not_draw_is_not_taken_and_says_why(probe, code, timeout, reason):
    probe(code)
    assert [(attempt.setting, attempt.window, attempt.reason) for attempt in try_windows(timeout)] == [
        (EGL, None, reason),
        (OSMESA, None, reason),
    ]


def test_none_is_one_sentence_with_the_packages(probe):
    probe(CRASH)
    with pytest.raises(InputError) as refusal:
        choose_window()
    assert refusal.value.exit_code == 2
    assert str(refusal.value) == (
        "nothing can be drawn here, since no OpenGL window opens (vtkEGLRenderWindow: died by SIGSEGV, "
        "vtkOSOpenGLRenderWindow: died by SIGSEGV): install Mesa's software renderer, on Debian and Ubuntu by "
        "`apt-get install libegl1 libgl1-mesa-dri` or `libosmesa6`; `mpmcli doctor` says more."
    )


def test_what_the_user_wants_is_kept_and_alone_tried(probe, monkeypatch):
    monkeypatch.setenv(SETTING, "vtkMine")
    # No class has to come: VTK may have another one for it.
    probe("import sys\nassert len(sys.argv) == 1\n" + drawing_with("vtkMine"))
    assert choose_window() == "vtkFakeWindow"
    assert os.environ[SETTING] == "vtkMine"


def test_what_the_user_wants_in_vain_is_said(probe, monkeypatch):
    monkeypatch.setenv(SETTING, "nonsense")
    probe(drawing_with(EGL))
    with pytest.raises(InputError, match=rf"\(nonsense: died by SIGSEGV\): unset {SETTING}"):
        choose_window()


def test_an_empty_wish_is_none(probe, monkeypatch):
    """With an empty class VTK opens no window at all."""
    monkeypatch.setenv(SETTING, "")
    probe(drawing_with(EGL))
    choose_window()
    assert os.environ[SETTING] == EGL


def test_one_process_tries_once_and_its_children_not_at_all(probe, monkeypatch):
    probe(drawing_with(OSMESA))
    choose_window()
    probe(CRASH)
    assert choose_window() == "vtkFakeWindow"
    monkeypatch.setattr(window, "_chosen", None)
    assert choose_window() == "vtkFakeWindow"
    # A child for which another class is set has to appearance for itself.
    monkeypatch.setattr(window, "_chosen", None)
    monkeypatch.setenv(SETTING, EGL)
    with pytest.raises(InputError):
        choose_window()


@pytest.mark.parametrize("told", ["", "yes", "[1]", '{"setting": "vtkEGLRenderWindow"}', '{"color": "red"}'])
def test_what_was_not_told_by_us_is_not_believed(probe, monkeypatch, told):
    monkeypatch.setenv(HANDED_DOWN, told)
    monkeypatch.setenv(SETTING, EGL)
    probe(CRASH)
    with pytest.raises(InputError):
        choose_window()


def test_only_the_picture_that_was_asked_for_is_right():
    assert picture_problem(RED, BLUE) == ""
    assert picture_problem((250, 3, 0), BLUE) == ""
    for middle, corner in [((0, 0, 0), (0, 0, 0)), (BLUE, BLUE), (RED, RED), ((), ()), ((255, 255, 255), BLUE)]:
        assert picture_problem(middle, corner).startswith("draws ")


def test_the_real_window_draws_here_and_in_a_child(run_python):
    """The program that chooses draws with VTK afterwards, and its child, which may not try, chooses the same."""
    child = "from mpmcli.render import window\nwindow.ask = None\nprint(window.choose_window())\n"
    code = (
        "import json, subprocess, sys\n"
        "from mpmcli.errors import InputError\n"
        "from mpmcli.render.window import choose_window\n"
        "from mpmcli.render.window import draw_point\n"
        "try:\n"
        "    chosen = choose_window()\n"
        "except InputError as error:\n"
        "    print(json.dumps({'none': str(error)}))\n"
        "    sys.exit()\n"
        "assert 'vtkmodules' not in sys.modules\n"
        f"child = subprocess.run([sys.executable, '-c', {child!r}], capture_output=True, text=True, check=True)\n"
        "print(json.dumps({'chosen': chosen, 'child': child.stdout.strip(), 'drew': draw_point(chosen)}))\n"
    )
    done = run_python(code)
    answer = json.loads(done.stdout)
    if "none" in answer:
        pytest.skip(answer["none"])
    assert answer["child"] == answer["chosen"] == answer["drew"]["window"]
    assert answer["drew"]["renderer"]
    assert done.stderr == ""


def test_without_its_libraries_the_real_one_harms_nobody(monkeypatch, tmp_path, capfd):
    """With EGL's drivers hidden VTK dies as on a bare machine, in another process; unless OSMesa is here."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", str(tmp_path / "none.json"))
    monkeypatch.chdir(tmp_path)
    attempts = list(try_windows())
    assert attempts[0].setting == EGL
    if attempts[0].window is not None:
        pytest.skip("EGL of this machine does not ask which drivers there are")
    if ctypes.util.find_library("OSMesa"):
        assert attempts[1].window.name == OSMESA
    else:
        assert len(attempts) == 2
        assert {attempt.reason for attempt in attempts} <= {"does not open", "died by SIGSEGV"}
    assert not list(tmp_path.iterdir()), "a core was left"
    assert capfd.readouterr() == ("", "")
