"""The frames that `--frame` selects."""

import re
from collections.abc import Sequence

import numpy as np

from mpmcli.errors import InputError
from mpmcli.output.result import Result

HINT = "give a number, first, last, all, or A:B:S, from A up to but not B in steps of S, as in Python"


def choose_frames(text: str, result: Result) -> list[int]:
    """Return the indices in the result of the frames that --frame selects, see `frames_in`."""
    return frames_in(text, result.numbers.tolist(), _holds(result))


def frames_in(text: str, numbers: Sequence[int], holds: str, option: str = "--frame ") -> list[int]:
    """Return the indices of the frames selected by a text, in the selected order; InputError: there is none.

    The text is "first", "last", "all", N or "A:B:S". N is one of the frame numbers; a negative one counts back from the
    last number (-1). A:B:S is a Python slice of the frames, by position. Errors say what `holds` which frames.
    """
    count = len(numbers)
    word = text.strip()
    if word in ("first", "last", "all"):
        return {"first": [0], "last": [count - 1], "all": list(range(count))}[word]
    if re.fullmatch(r"-?\d+", word):
        wanted = int(word) if int(word) >= 0 else int(word) + numbers[-1] + 1
        if wanted not in numbers:
            raise InputError(f"{option}{word}: {holds}.")
        return [numbers.index(wanted)]
    match = re.fullmatch(r"(-?\d+)?:(-?\d+)?(?::(-?\d+)?)?", word)
    start, end, step = (int(part) if part else None for part in match.groups()) if match else (0, 0, 0)
    if step == 0:
        raise InputError(f'{option}"{text}" selects no frame: {HINT}.')
    chosen = list(range(count))[start:end:step]
    if not chosen:
        raise InputError(f"{option}{word} selects no frame: {holds}.")
    return chosen


def evenly_spaced(ks: Sequence[int], count: int) -> list[int]:
    """Return up to `count` of the frames, evenly spaced, with the first and the last; for a count of 1, the last."""
    if count == 1:
        return [ks[-1]]
    places = np.unique(np.linspace(0, len(ks) - 1, count).round().astype(int))
    return [ks[place] for place in places]


def _holds(result: Result) -> str:
    first, last = int(result.numbers[0]), int(result.numbers[-1])
    so_far = " so far, as its run goes on" if result.status == "running" else ""
    frames = f"frame {first} only" if first == last else f"frames {first} to {last}"
    return f"{result.path} holds {frames}{so_far}"
