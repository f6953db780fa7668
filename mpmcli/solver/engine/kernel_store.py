"""Loads the compiled kernel of a batch without Taichi's front end, which takes at least a third of a warm start.

Taichi caches compiled kernels in files, by a hash of their intermediate representation, which its front end must
generate first. The store uses a key of all inputs of a kernel instead, the sources of the package among them. A stub, a
kernel of a few lines that Taichi finds in a millisecond, contains this key in its source. After Taichi has written the
files of both, the file of the stub is replaced by that of the kernel, so that launching the stub runs the kernel.
Taichi verifies the checksum of a file. If the file is damaged or missing, the stub itself is compiled and leaves a
mark; then the kernel is launched. The kernel does not contain the key: edited sources need another stub, but Taichi
finds the kernel if its representation is the same.
"""

import contextlib
import hashlib
import os
import platform
import re
import struct
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil

from mpmcli.quick_taichi import ti
from mpmcli.solver.engine.compiled_kind import CompiledKind
from mpmcli.solver.engine.cpu_launch import CpuLaunch, FrameStats
from mpmcli.solver.engine.cpu_phases import FrameBuffer, RunInts, RunReals
from mpmcli.solver.machine.backend import CACHE_BYTES, Backend, after_stop

# Versions of Taichi with which test_kernel_store.py has passed.
KNOWN_VERSIONS = ((1, 7, 4),)
PACKAGE = Path(__file__).resolve().parents[2]
# Layout of a Taichi file: magic, architecture, lengths of description and code; description, code; SHA-256 of both in
# hexadecimal.
HEAD = struct.Struct("<4sIQQ")
DIGEST = 64
# Taichi's list of its files: length, version, bytes of all files, number of entries; then the entries: key and name of
# the file, each after its length; bytes, and the times of creation and of the last recorded use, s.
LIST, LIST_HEAD = "ticache.tcb", struct.Struct("<Q3HQQ")
ENTRY = struct.Struct("<Q65sQ65sQqq")
# Subpackages from which kernels are generated; their imports are among them, or modules of the package itself.
SOURCES = ("scene", "frames", "stability", "materials", "boundaries", "solver")
# Text that does not affect kernels: docstrings, which start a line, and comment lines.
PROSE = re.compile(rb'^ *""".*?"""\n|^ *#[^\n]*\n', re.MULTILINE | re.DOTALL)
# Upper bound of the difference between the clocks of a file system and of this machine, s.
CLOCKS = 2.0
# Upper bound of the bytes of a file of a stub, and lower bound of those of a kernel.
STUB_BYTES = 2**14
# Suffix of a file that names the replaced file of a stub; its own name is the key of the kernel.
NOTE = ".stub"
# Value that the stub stores in frame_stats[0, 0, 0], which is otherwise never negative.
MARK = -(2**30)
# Environment variable; "off" disables the store, for work on modules while they run.
SWITCH = "MPMCLI_KERNEL_STORE"
# Keys of kernels that this process did not find by their stubs, with their names and the folder of Taichi's files.
_missed: dict[str, tuple[str, Path]] = {}


