"""Finds the state that an earlier run left in a directory, and decides whether a scene can resume it."""

import math
import os
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpmcli.errors import InputError
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import plugin_file
from mpmcli.output import read_record
from mpmcli.output.checkpoints import Checkpoint, read_checkpoints
from mpmcli.output.checksums import path_digest
from mpmcli.output.directory import SCENE, has_frames
from mpmcli.output.durable import TEMPORARY_SUFFIX, number_of, sync_directory
from mpmcli.output.layout import DAMAGED, PACKED, SEGMENTS, FrameIndex, sealed_segments, segment_name
from mpmcli.output.lock import LOCK
from mpmcli.output.series import remove_series
from mpmcli.output.verify import verify_file
from mpmcli.output.vtkhdf import read_index_of
from mpmcli.plain_text import counted
from mpmcli.scene import LoadedScene, scene_to_toml
from mpmcli.solver.engine.run import Run
from mpmcli.solver.engine.saved_state import SavedState
from mpmcli.solver.machine.backend import Backend

# Keys that may change at a resumption: the end, with frames equally far apart, and the compression of the file.
MAY_CHANGE = ("time.end", "time.frames", "output.compress")
_NONE = object()


@dataclass(frozen=True)
class Resumption:
    """Undamaged frames, the newest checkpoint within them, and the record of a run to be resumed, unless `complete`.

    The packed file contains `packed` of the frames.
    """

    index: FrameIndex | None
    checkpoint: Checkpoint | None
    complete: bool
    record: Mapping[str, Any]
    packed: int = 0

    @property
    def step(self) -> int:
        """Number of steps taken before the resumption."""
        return 0 if self.checkpoint is None else self.checkpoint.step

    @property
    def note(self) -> str:
        """A sentence on the point of resumption."""
        if self.complete:
            return f"resumed: all {self.frames} frames are there"
        point = self.checkpoint
        place = "the start" if point is None else f"step {point.step} at {point.time:.6g} s"
        return f"resumed: {counted(self.frames, 'frame')} kept, computed again from {place}"

    @property
    def frames(self) -> int:
        """Number of existing frames."""
        return 0 if self.index is None else len(self.index.times)

    @property
    def rows(self) -> list[LedgerRow]:
        """The ledger of the existing frames."""
        return [] if self.index is None else self.index.ledger


def find_resumption(loaded: LoadedScene, directory: Path) -> Resumption | None:
    """Return the resumption of a scene in a directory, None if the directory is empty; InputError: not its run."""
    record = read_record(directory) if directory.is_dir() else None
    if not has_frames(directory):
        # Killed before anything was written, or not begun.
        names = [path.name for path in directory.iterdir()] if directory.is_dir() else []
        if record is not None or all(name == LOCK or name.endswith(TEMPORARY_SUFFIX) for name in names):
            return None
    if record is None or not (directory / SCENE).is_file():
        raise InputError(f"{directory} holds no run that could be resumed: give its directory with -o.")
    _require_same_scene(loaded, directory)
    _require_same_files(loaded, record, directory)
    index, packed = _sound_index(directory)
    frames = 0 if index is None else len(index.times)
    found = (point for point in read_checkpoints(directory) if point.frame <= frames)
    return Resumption(index, next(found, None), frames == loaded.scene.time.frames + 1, record, packed)


def go_on(run: Run, resumption: Resumption, backend: Backend, *, forced: bool) -> None:
    """Replace the initial state by that of the checkpoint, if any; InputError: backend, --force or particles differ."""
    point = resumption.checkpoint
    # Frames stored before the first checkpoint are also kept.
    began = resumption.record.get("forced", forced) if point is None else point.forced
    if began != forced:
        raise InputError(f"The run was begun with{'' if began else 'out'} --force: resume it in the same way.")
    if point is None:
        return
    if point.backend != {"arch": backend.arch, "precision": backend.precision}:
        raise InputError(
            f"The run was computed with --arch {point.backend['arch']}: give that to resume it; found {backend.arch}."
        )
    try:
        run.load(SavedState(dict(point.numbers), dict(point.arrays)))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"The checkpoint of step {point.step} holds something else than a state.") from error


def require_same_run(resumption: Resumption, header: Mapping[str, Any], directory: Path) -> None:
    """Raise an InputError if the header differs from that of the stored frames, which prevents packing."""
    before = {} if resumption.index is None else resumption.index.header
    for key in (key for key in header if before and key not in ("scene", "chosen")):
        if before.get(key) != header[key]:
            raise InputError(
                f"{directory} holds frames whose {key} is {_text(before.get(key))}, and new ones would have "
                f"{_text(header[key])}: resume the run with the version and the --arch that it was begun with."
            )


