"""Progress on stderr: a bar on a terminal, lines elsewhere, and no end of the work when nobody reads along."""

import io
import sys

import pytest

from mpmcli.cli.progress import ProgressBar


class ClosedPipe(io.StringIO):
    """A stream whose reader has gone away."""

    def write(self, text: str) -> int:
        raise BrokenPipeError


def test_lines_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressBar(12, "frames", quiet=False, pause=0.0) as bar:
        bar.say("a note [bold] of a name that rich would take for markup")
        bar.show(3, "frame 7", ", 2 s left")
        bar.show(4)
        assert not bar.drawn
    stdout, stderr = capsys.readouterr()
    assert stdout == ""
    assert stderr.splitlines() == [
        "a note [bold] of a name that rich would take for markup",
        "3/12 frames: frame 7, 2 s left",
        "4/12 frames",
    ]


def test_a_bar_on_a_terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes the stream for a terminal
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with ProgressBar(12, "frames", quiet=False, pause=0.0) as bar:
        bar.show(3, "frame [7]", ", 2 s left")
        assert bar.drawn
        bar.say("a note")
    drawn = capsys.readouterr().err
    assert "3/12 frames" in drawn and "frame [7]" in drawn and "a note\n" in drawn
    assert "2 s left" not in drawn  # the bar has its own


def test_quiet_is_quiet_and_lines_come_now_and_then_only(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with ProgressBar(12, "frames", quiet=False, pause=1e9) as bar:
        bar.show(3)
    monkeypatch.setenv("FORCE_COLOR", "1")
    with ProgressBar(12, "frames", quiet=True, pause=0.0) as bar:
        bar.show(3)
        bar.say("a note")
    assert capsys.readouterr().err == ""


def test_the_work_goes_on_when_nobody_reads_along(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", ClosedPipe())
    with ProgressBar(12, "frames", quiet=False, pause=0.0) as bar:
        bar.show(3)
        bar.say("a note")
        bar.show(12)
