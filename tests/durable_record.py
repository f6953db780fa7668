"""What a power cut would leave of a directory, recorded while a program writes into it.

Contents are as they were last synced, and empty where they never were. Names are as of the last sync of their
directory, in five variants, since a file system may write names sooner, and in any order.
"""

import os
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import RLock

import pytest

# Path relative to the root: content, None for a directory.
Image = Mapping[str, bytes | None]
Names = dict[str, int]
# Which names a directory has, of those that were synced and those of the moment.
VARIANTS: dict[str, Callable[[Names, Names], Names]] = {
    "synced names": lambda synced, live: synced,
    "names of the moment": lambda synced, live: live,
    "removed names come back": lambda synced, live: synced | live,
    "old files under their names": lambda synced, live: live | synced,
    # The folder of the run is as of the moment, and in those below it removed names come back.
    "removed names come back below": lambda synced, live: (
        live if {"scene.toml", "out", "run"} & {*live} else synced | live
    ),
}


@dataclass
class DurableRecord:
    """The durable state of everything below a directory.

    Attributes:
        root: the directory, which is durable with what it holds at the start.
        events: number of syncs, renames and removals so far.
        images: what a cut after one of them leaves, with the answer of `label` at the moment; each pair once.
    """

    root: Path
    label: Callable[[], int]
    events: int = 0
    images: dict[tuple, tuple[Image, int, str]] = field(default_factory=dict)
    _contents: dict[int, bytes] = field(default_factory=dict)
    _names: dict[int, Names] = field(default_factory=dict)
    _kinds: dict[int, bool] = field(default_factory=dict)
    # Of everything seen, so that no number of a file is used again.
    _held: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for folder, _, files in os.walk(self.root):
            for path in (folder, *(os.path.join(folder, name) for name in files)):
                descriptor = os.open(path, os.O_RDONLY)
                self.synced(descriptor)
                os.close(descriptor)

    def synced(self, descriptor: int) -> None:
        """Note that a file or directory was synced."""
        number = self._hold(descriptor)
        if self._kinds[number]:
            self._names[number] = self._live(os.readlink(f"/proc/self/fd/{descriptor}"))
        else:
            self._contents[number] = os.pread(self._held[number], os.fstat(descriptor).st_size, 0)

    def cut(self, event: str) -> None:
        """Note what a power cut at this moment leaves."""
        self.events += 1
        label = self.label()
        for variant, choose in VARIANTS.items():
            image = dict(self._below(self.root, os.stat(self.root).st_ino, "", choose))
            # The same content is the same object.
            key = (label, *sorted((path, id(content)) for path, content in image.items()))
            self.images.setdefault(key, (image, label, f"{variant} after {event}"))

    def close(self) -> None:
        for descriptor in self._held.values():
            os.close(descriptor)

    def _hold(self, descriptor: int) -> int:
        found = os.fstat(descriptor)
        if found.st_ino not in self._held:
            self._held[found.st_ino] = os.open(f"/proc/self/fd/{descriptor}", os.O_RDONLY)
            self._kinds[found.st_ino] = stat.S_ISDIR(found.st_mode)
        return found.st_ino

    def _live(self, folder: str | Path | None) -> Names:
        names: Names = {}
        if folder is not None and os.path.isdir(folder):
            for name in os.listdir(folder):
                descriptor = os.open(os.path.join(folder, name), os.O_RDONLY)
                names[name] = self._hold(descriptor)
                os.close(descriptor)
        return names

    def _below(
        self, folder: Path | None, number: int, prefix: str, choose: Callable[[Names, Names], Names]
    ) -> Iterator[tuple[str, bytes | None]]:
        live = self._live(folder)
        for name, child in choose(self._names.get(number, {}), live).items():
            if self._kinds[child]:
                yield prefix + name, None
                there = folder / name if folder is not None and live.get(name) == child else None
                yield from self._below(there, child, f"{prefix}{name}/", choose)
            else:
                yield prefix + name, self._contents.get(child, b"")


@contextmanager
def recorded(root: Path, label: Callable[[], int]) -> Iterator[DurableRecord]:
    """Record what this process does below `root`; `label` tells how far it has come."""
    root = root.resolve()
    record = DurableRecord(root, label)
    sync = os.fsync
    # Frames are sealed by a thread: what it does and what is noted of it are one.
    lock = RLock()

    def watched_sync(descriptor: int) -> None:
        with lock:
            sync(descriptor)
            path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
            if path.is_relative_to(root):
                record.synced(descriptor)
                record.cut(f"the sync of {path.relative_to(root)}")

    def watched(name: str) -> Callable[..., None]:
        act = getattr(os, name)

        def call(*arguments: object, **more: object) -> None:
            with lock:
                act(*arguments, **more)
                path = Path(arguments[1] if name in ("replace", "rename") else arguments[0]).absolute()
                if path.is_relative_to(root):
                    record.cut(f"{name} of {path.relative_to(root)}")

        return call

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", watched_sync)
        for name in ("replace", "rename", "unlink", "rmdir", "mkdir"):
            patch.setattr(os, name, watched(name))
        try:
            yield record
        finally:
            record.close()


def make_copy(image: Image, folder: Path) -> Path:
    """Write what a power cut leaves into a new folder."""
    folder.mkdir()
    for path, content in image.items():
        place = folder / path
        if content is None:
            place.mkdir()
        else:
            place.write_bytes(content)
    return folder
