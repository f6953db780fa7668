"""Compiles the kernels of scenes ahead, each in a process of its own.

    python -m mpmcli.simulation.warm SCENE '{"arch": "cpu", "threads": null}'

is such a process; it ends with its parent.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mpmcli.processes.questions import Question, answering, ask_as_ended, end_with_parent, module_command

# Time limit of a process, s.
TIMEOUT = 1800.0
# No step of a scene is as small, s: it compiles, and computes nothing worth keeping.
NO_STEP = 1e-12


@dataclass(frozen=True)
class Warmed:
    """The outcome of a process.

    Attributes:
        stored: whether a stored kernel was found; seconds: of wall time.
        fault: why there is no outcome, "" if there is one.
    """

    scene: Path
    stored: bool = False
    seconds: float = 0.0
    fault: str = ""


def warm(
    scenes: Sequence[Path],
    at_once: int,
    arch: str = "auto",
    threads: int | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[Warmed]:
    """Take a step of each scene in a process of its own, and yield outcomes as they end."""
    asked = json.dumps({"arch": arch, "threads": threads})
    command = module_command("mpmcli.simulation.warm")
    questions = (Question([*command, str(path), asked], TIMEOUT, follows=True) for path in scenes)
    for number, reply in ask_as_ended(questions, at_once, stop):
        if reply.fault:
            last = (reply.complaint.splitlines() or [""])[-1]
            yield Warmed(scenes[number], fault=f"the process {reply.fault}. {last}".rstrip())
        else:
            yield Warmed(scenes[number], **reply.answer)


def main() -> None:
    from mpmcli.materials.registry import parameter_models
    from mpmcli.scene import load_scene
    from mpmcli.simulation.engine import backend_for
    from mpmcli.solver.engine.build import build_run
    from mpmcli.solver.machine.backend import start, stop_backend

    began = time.perf_counter()
    path, asked = Path(sys.argv[1]), json.loads(sys.argv[2])
    end_with_parent()
    with answering() as answer:
        scene = load_scene(path, laws=parameter_models()).scene
        backend = backend_for(scene, asked["arch"], asked["threads"])
        start(backend)
        run = build_run(scene, backend)
        run.step(NO_STEP)
        stored = backend.on_cpu and run.batch.launch_cpu.stored
        stop_backend()
        answer(stored=stored, seconds=time.perf_counter() - began)


if __name__ == "__main__":
    main()
