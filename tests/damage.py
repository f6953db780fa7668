"""Damage done to results on purpose: bits flipped, files cut off, files removed; and what the commands make of it.

Each trial copies a small result, damages it, and asks `info --verify` and `dataset verify` whether they notice, and
`export` whether it reads damaged data as data.
"""

import io
import random
import shutil
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np

GOLDEN = Path(__file__).resolve().parent / "golden" / "2"
RESULTS, EXPORTS = ("packed", "compressed", "died", "series", "dataset"), ("lagrangebench", "gns", "npz", "vtkhdf")
KINDS = ("flip", "cut", "removed")
# Longest that a trial may take, s.
LIMIT = 120
# Files that hold no frames: what they say is of the run, not of its data.
APART = ("run.json", "sweep.toml", "base.toml", "manifest.sqlite", "README.md")


@dataclass(frozen=True)
class Trial:
    """One damage.

    Attributes:
        subject: one of RESULTS or EXPORTS; kind: one of KINDS.
        seed: says where.
    """

    subject: str
    kind: str
    seed: int


@dataclass(frozen=True)
class Outcome:
    """What came of a trial.

    Attributes:
        what: where the damage is.
        noticed: by verification, with an exit code and a sentence.
        same: whether nothing that a reader sees has changed.
        exported: "refused", "equal" to the export of the sound result, "differs", or "" where there is no export.
        fault: of mpmcli: a traceback, a crash or a hang; "" without.
    """

    trial: Trial
    what: str
    noticed: bool
    same: bool
    exported: str
    fault: str

    @property
    def bad(self) -> bool:
        """Whether the damage was missed, or read as data, or mpmcli failed."""
        return bool(self.fault) or not (self.noticed or self.same) or self.exported == "differs"


def mpmcli(*arguments: object) -> tuple[int, str]:
    """Run a command in this process, and return its exit code and what it printed."""
    from mpmcli.cli import program

    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        code = program.run([str(word) for word in arguments])
    return code, out.getvalue() + err.getvalue()


@cache
def originals() -> Path:
    """Make all subjects in a directory, once per process."""
    place = TemporaryDirectory()
    _KEPT.append(place)
    root = Path(place.name)
    for name in RESULTS:
        if name != "compressed":
            shutil.copytree(GOLDEN / name, root / name)
    _compress(root / "packed", root / "compressed")
    for name in RESULTS:
        assert mpmcli("export", root / name, "--to", "npz", "-o", root / f"{name}-exported", "-q")[0] == 0
    for form in EXPORTS:
        assert mpmcli("export", root / "dataset", "--to", form, "-o", root / form, "-q")[0] == 0
    return root


_KEPT: list[TemporaryDirectory] = []


def _compress(source: Path, target: Path) -> None:
    from mpmcli.output import SegmentStore, open_result

    result = open_result(source)
    target.mkdir()
    store = SegmentStore(target, result.header.stored, compress=True, hold=np.inf)
    for frame, row in zip(result.frames(), result.ledger, strict=True):
        store.write(frame, row)
    store.finish()


def carry_out(trial: Trial) -> Outcome:
    """Do one damage, and look."""
    sound = originals() / trial.subject
    with TemporaryDirectory() as place:
        copy, target = Path(place) / trial.subject, Path(place) / "exported"
        shutil.copytree(sound, copy)
        what = _damage(copy, trial)
        verify = ["dataset", "verify", "-q"] if trial.subject in (*EXPORTS, "dataset") else ["info", "--verify"]
        code, text = mpmcli(*verify, copy)
        faults = [text] if "a fault of mpmcli" in text or "Traceback" in text else []
        exported = ""
        if trial.subject in RESULTS:
            done, text = mpmcli("export", copy, "--to", "npz", "-o", target, "-q")
            faults += [text] if "a fault of mpmcli" in text or "Traceback" in text else []
            equal = done == 0 and _contents(target) == _contents(originals() / f"{trial.subject}-exported")
            exported = "refused" if done else "equal" if equal else "differs"
        same = code == 0 and _contents(copy) == _contents(sound)
        return Outcome(trial, what, code in (1, 2), same, exported, "".join(faults))


