"""Exports a dataset for training code, NumPy and ParaView, to a directory that appears complete or not at all."""

import itertools
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from mpmcli.dataset.dataset import Dataset
from mpmcli.dataset.folder import MANIFEST, Manifest
from mpmcli.dataset.formats import FORMATS, format_named
from mpmcli.dataset.metadata import EXPORTED_BY, common_facts
from mpmcli.dataset.report import status_of
from mpmcli.dataset.shard import SPLITS, group_name
from mpmcli.dataset.subsample import SEED, SubsampledTrajectory, WallChoice
from mpmcli.errors import InputError, RunError
from mpmcli.output import check_directory
from mpmcli.output.checksums import SUMS, path_digest, sums_faults, sums_text
from mpmcli.output.durable import TEMPORARY_SUFFIX, require_free_space, sync_directory, sync_file
from mpmcli.output.verify import Verification
from mpmcli.plain_json import finite_json
from mpmcli.plain_text import counted, size_text

METADATA = "metadata.json"
# Threads that wait for the disk, which stores many small files together.
SYNCS = 4


@dataclass(frozen=True)
class ExportSettings:
    """Settings of an export.

    Attributes:
        form: format, a key of FORMATS.
        directory: target.
        trajectory: number of the only trajectory to export; None for all.
        stride: export every `stride`-th frame.
        max_particles: largest number of material particles per trajectory; None for all.
        overwrite: whether an earlier export in `directory` is replaced.
        walls: walls that get particles.
        present: "always": only particles that are there in all exported frames.
        features: material parameters that particles of a GNS export have; None for the one that differs.
        wall_spacing: distance between neighbouring wall particles, m; None for that of the material at the start.
    """

    form: str
    directory: Path
    trajectory: int | None = None
    stride: int = 1
    max_particles: int | None = None
    overwrite: bool = False
    walls: WallChoice = "none"
    wall_spacing: float | None = None
    features: tuple[str, ...] | None = None
    present: Literal["any", "always"] = "any"


@dataclass(frozen=True)
class ExportSummary:
    """Summary of an export: files and stores, trajectories by split, largest numbers of frames and particles, bytes."""

    directory: str
    form: str
    files: list[str]
    trajectories: dict[str, int]
    frames: int
    particles: int
    bytes: int
    notes: list[str]

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self)

    def text(self) -> str:
        """Return it as a line of text."""
        count = sum(self.trajectories.values())
        splits = ", ".join(f"{split} {number}" for split, number in self.trajectories.items() if number)
        return (
            f"{self.directory}: {counted(count, 'trajectory')} ({splits}) of up to {counted(self.frames, 'frame')} and "
            f"{counted(self.particles, 'particle')}, {size_text(self.bytes)} as {self.form}"
        )


def export(
    dataset: Dataset, settings: ExportSettings, watch: Callable[[int], None] = lambda done: None
) -> ExportSummary:
    """Write a directory with a dataset in another format and metadata.json, completely or not at all.

    `watch` is called with the number of trajectories written. InputError, nothing written: the directory is in use,
    there is no such trajectory, or the format cannot store it. RunError, nothing left: the disk is full or a write
    failed.
    """
    directory = Path(settings.directory)
    _restore_former(directory)
    check_export_directory(directory, settings.overwrite)
    numbers: Sequence[int] = dataset.numbers if settings.trajectory is None else [settings.trajectory]
    options = (settings.stride, settings.max_particles, settings.walls, settings.wall_spacing)
    always = settings.present == "always"
    chosen = [SubsampledTrajectory(dataset[number], *options, always=always) for number in numbers]
    for each in chosen:
        lacks = "particle that is there in all frames" if each.source.particle_count and not each.particle_count else ""
        if lacks := lacks or "frame" * (each.frame_count == 0):
            raise InputError(f"trajectory {each.source.number} of {dataset.path} has no {lacks} to export.")
    metadata = common_facts(chosen, settings.stride)
    metadata |= {"error": dataset.error} if dataset.error else {}
    lack = ""
    if settings.trajectory is None and (dataset.path / MANIFEST).exists():
        status = status_of(dataset.path)
        gone = {row.number for row in status.rows if row.accepted} - set(numbers)
        if gone:
            raise InputError(
                f"{dataset.path} lacks {counted(len(gone), 'trajectory')} of its manifest, {min(gone):06d} among them: "
                "its sweep was interrupted, or a file is missing; --trajectory N exports one that is there."
            )
        lack, told = status.lack(), status.as_dict()
        taken = {*numbers}
        metadata["verdict"] = {group_name(row.number): row.verdict for row in status.rows if row.number in taken}
        if rules := Manifest(dataset.path).facts().get("hold_out"):
            counts = {group_name(row.number): row.particles for row in status.rows if row.number in taken}
            metadata |= {"hold_out": rules, "particles": counts}
        metadata["dataset"] = {name: told[name] for name in ("part", "trajectories", "done", "accepted", "verdicts")}
    if any(each.particle_count < each.source.particle_count for each in chosen):
        metadata["particle_seed"] = SEED
    if settings.features is not None and settings.form != "gns":
        raise InputError("--features is for --to gns: leave it out.")
    form = format_named(settings.form)(chosen, settings.features)
    form.check()
    for each in chosen:
        walls = each.walls
        lost = set(walls.header.collider_names) - {collider.name for collider in walls.colliders}
        if lost and walls.walls != "none":
            number = each.source.number
            raise InputError(f'the collider "{min(lost)}" of trajectory {number} cannot be read: leave --walls out.')
    there = next(parent for parent in directory.resolve().parents if parent.exists())
    what, kept = f"the export to {directory}", "nothing was written"
    require_free_space(there, form.size(), what, kept, several=True)
    if settings.walls != "none":
        metadata["wall_spacing"] = max(each.walls.spacing for each in chosen)
    count = itertools.count(1)
    try:
        with new_directory(directory, settings.overwrite) as temporary:
            more, notes = form.write(temporary, lambda: watch(next(count)))
            text = json.dumps(finite_json(metadata | more), indent=2, allow_nan=False) + "\n"
            (temporary / METADATA).write_text(text, encoding="utf-8", newline="\n")
            sums = {name: path_digest(path) for name, path in _files(temporary).items()}
            (temporary / SUMS).write_text(sums_text(sums), encoding="ascii", newline="\n")
            total = sum(path.stat().st_size for path in _files(temporary).values())
            files = sorted(path.name for path in temporary.iterdir())
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RunError(f"{directory} could not be written ({reason}); nothing of it was left.") from error
    splits = {split: metadata[f"num_trajs_{split}"] for split in SPLITS}
    frames, particles = max(each.frame_count for each in chosen), metadata["num_particles_max"]
    gone = sum(each.source.particle_count for each in chosen) - sum(each.there_count for each in chosen)
    notes += [f"{counted(gone, 'particle')} that are not there in all frames are left out."] * bool(gone)
    notes = [f"The dataset is not complete: {lack}."] * bool(lack) + notes
    return ExportSummary(str(directory), settings.form, files, splits, frames, particles, total, notes)


