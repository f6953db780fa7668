"""Carries out many tasks of one job, such as the frames of a film, in several processes at once."""

import os
import pickle
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import IO, Any, Protocol

from mpmcli.cores import available_cores
from mpmcli.errors import MpmcliError, RunError

# Seconds between two looks at whether to stop.
PAUSE = 0.05
# Seconds in which a process may clean up before it is killed.
GRACE = 2.0
# Lines of stderr that are quoted on failure.
QUOTED = 2
# How many threads the software renderer, numpy, splashsurf and VTK take.
THREADS = (
    "LP_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "RAYON_NUM_THREADS",
    "VTK_SMP_MAX_THREADS",
)
CODE = "import sys; sys.path[:] = {path!r}\nfrom mpmcli.processes.pool import serve; serve()"


class Job(Protocol):
    """What is rendered: of a module that can be imported, since it is pickled."""

    def start(self) -> Callable[[int], Any]:
        """Return what renders one frame and writes it; called once in each process."""
        ...


def render_frames(
    job: Job,
    ks: Sequence[int],
    workers: int,
    *,
    watch: Callable[[int, Any], None] = lambda k, outcome: None,
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Render frames, in this process where one is asked for or one frame is left, and otherwise in others.

    The processes share the cores: each gets its part in the variables of THREADS that the environment does not set.
    Ctrl-C at the terminal does not reach them. None is left when this returns or raises; frames that are done stay.

    Args:
        ks: the frames, begun in this order.
        workers: processes at a time, each with one frame.
        watch: called with each frame as it is done, and what the job returned for it, which can be pickled.
        stop: called again and again; returns whether to end.

    Raises:
        KeyboardInterrupt: `stop` returned True.
        RunError: a process was ended from outside, or crashed.
        Exception: whatever the job raises, as itself.
    """
    count = min(workers, len(ks))
    if count > 1:
        _render_beside(job, ks, count, watch, stop)
    elif ks:
        render = job.start()
        for k in ks:
            if stop():
                raise KeyboardInterrupt
            watch(k, render(k))


def _render_beside(
    job: Job, ks: Sequence[int], count: int, watch: Callable[[int, Any], None], stop: Callable[[], bool]
) -> None:
    begin = pickle.dumps(job)
    answers: queue.SimpleQueue[tuple[_Worker, tuple[str, Any] | None]] = queue.SimpleQueue()
    waiting = iter(ks)
    left = len(ks)
    workers: list[_Worker] = []
    try:
        for _ in range(count):
            workers.append(_Worker(max(1, available_cores() // count), answers))
            workers[-1].send(begin)
            workers[-1].ask(next(waiting))
        while left:
            if stop():
                raise KeyboardInterrupt
            try:
                worker, answer = answers.get(timeout=PAUSE)
            except queue.Empty:
                continue
            if answer is None:
                raise worker.death()
            kind, content = answer
            if kind == "failed":
                raise content
            left -= 1
            done = worker.frame
            following = next(waiting, None)
            if following is not None:
                worker.ask(following)
            watch(done, content)
    finally:
        _close_all(workers, at_work=left > 0)


class _Worker:
    """One process with a `frame` in work, and the thread that reads its answers; None means that it ended."""

    def __init__(self, threads: int, answers: "queue.SimpleQueue") -> None:
        self.frame = -1
        self._complained = tempfile.TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(
            [sys.executable, "-c", CODE.format(path=sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complained,
            env={**dict.fromkeys(THREADS, str(threads)), **os.environ},
            # Ctrl-C at the terminal is for the process that started this one.
            start_new_session=True,
        )
        self._thread = threading.Thread(target=self._hear, args=(answers,), daemon=True)
        self._thread.start()

    def ask(self, k: int) -> None:
        """Let it render a frame."""
        self.frame = k
        self.send(pickle.dumps(k))

    def send(self, content: bytes) -> None:
        """Send it a pickled object; where it has ended, its answers say so."""
        with suppress(OSError):
            self.process.stdin.write(content)  # type: ignore[union-attr]
            self.process.stdin.flush()  # type: ignore[union-attr]

    def dismiss(self, *, at_work: bool) -> None:
        """Ask it to stop without finishing its frame."""
        if at_work:
            self.process.terminate()
        with suppress(OSError):
            self.process.stdin.close()  # type: ignore[union-attr]

    def death(self) -> RunError:
        """Return the error to raise when it has ended by itself."""
        status = self.process.wait()
        how = f"was ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        self._complained.seek(0)
        words = self._complained.read().decode("utf-8", errors="replace").strip().splitlines()[-QUOTED:]
        said = f", after saying: {' '.join(words).rstrip('.')}" if words else ""
        return RunError(
            f"The process that rendered frame {self.frame} {how}{said}; frames that are done are kept, and fewer "
            "--workers need less memory."
        )

    def close(self, patience: float) -> None:
        """Wait `patience` seconds for it to end, then kill it."""
        try:
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(patience)
        finally:
            self.process.kill()
            self.process.wait()
            self._thread.join()
            self.process.stdout.close()  # type: ignore[union-attr]
            self._complained.close()

    def _hear(self, answers: "queue.SimpleQueue") -> None:
        while True:
            try:
                answer = pickle.load(self.process.stdout)  # type: ignore[arg-type]
            # It ended, perhaps in the middle of an answer.
            except Exception:
                answer = None
            answers.put((self, answer))
            if answer is None:
                return


def _close_all(workers: Sequence[_Worker], *, at_work: bool) -> None:
    """End all processes, whatever they are doing."""
    end = time.monotonic() + GRACE
    try:
        for worker in workers:
            worker.dismiss(at_work=at_work)
        for worker in workers:
            worker.close(max(0.0, end - time.monotonic()))
    except BaseException:
        # A second Ctrl-C: no more patience.
        for worker in workers:
            worker.close(0.0)
        raise


def serve() -> None:
    """Render in a process of its own: start the job, then render each frame that is sent, until stdin ends.

    Messages are pickled objects on stdin and stdout, pipes to the process that started it, which it does not outlive.
    First comes the job; then the number of a frame, again and again, each answered by ("done", what the job returned)
    or ("failed", exception).
    """
    # An unfinished file is removed on the way out.
    signal.signal(signal.SIGTERM, _leave)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # What libraries print goes to stderr.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    questions = sys.stdin.buffer
    try:
        render = pickle.load(questions).start()
    except Exception as error:
        _answer(answers, "failed", error)
        return
    while True:
        try:
            k = pickle.load(questions)
        except EOFError:
            return
        try:
            kind, content = "done", render(k)
        except Exception as error:
            kind, content = "failed", error
        _answer(answers, kind, content)


def _answer(answers: IO[bytes], kind: str, content: Any) -> None:
    """Send an answer; an exception that cannot travel is replaced by one that names it."""
    if isinstance(content, Exception) and not isinstance(content, MpmcliError):
        content.add_note("".join(traceback.format_exception(content)))
    try:
        whole = pickle.dumps((kind, content))
        pickle.loads(whole)
    except Exception as error:
        said = content if isinstance(content, Exception) else error
        whole = pickle.dumps(("failed", RuntimeError(f"{type(said).__name__}: {said}")))
    answers.write(whole)
    answers.flush()


def _leave(*_: object) -> None:
    # The base class, as no handler of errors must stop it.
    raise KeyboardInterrupt