def take_over(directory: Path, resumption: Resumption) -> None:
    """Make the existing frames the first segments of the run, and remove damaged frames and all after them.

    A damaged packed file is set aside until the run is complete.
    """
    packed, folder = directory / PACKED, directory / SEGMENTS
    # It is written again from all frames.
    remove_series(directory)
    if resumption.packed:
        folder.mkdir(exist_ok=True)
    elif packed.exists():
        os.replace(packed, directory / DAMAGED)
    for path in sealed_segments(directory):
        if not resumption.packed <= number_of(path) < resumption.frames:
            path.unlink()
    if resumption.packed:
        # Make the removals durable first: a segment whose frames are in the packed file must not reappear.
        sync_directory(folder)
        os.replace(packed, folder / segment_name(0))
        sync_directory(folder)
        sync_directory(directory)


def file_digests(loaded: LoadedScene) -> dict[str, str]:
    """Return the SHA-256 of each file that a scene reads, by its name in the scene, and of each plugin it needs."""
    scene, found = loaded.scene, {}
    for law in scene.laws:
        if plugin := plugin_file(law):
            found[f"the plugin of the law {law}"] = path_digest(plugin)
    for entry in (*scene.sources, *scene.colliders):
        for name in entry.shape.files:
            with suppress(OSError):
                found[name] = path_digest(Path(loaded.source).parent / name)
    return found


def _sound_index(directory: Path) -> tuple[FrameIndex | None, int]:
    """Return the index of the undamaged frames from the first on, and how many of them are in the packed file."""
    found: list[FrameIndex] = []
    packed = directory / PACKED
    if packed.exists() and verify_file(packed).sound:
        found.append(read_index_of(packed))
    count = of_packed = len(found[0].times) if found else 0
    for path in sealed_segments(directory):
        if not verify_file(path).sound:
            break
        index = read_index_of(path)
        first = int(index.frames[0])
        if first < count:
            # The packed file contains it.
            continue
        if first > count or index.frames.tolist() != list(range(first, first + len(index.frames))):
            break
        found.append(index)
        count += len(index.frames)
    return FrameIndex.joined(found) if found else None, of_packed


def _require_same_scene(loaded: LoadedScene, directory: Path) -> None:
    """Raise InputError if a run cannot be resumed with a scene: more has changed than its end and the like."""
    try:
        before = tomllib.loads((directory / SCENE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{directory / SCENE} cannot be read, so that the run cannot be resumed.") from error
    now = tomllib.loads(scene_to_toml(loaded.scene))
    changes = list(_changes("", before, now))
    texts = [f"{key} was {_text(old)} and is {_text(new)}" for key, old, new in changes if key not in MAY_CHANGE]
    if texts:
        raise InputError(
            f"{directory} holds a run of another scene and cannot be resumed with {loaded.source}: "
            + "; ".join(texts[:8])
            + (f"; and {len(texts) - 8} more" if len(texts) > 8 else "")
            + "."
        )
    old, new = before["time"], now["time"]
    same_spacing = math.isclose(old["end"] * new["frames"], new["end"] * old["frames"], rel_tol=1e-12)
    if new["frames"] < old["frames"] or not same_spacing:
        raise InputError(
            f"{directory} holds frames {old['end'] / old['frames']:.6g} s apart up to {old['end']:.6g} s: to resume, "
            "time.end and time.frames may only grow, both by the same factor."
        )


def _require_same_files(loaded: LoadedScene, record: Mapping[str, Any], directory: Path) -> None:
    before = record.get("files") or {}
    for name, digest in file_digests(loaded).items():
        if before.get(name, digest) != digest:
            raise InputError(f"{name} has changed since the run in {directory} began, which cannot be resumed with it.")


def _changes(place: str, old: object, new: object) -> Iterator[tuple[str, object, object]]:
    """Yield the key path, the old and the new value of each difference."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}):
            yield from _changes(f"{place}.{key}".lstrip("."), old.get(key, _NONE), new.get(key, _NONE))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for k, pair in enumerate(zip(old, new, strict=True)):
            yield from _changes(f"{place}[{k}]", *pair)
    elif old != new:
        yield place, old, new


def _text(value: object) -> str:
    text = "absent" if value is _NONE else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
