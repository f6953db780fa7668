"""Questions to processes: each process answers once, in JSON, and may crash or hang."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from typing import IO

PAUSE = 0.01
# Time to wait for a killed process, s.
LAST_WAIT = 5.0
# Number of characters of stderr that are kept, from the end.
COMPLAINT_LENGTH = 2000


@dataclass(frozen=True)
class Question:
    """A command that answers with JSON objects on stdout, one per line.

    Attributes:
        timeout: time limit, s.
        environment: variables added to those of this process; None removes one.
        leads_a_group: whether it is ended together with the processes that it has started.
        follows: whether its stdin is a pipe from this process, by which `end_with_parent` works. Ctrl-C at the
            terminal does not reach it.
    """

    command: Sequence[str]
    timeout: float
    environment: Mapping[str, str | None] = field(default_factory=dict)
    leads_a_group: bool = False
    follows: bool = False


@dataclass(frozen=True)
class Reply:
    """The outcome of a process.

    Attributes:
        answer: its JSON objects, merged.
        fault: "" if it answered and exited with 0; else the reason, such as "died by SIGSEGV".
        complaint: the end of what it wrote on stderr.
    """

    answer: dict
    fault: str
    complaint: str


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module of this installation, but none of that name in the current directory."""
    return [sys.executable, "-P", "-m", module, *arguments]


def ask(question: Question) -> Reply:
    """Ask one process, and wait for it."""
    return next(iter(ask_each([question], at_once=1)))


def ask_each(questions: Sequence[Question], at_once: int) -> Iterator[Reply]:
    """Ask each process, at most `at_once` at a time, and yield the replies in the order of the questions."""
    replies: dict[int, Reply] = {}
    following = 0
    for number, reply in ask_as_ended(questions, at_once):
        replies[number] = reply
        while following in replies:
            yield replies.pop(following)
            following += 1


def ask_as_ended(
    questions: Iterable[Question], at_once: int, stop: Callable[[], bool] = lambda: False
) -> Iterator[tuple[int, Reply]]:
    """Ask each process, at most `at_once` at a time, and yield (number of the question, reply) as they end.

    A question is taken when its process starts. `stop` is polled; where it returns True, KeyboardInterrupt is raised,
    and no process is left running.
    """
    going: dict[int, _Child] = {}
    waiting = enumerate(questions)
    more = True
    try:
        while more or going:
            while more and len(going) < at_once:
                number, question = next(waiting, (-1, None))
                more = question is not None
                try:
                    if more:
                        going[number] = _Child(question)
                except OSError as error:
                    yield number, Reply({}, f"could not be started: {error}", "")
            if stop():
                raise KeyboardInterrupt
            ended = [number for number in going if going[number].has_ended()]
            for number in ended:
                with closing(going.pop(number)) as child:
                    reply = child.reply()
                yield number, reply
            if not ended:
                time.sleep(PAUSE)
    finally:
        for child in going.values():
            child.close()


@contextmanager
def answering() -> Iterator[Callable[..., None]]:
    """Let a child process answer by `answer(name=value, ...)`; what libraries print goes to stderr."""
    with suppress(ImportError):  # Windows
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answers:
        os.dup2(2, 1)

        def answer(**values: object) -> None:
            answers.write(json.dumps(values) + "\n")
            answers.flush()

        yield answer


def end_with_parent() -> None:
    """Let this process end when the one that started it is gone, which closes its standard input."""

    def wait() -> None:
        while os.read(0, 1024):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


class _Child:
    """A running child process."""

    def __init__(self, question: Question) -> None:
        self._question = question
        # The same modules are found as in this process, wherever it was started from.
        path = os.pathsep.join(os.path.abspath(place) for place in sys.path)
        environment = {**os.environ, "PYTHONPATH": path, **question.environment}
        self._grouped = question.leads_a_group and hasattr(os, "killpg")
        self._late = False
        self._said, self._complained = _sink(), _sink()
        try:
            self._process = subprocess.Popen(
                list(question.command),
                stdin=subprocess.PIPE if question.follows else subprocess.DEVNULL,
                stdout=self._said,
                stderr=self._complained,
                env={name: value for name, value in environment.items() if value is not None},
                start_new_session=question.follows,
                **({"process_group": 0} if self._grouped else {}),
            )
        except BaseException:
            self._said.close()
            self._complained.close()
            raise
        self._begin = time.monotonic()

    def has_ended(self) -> bool:
        """Return whether it has ended; end it after its time limit."""
        if self._process.poll() is not None:
            return True
        if time.monotonic() - self._begin > self._question.timeout:
            self._late = True
            self._end()
            return True
        return False

    def reply(self) -> Reply:
        """Return its reply."""
        answer = {}
        for line in _text(self._said).splitlines():
            with suppress(ValueError):
                value = json.loads(line)
                answer |= value if isinstance(value, dict) else {}
        return Reply(answer, self._fault(answer), _text(self._complained)[-COMPLAINT_LENGTH:].strip())

    def close(self) -> None:
        """End the process if it is running, and close its files."""
        if self._process.poll() is None:
            self._end()
        for stream in (self._said, self._complained, self._process.stdin):
            if stream is not None:
                stream.close()

    def _end(self) -> None:
        with suppress(OSError, subprocess.TimeoutExpired):
            if self._grouped:
                os.killpg(self._process.pid, signal.SIGKILL)
            else:
                self._process.kill()
            self._process.wait(LAST_WAIT)

    def _fault(self, answer: dict) -> str:
        status = self._process.returncode
        if self._late:
            return f"took longer than {self._question.timeout:g} s"
        if status and status < 0:
            named = -status in set(signal.Signals)
            return f"died by {signal.Signals(-status).name if named else f'signal {-status}'}"
        if status:
            return f"exited with {status}"
        return "" if answer else "gave no answer"


def _sink() -> IO[bytes]:
    # No pipe, which could fill up, and no disk, which may be full, where there is another way.
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("mpmcli"), "w+b")
    return tempfile.TemporaryFile()


def _text(sink: IO[bytes]) -> str:
    sink.seek(0)
    return sink.read().decode("utf-8", errors="replace")
