"""Makes one readable file of a run that ended early, or of a result that has been damaged."""

import os
import shutil
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mpmcli.errors import InputError
from mpmcli.output.collider_files import write_collider_files
from mpmcli.output.directory import SCENE
from mpmcli.output.durable import number_of, sync_directory, temporary_of, write_text
from mpmcli.output.header import RunHeader
from mpmcli.output.lock import take_lock
from mpmcli.output.pack import pack_segments
from mpmcli.output.run_record import RECORD, read_record
from mpmcli.output.segments import DAMAGED, PACKED, REPAIRED, SEGMENTS, remove_segments, sealed_segments
from mpmcli.output.series import SERIES
from mpmcli.output.verify import FileVerdict, verify_file, verify_result
from mpmcli.output.vtkhdf import read_index_of
from mpmcli.plain_text import counted


@dataclass
class Repair:
    """What a repair has done: frames that the result holds, segments packed, and sentences on losses and the rest."""

    path: Path
    changed: bool = False
    frames: int = 0
    packed: int = 0
    lost: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def as_dict(self) -> dict:
        """Return it as JSON can hold it."""
        return {**asdict(self), "path": str(self.path), "ok": not self.lost}

    def text(self) -> str:
        """Return a line of what was done, and one for everything that is lost."""
        what = f"{PACKED} holds {counted(self.frames, 'frame')} now" if self.changed else "nothing to repair"
        return "\n".join([f"{self.path}: {what}", *self.lost, *self.notes])


def repair(directory: Path) -> Repair:
    """Pack the sound frames of a run up to the first one that is damaged or missing.

    What is damaged or lies beyond stays; a damaged packed file gets another name. InputError: nothing can be read, or
    another process writes; RunError: the disk refuses; neither has removed anything.
    """
    directory = Path(directory)
    if directory.name == SEGMENTS and directory.is_dir():
        directory = directory.parent
    if directory.name == PACKED and directory.is_file():
        directory = directory.parent
    if not directory.is_dir():
        raise InputError(f"{directory} is no directory of a run: give the one that holds {PACKED} or {SEGMENTS}.")
    with take_lock(directory):
        return _repair(directory)


def _repair(directory: Path) -> Repair:
    done = Repair(directory)
    packed, segments = directory / PACKED, sealed_segments(directory)
    verdict = verify_file(packed) if packed.exists() else None
    if verdict is not None and verdict.sound:
        done.frames = verdict.frames
    elif segments and (verdict is None or not verdict.prefix):
        _pack(segments, done, damaged=verdict is not None)
    elif verdict is not None:
        _salvage(packed, verdict, done)
    elif (directory / SERIES).exists():
        return _of_series(directory, done)
    else:
        raise InputError(f"{directory} holds no frame that could be repaired: no {PACKED} and no segment is in it.")
    _complete(directory, done)
    return done


def _pack(segments: Sequence[Path], done: Repair, *, damaged: bool) -> None:
    """Pack segments up to the first fault."""
    chosen: list[Path] = []
    frames, hole = 0, False
    beyond: list[tuple[int, int]] = []
    for segment in segments:
        first, verdict = number_of(segment), verify_file(segment)
        (done.notes if verdict.whole else done.lost).extend(verdict.faults)
        if not hole and first > frames:
            hole = True
            done.lost.append(f"{_frames(frames, first - 1)} missing: no segment in {segment.parent} holds them.")
        if not hole and first < frames:
            done.notes.append(f"{segment} holds frames that others hold, too: left where it is.")
            continue
        if hole:
            if verdict.whole:
                beyond.append((first, first + verdict.frames - 1))
            continue
        hole = not verdict.whole
        if verdict.prefix:
            chosen.append(segment)
            frames += verdict.prefix
    for first, last in beyond:
        done.notes.append(f"{_frames(first, last)} sound, but after a hole: left in {segments[0].parent}.")
    if not frames:
        raise InputError(f"{done.path} holds no frame that could be repaired. {' '.join(done.lost)}")
    _replace(chosen, frames, done, damaged=damaged)
    if not done.lost and len(chosen) == len(segments):
        with suppress(OSError):
            remove_segments(done.path)
        done.packed = len(chosen)
        return
    for segment in chosen:
        if verify_file(segment).whole:
            segment.unlink()
            done.packed += 1


def _salvage(packed: Path, verdict: FileVerdict, done: Repair) -> None:
    """Keep the frames of a damaged packed file up to the first damaged one."""
    (done.notes if verdict.whole else done.lost).extend(verdict.faults)
    if not verdict.prefix:
        raise InputError(f"{packed} holds no frame that could be repaired. {' '.join(verdict.faults)}")
    _replace([packed], verdict.prefix, done, damaged=True)


def _replace(sources: Sequence[Path], frames: int, done: Repair, *, damaged: bool) -> None:
    """Pack frames, verify the new file, and only then give it its name."""
    packed, new = done.path / PACKED, done.path / REPAIRED
    # Of a run that was killed.
    temporary_of(packed).unlink(missing_ok=True)
    compress = _compresses(read_index_of(sources[0]).header)
    try:
        pack_segments(sources, new, compress=compress, frames=frames)
        if not verify_file(new).sound:
            raise InputError(f"{new} does not read back as it was written: nothing was removed.")
        if damaged:
            _keep(packed, done.path / DAMAGED)
            done.notes.append(f"{packed} was damaged; it is kept as {DAMAGED}.")
        os.replace(new, packed)
        sync_directory(done.path)
    finally:
        new.unlink(missing_ok=True)
    done.changed, done.frames = True, frames


def _compresses(header: Mapping[str, Any]) -> bool:
    try:
        return bool(tomllib.loads(header.get("scene", "")).get("output", {}).get("compress", False))
    except (tomllib.TOMLDecodeError, AttributeError):
        return False


def _keep(path: Path, name: Path) -> None:
    """Give a file a second name, so that it is never without one."""
    name.unlink(missing_ok=True)
    try:
        os.link(path, name)
    except OSError:
        # Some file systems have no links.
        shutil.copyfile(path, name)


def _complete(directory: Path, done: Repair) -> None:
    """Write the scene and the colliders where they are missing, and say what the record says."""
    index = read_index_of(directory / PACKED)
    if not (directory / SCENE).exists() and "scene" in index.header:
        write_text(directory / SCENE, index.header["scene"])
        done.changed = True
    colliders = RunHeader.read(index.header).read_colliders({})
    if done.packed and colliders and None not in colliders:
        write_collider_files(directory, index.header, index.times.tolist(), colliders)
    record = read_record(directory)
    if record is None and (directory / RECORD).exists():
        done.lost.append(f"{directory / RECORD} is damaged: what it said of the run is lost.")
    written = (record or {}).get("frames_written")
    if isinstance(written, int) and written > done.frames and not done.lost:
        done.lost.append(f"The run had written {counted(written, 'frame')}; the others are gone.")


def _of_series(directory: Path, done: Repair) -> Repair:
    found = verify_result(directory)
    done.frames, done.lost = found.frames, found.faults
    if done.lost:
        done.lost.append(f"A series is not repaired; the frames of {directory} that are not named here can be read.")
    return done


def _frames(first: int, last: int) -> str:
    return f"Frame {first} is" if first == last else f"Frames {first} to {last} are"
