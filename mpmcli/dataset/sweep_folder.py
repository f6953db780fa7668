"""The directory of a sweep: made for a new one, opened again for one that is to be resumed."""

import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np

from mpmcli import __version__
from mpmcli.check.forecast import layout_of
from mpmcli.dataset.draw import draw
from mpmcli.dataset.folder import SHARD_BYTES, Folder, require_empty
from mpmcli.dataset.manifest import MANIFEST, Manifest
from mpmcli.dataset.paths import BASE, SWEEP
from mpmcli.dataset.shard import LABELS
from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.sweep_state import SweepSettings
from mpmcli.errors import InputError
from mpmcli.materials.registry import load_plugins
from mpmcli.output.durable import SPACE_MARGIN, TEMPORARY_SUFFIX, write_text
from mpmcli.output.lock import LOCK, refuse_locked, take_lock
from mpmcli.plain_text import counted, size_text
from mpmcli.scene import Scene, estimate_particles

# Trajectories whose sizes give the size of all.
SAMPLE = 16
# Bytes of a trajectory beside its arrays: headers of HDF5 and the scene; times and ledger of a frame.
HEADER_BYTES, FRAME_BYTES = 11_000, 200


@contextmanager
def taken_folder(sweep: Sweep, settings: SweepSettings) -> Iterator[tuple[Folder, Manifest]]:
    """Make the directory of a dataset, or open the one that is to be resumed, and keep other sweeps out of it.

    One process writes the manifest and the shards of a directory; workers, of this machine or others, write the
    trajectories that it asks them for, and parts of a sweep have directories of their own.

    Raises:
        InputError: as `open_folder`, or another process writes the directory.
    """
    directory = settings.directory
    if directory.is_dir():
        refuse_locked(directory)
        if settings.resume:
            with take_lock(directory):
                yield open_folder(sweep, settings)
            return
    with ExitStack() as held:
        yield open_folder(sweep, settings, lambda: held.enter_context(take_lock(directory)))


def open_folder(
    sweep: Sweep, settings: SweepSettings, take: Callable[[], object] = lambda: None
) -> tuple[Folder, Manifest]:
    """Make the directory of a dataset, or open the one that is to be resumed.

    Args:
        take: called before the first file is written into the directory.

    Raises:
        InputError: it holds something else, or the dataset of another sweep; the disk or the part is too small; no
            trajectory can be drawn. Nothing was written.
    """
    directory = settings.directory
    manifest = Manifest(directory)
    if settings.resume and (directory / MANIFEST).exists():
        facts = manifest.facts()
        if facts["key"] != sweep.key:
            raise InputError(
                f"{directory} holds the dataset of another sweep, or of another count: give another directory with "
                f"-o, or the sweep of {directory / SWEEP}."
            )
        if tuple(facts["part"]) != settings.part:
            i, n = facts["part"]
            raise InputError(f"{directory} holds part {i}/{n} of the sweep; resume it with --shard {i}/{n}.")
        return Folder(directory, sweep.count, facts["per_shard"], settings.part), manifest
    if (directory / MANIFEST).exists():
        raise InputError(f"{directory} holds a dataset: --resume goes on with it, and -o gives another directory.")
    if not (settings.resume and _is_beginning(directory)):
        require_empty(directory)
    size = _bytes_of_trajectories(sweep, settings)
    per_shard = _per_shard(size)
    folder = Folder(directory, sweep.count, per_shard, settings.part)
    own = sum(len(folder.numbers(shard)) for shard in folder.shards)
    if own == 0:
        i, n = settings.part
        shards = math.ceil(sweep.count / per_shard)
        raise InputError(f"--shard {i}/{n} is empty: {sweep.count} trajectories fill {counted(shards, 'shard')}.")
    # While a shard is sealed, its trajectories lie there twice.
    needed = size * own + SHARD_BYTES + SPACE_MARGIN
    free = shutil.disk_usage(next(p for p in (directory, *directory.resolve().parents) if p.exists())).free
    if needed > free:
        raise InputError(
            f"the disk of {directory} has {size_text(free)} left, but the dataset needs about {size_text(needed)}: "
            "give another place with -o, or a smaller --count."
        )
    directory.mkdir(parents=True, exist_ok=True)
    take()
    if not settings.resume:
        # Another sweep may have come and gone meanwhile.
        require_empty(directory, locked=True)
    write_text(directory / SWEEP, sweep.text)
    write_text(directory / BASE, sweep.base_text)
    manifest.create(
        {
            "key": sweep.key,
            "count": sweep.count,
            "seed": sweep.seed,
            "accept": sweep.accept,
            "per_shard": per_shard,
            "part": list(settings.part),
            "version": __version__,
        }
    )
    return folder, manifest


def discard_beginning(directory: Path, made: Sequence[Path]) -> None:
    """Remove a dataset in which no trajectory has been done.

    Args:
        made: the directories that were made for it, outermost first.

    Raises:
        InputError: another process writes it.
    """
    if not (directory / MANIFEST).exists() or Manifest(directory).rows():
        return
    with take_lock(directory):
        Folder(directory, 0, 1, (1, 1)).close()
        for name in (SWEEP, BASE, MANIFEST):
            (directory / name).unlink(missing_ok=True)
    for path in reversed(made):
        with suppress(OSError):
            path.rmdir()


def _is_beginning(directory: Path) -> bool:
    """Return whether a sweep was killed here before it had a manifest."""
    texts = {SWEEP, BASE, MANIFEST, LOCK}
    return directory.is_dir() and all(
        path.name.removesuffix(TEMPORARY_SUFFIX).removesuffix("-journal") in texts for path in directory.iterdir()
    )


def shard_size(sweep: Sweep, settings: SweepSettings) -> int:
    """Return the number of trajectories in a shard.

    Raises:
        InputError: no trajectory can be drawn.
    """
    return _per_shard(_bytes_of_trajectories(sweep, settings))


def trajectory_bytes(scene: Scene, particles: int) -> int:
    """Return the bytes of a trajectory without compression."""
    arrays = [array for name, array in layout_of(scene).arrays.items() if name not in ("id", *LABELS)]
    each = sum(np.dtype(array.dtype).itemsize * math.prod(array.shape) for array in arrays)
    return (scene.time.frames + 1) * (particles * each + FRAME_BYTES) + HEADER_BYTES


def _per_shard(size: float) -> int:
    return max(1, math.floor(SHARD_BYTES / size))


def _bytes_of_trajectories(sweep: Sweep, settings: SweepSettings) -> float:
    """Return the mean bytes of a trajectory without compression, from the first ones that can be drawn."""
    laws = load_plugins(settings.plugins)
    sizes, fault = [], None
    for number in range(min(SAMPLE, sweep.count)):
        try:
            scene = draw(sweep, number).scene(laws).scene
            sizes.append(trajectory_bytes(scene, estimate_particles(scene)))
        except InputError as error:
            fault = error
    if not sizes:
        raise fault
    return sum(sizes) / len(sizes)