class StoredLaunch:
    """Launches the kernel of a batch on the CPU: the stored kernel, or that of `CpuLaunch`.

    Attributes:
        stored: whether the kernel was loaded from the store.
    """

    def __init__(self, launch: CpuLaunch, kind: CompiledKind, backend: Backend) -> None:
        self._launch, self._kind, self._backend = launch, kind, backend
        self._kernel: Callable[..., None] | None = None
        self.stored = False

    def is_there(self) -> bool:
        """Return whether the kernel is stored, without launching it."""
        if not self._may_store():
            return False
        key = kernel_key(self._kind, self._backend, self._launch.device.runs, _sources())
        folder = Path(ti.lang.impl.current_cfg().offline_cache_file_path)
        try:
            return (folder / (folder / f"{key}{NOTE}").read_text(encoding="utf-8")).stat().st_size > STUB_BYTES
        except OSError:
            return False

    def __call__(
        self, numbers: np.ndarray, counts: np.ndarray, frame_buffer: np.ndarray, frame_stats: np.ndarray
    ) -> None:
        if self._kernel is None:
            self._first(numbers, counts, frame_buffer, frame_stats)
        else:
            self._kernel(numbers, counts, frame_buffer, frame_stats)

    def _first(
        self, numbers: np.ndarray, counts: np.ndarray, frame_buffer: np.ndarray, frame_stats: np.ndarray
    ) -> None:
        """Launch for the first time: the stored kernel, or the compiled one, which is stored when Taichi stops."""
        name = "launch"
        if self._may_store():
            facts = (self._kind, self._backend, self._launch.device.runs)
            own, key = kernel_key(*facts), kernel_key(*facts, _sources())
            stub, noted = stub_kernel(key), frame_stats[0, 0, 0]
            stub(numbers, counts, frame_buffer, frame_stats)
            if frame_stats[0, 0, 0] != MARK:
                self._kernel, self.stored = stub, True
                return
            frame_stats[0, 0, 0] = noted
            name, self._launch.token = f"launch_{own}", words_of(own)
            _missed[key] = name, Path(ti.lang.impl.current_cfg().offline_cache_file_path)
            after_stop(link_missed)
        with _named(CpuLaunch.launch._primal.func, name):
            self._launch.launch(numbers, counts, frame_buffer, frame_stats)
        self._kernel = self._launch.launch

    def _may_store(self) -> bool:
        """Return whether all inputs of the kernel are known; laws and features from elsewhere may import anything."""
        parts = (*self._kind.members, *self._launch.device.features)
        own = all(type(part).__module__.startswith("mpmcli.") for part in parts)
        known = own and ti.__version__ in KNOWN_VERSIONS and _unchanged_since(psutil.Process().create_time())
        return known and self._backend.compile_cache and os.environ.get(SWITCH) != "off"


@contextlib.contextmanager
def _named(function: Callable, name: str) -> Iterator[None]:
    """Rename a function temporarily; Taichi uses the name for the compiled code."""
    usual, function.__name__ = function.__name__, name
    try:
        yield
    finally:
        function.__name__ = usual


def words_of(key: str) -> tuple[int, ...]:
    """Return a key as numbers of 28 bits."""
    return tuple(int(key[i : i + 7], 16) for i in range(0, len(key), 7))


def stub_kernel(key: str) -> Callable[..., None]:
    """Return the stub of a key; each key gives a different kernel for Taichi."""
    words = words_of(key)

    def stub(numbers: RunReals, counts: RunInts, frame_buffer: FrameBuffer, frame_stats: FrameStats):
        for word in ti.static(words):
            frame_stats[0, 0, 0] = word
        frame_stats[0, 0, 0] = MARK

    stub.__name__ = f"stub_{key}"
    return ti.kernel(stub)


def kernel_key(kind: CompiledKind, backend: Backend, runs: int, sources: str = "") -> str:
    """Return a key of the inputs of the kernel of a batch, including the memory layout of its fields.

    Without the digest of the sources of the package, kernels of other sources have the same key.
    """
    ti.lang.impl.get_runtime().materialize()
    config = ti.lang.impl.current_cfg()
    # Settings that do not affect code are excluded; Taichi leaves one of them uninitialised.
    beside = ("_", "print_", "offline_cache")
    settings = [(name, str(getattr(config, name))) for name in dir(config) if not name.startswith(beside)]
    facts = (kind, backend, runs, settings, _layout(), _machine(), sources)
    return hashlib.sha256(repr(facts).encode()).hexdigest()[:32]


def _layout() -> list[tuple]:
    """Return the memory layout of all fields: kind, number of children, size and offset of each node of Taichi."""
    program = ti.lang.impl.get_runtime().prog
    found = []
    waiting = [program.get_snode_root(tree) for tree in range(program.get_snode_tree_size())]
    while waiting:
        node = waiting.pop()
        children = [node.get_ch(k) for k in range(node.get_num_ch())]
        kind = str(node.data_type()) if node.is_place() else str(node.type)
        found.append((kind, len(children), node.cell_size_bytes, node.offset_bytes_in_parent_cell))
        waiting += children
    return found


