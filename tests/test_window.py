"""The window that draws without a screen."""

import json
import os
import sys

import pytest

from mpmcli.render.window import EGL, SETTING

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere VTK has one window, and no choice")

CODE = """
import json, os
from mpmcli.errors import InputError
from mpmcli.render.window import SETTING, choose_window
try:
    print(json.dumps([choose_window(), os.environ[SETTING]]))
except InputError as error:
    print(json.dumps([str(error), error.exit_code]))
"""


@pytest.fixture(autouse=True)
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """No choice of the user's, and no screen."""
    for name in (SETTING, "DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def test_egl_draws_here(run_python, drawing: str) -> None:
    """Also where the variable is set and empty, with which VTK opens no window; nothing is said."""
    for given in (None, ""):
        if given is not None:
            os.environ[SETTING] = given
        done = run_python(CODE)
        assert json.loads(done.stdout) == [drawing, EGL]
        assert done.stderr == ""


@pytest.mark.parametrize("given", ["", "vtkMine"])
def test_without_its_libraries_nothing_is_drawn(run_python, monkeypatch, tmp_path, given: str) -> None:
    """With EGL's drivers hidden there is one sentence, and no crash at the first picture."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", str(tmp_path / "none.json"))
    monkeypatch.setenv(SETTING, given)
    done = run_python(CODE)
    answer, code = json.loads(done.stdout)
    if not answer.startswith("nothing can be drawn here"):
        pytest.skip("EGL of this machine does not ask which drivers there are, or OSMesa is here")
    assert code == 2 and done.stderr == ""
    assert (f"unset {SETTING}" if given else "apt-get install libegl1") in answer