def check_export_directory(directory: Path, overwrite: bool) -> None:
    """Refuse a directory that is not empty, or, with `overwrite`, contains anything but an earlier export."""
    check_directory(directory, overwrite)
    if directory.resolve() == Path.cwd():
        raise InputError(f"{directory} is the present directory, which an export would replace: give another with -o.")
    if not directory.is_dir():
        return
    names = [path.name for path in directory.iterdir()]
    ours = re.compile("|".join([*map(re.escape, (METADATA, SUMS)), *(format_named(form).files for form in FORMATS)]))
    foreign = sorted(name for name in names if not ours.fullmatch(name))
    if names and (foreign or EXPORTED_BY not in _metadata(directory)):
        what = f"it holds {foreign[0]}" if foreign else f"it has no {METADATA} of mpmcli export"
        raise InputError(f"{directory} is not an earlier export, as {what}: give another directory with -o.")


def _restore_former(directory: Path) -> None:
    """Give an export its name again that a killed one had set aside, or remove it if another has the name."""
    target = directory.resolve()
    former = re.compile(rf"{re.escape(target.name)}\.\d+\.old{re.escape(TEMPORARY_SUFFIX)}")
    for path in target.parent.iterdir() if target.parent.is_dir() else ():
        if former.fullmatch(path.name) and target.exists():
            shutil.rmtree(path, ignore_errors=True)
        elif former.fullmatch(path.name):
            os.rename(path, target)


@contextmanager
def new_directory(directory: Path, overwrite: bool) -> Iterator[Path]:
    """Yield an empty directory to write to; on exit, move it to `directory`; if the block raises, remove it."""
    check_export_directory(directory, overwrite)
    target = directory.resolve()
    missing = [parent for parent in target.parents if not parent.exists()]
    temporary, former = (
        target.with_name(f"{target.name}.{os.getpid()}{end}") for end in (TEMPORARY_SUFFIX, f".old{TEMPORARY_SUFFIX}")
    )
    try:
        try:
            temporary.mkdir(parents=True)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"{directory} cannot be made ({reason}): give another place with -o.") from error
        yield temporary
        with ThreadPoolExecutor(SYNCS) as threads:
            list(threads.map(sync_file, _files(temporary).values()))
        if target.exists():
            # Files may have appeared in it meanwhile.
            check_export_directory(directory, overwrite)
            os.rename(target, former)
        try:
            os.rename(temporary, target)
        except OSError:
            if former.exists():
                os.rename(former, target)
            raise
        sync_directory(target.parent)
        shutil.rmtree(former, ignore_errors=True)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        for parent in missing:
            with suppress(OSError):
                parent.rmdir()
        raise


def _files(directory: Path) -> dict[str, Path]:
    """Return all files below a directory, by their path in it."""
    return {path.relative_to(directory).as_posix(): path for path in directory.rglob("*") if path.is_file()}


def is_export(path: Path) -> bool:
    """Return whether a directory contains an export, complete or not."""
    return path.is_dir() and (EXPORTED_BY in _metadata(path) or ((path / SUMS).exists() and (path / METADATA).exists()))


def verify_export(directory: Path) -> Verification:
    """Compare the files of an export with its checksums."""
    found = Verification(directory)
    found.files, found.faults = sums_faults(directory)
    return found


def _metadata(directory: Path) -> dict[str, Any]:
    try:
        metadata = json.loads((directory / METADATA).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return metadata if isinstance(metadata, dict) else {}