@cache
def _machine() -> tuple:
    """Return the versions and processor features on which kernels depend."""
    features = platform.processor()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        features = next((line for line in lines if line.startswith(("flags", "Features"))), features)
    return platform.system(), platform.machine(), features, sys.version_info[:3], ti.__version__, np.__version__


def _files() -> list[Path]:
    """Return the modules from which kernels are generated."""
    return sorted([*PACKAGE.glob("*.py"), *(path for part in SOURCES for path in (PACKAGE / part).rglob("*.py"))])


def _unchanged_since(began: float) -> bool:
    """Return whether these modules are files older than this process, s, and hence equal to the imported ones."""
    found = [os.stat(path) for path in _files()]
    return bool(found) and all(max(one.st_mtime, one.st_ctime) < began - CLOCKS for one in found)


@cache
def _sources() -> str:
    """Return a digest of the modules from which kernels are generated, without docstrings and comments."""
    digest = hashlib.sha256()
    for path in _files():
        digest.update(f"{path.relative_to(PACKAGE)}\0".encode() + PROSE.sub(b"", path.read_bytes()) + b"\0")
    return digest.hexdigest()


class TaichiFile(NamedTuple):
    """A file of Taichi: its size and that when Taichi wrote it, bytes; times of creation and of the last use, s."""

    path: Path
    size: int
    written: int
    created: int
    used: int


def link_missed() -> None:
    """Replace the files of stubs by those of the kernels launched in their place, after Taichi has written both."""
    while _missed:
        key, (name, folder) = _missed.popitem()
        with contextlib.suppress(OSError):
            _link(key, name, folder)
            _remove_oldest(folder)


def _link(key: str, name: str, folder: Path) -> None:
    """Replace the file of a stub by that of the kernel of this name which was used when the stub was compiled.

    Taichi records uses, in seconds, when it writes what the process compiled; a stub is compiled before its kernel is
    found. If a kernel of other sources was used as well, the stub stays.
    """
    files = _files_of_taichi(folder)
    for stub in files:
        if stub.size < STUB_BYTES and f"stub_{key}".encode() in stub.path.read_bytes():
            recent = (file.path.read_bytes() for file in files if file.used >= stub.created)
            kernels = {content for content in recent if name.encode() in content}
            if len(kernels) == 1 and _is_sound(*kernels):
                _write(stub.path, *kernels)
                _write(folder / f"{key}{NOTE}", stub.path.name.encode())


def _remove_oldest(folder: Path) -> None:
    """Remove the stubs replaced first, of which Taichi knows only the former size, beyond the size of the cache."""
    replaced = [file for file in _files_of_taichi(folder) if file.written < STUB_BYTES < file.size]
    beyond = sum(file.size for file in replaced) - CACHE_BYTES
    for file in sorted(replaced, key=lambda file: file.path.stat().st_mtime):
        if beyond > 0:
            file.path.unlink(missing_ok=True)
            beyond -= file.size


def _files_of_taichi(folder: Path) -> list[TaichiFile]:
    """Return the files on Taichi's list that exist."""
    content = (folder / LIST).read_bytes()
    if (len(content) - LIST_HEAD.size) % ENTRY.size:
        return []
    found = []
    for _, _, _, name, written, created, used in ENTRY.iter_unpack(content[LIST_HEAD.size :]):
        path = folder / f"{name.decode()}.tic"
        if path.exists():
            found.append(TaichiFile(path, path.stat().st_size, written, created, used))
    return found


def _is_sound(content: bytes) -> bool:
    """Return whether the checksum of a Taichi file is correct."""
    if len(content) < HEAD.size + DIGEST:
        return False
    _, _, described, code = HEAD.unpack_from(content)
    body, digest = content[HEAD.size : -DIGEST], content[-DIGEST:]
    return len(body) == described + code and hashlib.sha256(body).hexdigest().encode() == digest


def _write(path: Path, content: bytes) -> None:
    """Replace or create a file atomically; raise OSError if it cannot be written, and leave it unchanged."""
    part = path.parent / f"mpmcli-{os.getpid()}.part"
    try:
        part.write_bytes(content)
        os.replace(part, path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