def _damage(copy: Path, trial: Trial) -> str:
    rng = random.Random(f"{trial.subject} {trial.kind} {trial.seed}")
    files = sorted(path for path in copy.rglob("*") if path.is_file() and path.name not in APART)
    sizes = [path.stat().st_size for path in files]
    # Each byte of all files is as likely as any other.
    path = rng.choices(files, sizes)[0]
    size, name = path.stat().st_size, path.relative_to(copy)
    if trial.kind == "removed":
        path.unlink()
        return f"{name} removed"
    if trial.kind == "cut":
        size = rng.randrange(size)
        with path.open("r+b") as file:
            file.truncate(size)
        return f"{name} cut off after {size} bytes"
    place, bit = rng.randrange(size), rng.randrange(8)
    with path.open("r+b") as file:
        file.seek(place)
        byte = file.read(1)[0]
        file.seek(place)
        file.write(bytes([byte ^ 1 << bit]))
    return f"bit {bit} of byte {place} of {name}"


def _contents(directory: Path) -> dict[str, object]:
    """Return all that readers see in the files of a directory, by file and item."""
    return {
        str(path.relative_to(directory)): _of_hdf5(path) if path.suffix in (".h5", ".vtkhdf") else path.read_bytes()
        for path in sorted(directory.rglob("*"))
        if path.is_file()
    }


def _of_hdf5(path: Path) -> dict[str, object]:
    found: dict[str, object] = {}

    def take(name: str, item: h5py.Group | h5py.Dataset) -> None:
        found[name] = (item.dtype.str, item.shape, item[...].tobytes()) if isinstance(item, h5py.Dataset) else ()
        for key, value in item.attrs.items():
            found[f"{name}@{key}"] = value if isinstance(value, str) else np.asarray(value).tobytes()

    with h5py.File(path, "r") as file:
        take("", file)
        file.visititems(take)
    return found


def trials(
    count: int, kinds: tuple[str, ...] = ("flip",), first: int = 0, subjects: Sequence[str] = (*RESULTS, *EXPORTS)
) -> list[Trial]:
    """Return so many trials of each kind, of all subjects in turn."""
    return [Trial(subjects[k % len(subjects)], kind, k) for kind in kinds for k in range(first, first + count)]


def outcomes(chosen: list[Trial], workers: int = 1) -> Iterator[Outcome]:
    """Carry out trials in processes of their own, so that a crash and a hang are outcomes too."""
    pool = ProcessPoolExecutor(workers, get_context("spawn"))
    for trial in chosen:
        try:
            yield pool.submit(carry_out, trial).result(LIMIT)
        except (BrokenProcessPool, TimeoutError) as error:
            yield Outcome(trial, "", False, False, "", type(error).__name__)
            for process in list((pool._processes or {}).values()):
                process.kill()
            pool = ProcessPoolExecutor(workers, get_context("spawn"))
    pool.shutdown()


def table(found: list[Outcome]) -> list[tuple[str, ...]]:
    """Return a row of counts for each kind and subject, and one for all."""
    rows = []
    kinds = [kind for kind in KINDS if any(one.trial.kind == kind for one in found)]
    for kind in kinds:
        for subject in (*RESULTS, *EXPORTS, "all"):
            own = [one for one in found if one.trial.kind == kind and subject in (one.trial.subject, "all")]
            if not own:
                continue
            exported = Counter(one.exported for one in own)
            counts = (
                len(own),
                sum(one.noticed for one in own),
                sum(one.same for one in own),
                sum(not (one.noticed or one.same) for one in own),
                exported["refused"],
                exported["equal"],
                exported["differs"],
                sum(bool(one.fault) for one in own),
            )
            rows.append((kind, subject, *map(str, counts)))
    return rows


HEAD = ("damage", "of", "trials", "noticed", "changes nothing", "missed", "export refused", "export equal")
HEAD = (*HEAD, "read as data", "faults of mpmcli")


def describe(found: list[Outcome]) -> Iterator[str]:
    """Yield a line for each outcome that must not be."""
    for one in found:
        if one.bad:
            yield f"{one.trial}: {one.what}: noticed {one.noticed}, {one.exported} {one.fault}"


if __name__ == "__main__":
    sys.exit("scripts/damage runs the campaign.")
