"""The process that renders some of the frames: it starts the job, then renders each frame that it is sent.

Messages are pickled objects on stdin and stdout, which are pipes to the process that started it. First comes the job;
then the number of a frame, again and again, each answered by ("done", what the job returned) or ("failed", exception).
It ends when stdin does, so it does not outlive the other process.
"""

import os
import pickle
import signal
import sys
import traceback
from typing import IO, Any

from mpmcli.errors import MpmcliError


def main() -> None:
    """Render until there is nothing left to do."""
    # An unfinished file is removed on the way out.
    signal.signal(signal.SIGTERM, _leave)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = _own_stdout()
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
            outcome = render(k)
        except Exception as error:
            _answer(answers, "failed", error)
        else:
            _answer(answers, "done", outcome)


def _own_stdout() -> IO[bytes]:
    """Return the pipe of the answers, and lead what libraries print to stderr."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return answers


def _answer(answers: IO[bytes], kind: str, content: Any) -> None:
    answers.write(_pickled(kind, content))
    answers.flush()


def _pickled(kind: str, content: Any) -> bytes:
    """Return an answer; an exception that cannot travel is replaced by one that names it."""
    if isinstance(content, Exception) and not isinstance(content, MpmcliError):
        content.add_note("".join(traceback.format_exception(content)))
    try:
        whole = pickle.dumps((kind, content))
        pickle.loads(whole)
    except Exception as error:
        said = content if isinstance(content, Exception) else error
        return pickle.dumps(("failed", RuntimeError(f"{type(said).__name__}: {said}")))
    return whole


def _leave(*_: object) -> None:
    # The base class, as no handler of errors must stop it.
    raise KeyboardInterrupt
