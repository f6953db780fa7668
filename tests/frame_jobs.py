"""Jobs for the tests of rendering in several processes: they write small files, and fail in all ways."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpmcli.errors import InputError, RunError
from mpmcli.output.durable import sealed


@dataclass(frozen=True)
class WritingJob:
    """Writes a file of each frame and returns facts about its process; does `trouble` at frame `at`."""

    folder: Path
    trouble: str = ""
    at: int = 3

    def start(self) -> Callable[[int], Any]:
        if self.trouble == "start":
            raise InputError("There is no GL.")
        (self.folder / f"process_{os.getpid()}").write_text("x", encoding="utf-8")
        return self._render

    def _render(self, k: int) -> Any:
        # Libraries print where they like.
        print("rendering", k, flush=True)
        os.write(1, b"noise\n")
        while self.trouble == "alone" and k == self.at and len(list(self.folder.glob("process_*"))) < 2:
            time.sleep(0.02)
        if k == self.at and self.trouble not in ("", "alone"):
            return self._fail()
        (self.folder / f"frame_{k}").write_text(str(k), encoding="utf-8")
        return {
            "square": k * k,
            "process": os.getpid(),
            "ctrl_c": signal.getsignal(signal.SIGINT) == signal.SIG_IGN,
            "threads": os.environ.get("LP_NUM_THREADS"),
        }

    def _fail(self) -> Any:
        match self.trouble:
            case "input":
                raise InputError("Frame 3 is damaged.")
            case "run":
                raise RunError("The disk is full.")
            case "fault":
                raise KeyError("nothing")
            case "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            case "exit":
                os._exit(7)
            case "sleep" | "deaf":
                if self.trouble == "deaf":
                    signal.signal(signal.SIGTERM, signal.SIG_IGN)
                with sealed(self.folder / "unfinished") as temporary:
                    temporary.write_text("x", encoding="utf-8")
                    time.sleep(60)
