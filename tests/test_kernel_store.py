"""Stored kernels are those that would be compiled, and whatever happens to their files, no other code runs."""

import ast
import errno
import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import ROOT
from scenes import block, body, box, liquid, scene_of, solid

from mpmcli.boundaries.feature import Feature
from mpmcli.materials import fluid
from mpmcli.scene import Scene
from mpmcli.solver.engine import batch, kernel_store
from mpmcli.solver.engine.compiled_kind import CompiledKind
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.machine.backend import Backend, choose_backend, start, stop_backend


def drop(**tables: object) -> Scene:
    """Return the scene of a block that falls, 10 x 8 cells, of the law that compiles fastest."""
    block = body("block", solid(1e5, law="fixed_corotated"), box([0.2, 0.3], [0.5, 0.6]))
    usual = {
        "domain": {"size": [1.0, 0.8], "spacing": 0.1, "gravity": [0.0, -9.81]},
        "time": {"end": 0.01, "frames": 1},
        "bodies": [block],
    }
    return scene_of(**{**usual, **tables})


@dataclass(frozen=True)
class Outcome:
    """The bytes of the last frame, whether a stored kernel computed them, and whether it was known to be there."""

    frame: bytes
    stored: bool
    known: bool = field(compare=False)


def outcome(scene: Scene, threads: int = 1, *, compile_cache: bool = True) -> Outcome:
    """Run a scene on a backend of its own, whose end is that of its process for the files of kernels."""
    stop_backend()
    backend = start(choose_backend("cpu", threads, "f32", compile_cache=compile_cache, optimisation="few"))
    try:
        run = build_run(scene, backend)
        known = run.batch.launch_cpu.is_there()
        *_, (frame, _row) = run.frames()
        return Outcome(frame.position.tobytes() + frame.velocity.tobytes(), run.batch.launch_cpu.stored, known)
    finally:
        stop_backend()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of Taichi's files of its own, with the store."""
    stop_backend()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    yield tmp_path / "taichi" / "ticache"
    stop_backend()


def kernels_in(folder: Path) -> list[Path]:
    """Return the files that hold a kernel of the store."""
    return [path for path in folder.glob("*.tic") if b"launch_" in path.read_bytes()]


def test_a_kernel_is_stored_and_found(folder: Path) -> None:
    """The same bytes from a kernel compiled and stored, and for other particles."""
    scene = drop()
    fresh = outcome(scene, compile_cache=False)
    assert not fresh.stored and not kernels_in(folder)
    compiled = outcome(scene)
    assert compiled == fresh and not (fresh.known or compiled.known)
    assert len(kernels_in(folder)) == 2
    found = outcome(scene)
    assert found == replace(fresh, stored=True) and found.known
    # Another start, and another number of particles.
    body = scene.bodies[0].model_copy(update={"velocity": (0.1, 0.0)})
    assert outcome(scene.model_copy(update={"bodies": (body,)})).stored


@pytest.mark.slow
def test_a_kernel_of_two_threads_is_stored_and_found(folder: Path) -> None:
    fresh = outcome(drop())
    assert outcome(drop(), 2) == fresh
    assert outcome(drop(), 2) == replace(fresh, stored=True)


@pytest.mark.slow
def test_a_sparse_grid_that_grows_has_kernels_of_its_own(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is room for few blocks, a run goes on with another grid, and so with another kernel."""
    domain = {"size": [4.0, 4.0], "spacing": 0.1, "gravity": [0.0, -9.81]}
    scene = drop(domain=domain, solver={"grid": "sparse"})
    fresh = outcome(scene, compile_cache=False)
    monkeypatch.setattr(batch, "room_for_blocks", lambda particles: 3)
    grown: list[int] = []
    grow = batch.Batch.grow
    monkeypatch.setattr(batch.Batch, "grow", lambda self, blocks: (grown.append(blocks), grow(self, blocks)))
    assert outcome(scene) == fresh
    assert outcome(scene) == replace(fresh, stored=True)
    assert len(grown) == 2


def tic(code: bytes) -> bytes:
    """Return a file of Taichi."""
    head = kernel_store.HEAD.pack(b"TIC\0", 0, 0, len(code))
    return head + code + hashlib.sha256(code).hexdigest().encode()


def files_of_taichi(
    folder: Path, files: dict[str, tuple[int, int, bytes]], written: dict[str, int] | None = None
) -> list[Path]:
    """Write files, with times of creation and use, and Taichi's list of them, with the sizes that it wrote."""
    names = {name: f"T{hashlib.sha256(name.encode()).hexdigest()}" for name in files}
    rows = b""
    for name, (created, used, content) in files.items():
        size, file = (written or {}).get(name, len(content)), names[name].encode()
        rows += kernel_store.ENTRY.pack(65, file, 65, file, size, created, used)
        (folder / f"{names[name]}.tic").write_bytes(content)
    head = kernel_store.LIST_HEAD.pack(kernel_store.LIST_HEAD.size + len(rows), 1, 7, 4, 0, len(files))
    (folder / kernel_store.LIST).write_bytes(head + rows)
    return [folder / f"{name}.tic" for name in names.values()]


HARMS = {
    "flip": lambda content: content[: len(content) // 2] + b"~" + content[len(content) // 2 + 1 :],
    "cut": lambda content: content[:-100],
    "empty": lambda content: b"",
    "remove": lambda content: None,
}


@pytest.mark.parametrize(
    ("harm", "which"),
    [
        pytest.param(harm, which, marks=[pytest.mark.slow] * ((harm, which) != ("flip", "all")))
        for harm in HARMS
        for which in ("first", "second", "all")
    ],
)
def test_a_file_that_is_harmed_is_not_run(folder: Path, harm: str, which: str) -> None:
    """Of the two files that hold the kernel one is harmed, or both: it is compiled anew."""
    scene = drop()
    fresh = outcome(scene)
    for path in kernels_in(folder)[{"first": slice(0, 1), "second": slice(1, 2), "all": slice(None)}[which]]:
        content = HARMS[harm](path.read_bytes())
        if content is None:
            path.unlink()
        else:
            path.write_bytes(content)
    found = [outcome(scene) for _ in range(3)]
    assert {one.frame for one in found} == {fresh.frame}
    assert which != "all" or not found[0].stored


def test_a_file_that_cannot_be_written_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk leaves the file as it was, and no part of another."""
    path = tmp_path / "a.tic"
    path.write_bytes(b"whole")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(kernel_store.os, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        kernel_store._write(path, b"other")
    assert [*tmp_path.iterdir()] == [path] and path.read_bytes() == b"whole"


def test_the_key_has_all_that_a_kernel_is_made_from(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another law, wall, precision of the solver, number of threads or runs; processor; fields before it; source."""

    def key(scene: Scene, threads: int = 1, runs: int = 1, before: int = 0, sources: str = "") -> str:
        backend = start(choose_backend("cpu", threads, "f32"))
        for _ in range(before):
            build_run(drop(), backend)
        run = build_run(scene, backend)
        kind = Resolved(scene).kind.padded()
        assert kind == run.batch.kind
        found = kernel_store.kernel_key(kind, backend, runs, sources)
        stop_backend()
        return found

    usual = key(drop())
    assert key(drop(time={"end": 2.0, "frames": 7})) == usual
    solid = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5}
    body = block("block", solid, [0.2, 0.3], [0.5, 0.6])
    domain = {"size": [1.0, 0.8], "spacing": 0.1, "gravity": [0.0, -9.81]}
    others = [
        key(drop(bodies=[body])), key(drop(domain={**domain, "walls": "stick"})),
        key(drop(domain={**domain, "spacing": 0.01})), key(drop(solver={"transfer": "aflip"})), key(drop(), threads=2),
        key(drop(), runs=2), key(drop(), before=1), key(drop(), sources="another"),
    ]  # fmt: skip
    with monkeypatch.context() as patch:
        patch.setattr(kernel_store, "_machine", lambda: "another")
        others.append(key(drop()))
    with monkeypatch.context() as patch:
        patch.setenv("TI_ADVANCED_OPTIMIZATION", "1")
        others.append(key(drop()))
    assert len({usual, *others}) == 1 + len(others)


def test_edited_sources_compile_what_they_change(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another sentence in the sources needs a stub, not a kernel; another constant of a law needs a kernel.

    Sources that return find theirs, and of two kernels of one name the one in use is linked.
    """
    material = liquid(1e5, exponent=7.0)
    block = drop().bodies[0].model_dump(include={"name", "shape"})
    time_of = {"end": 0.02, "frames": 1}  # Longer than a step with either constant.
    scene = drop(bodies=[block | {"material": material}], solver={"redistribute": False}, time=time_of)
    usual = outcome(scene)

    def edited(sources: str, crushed: float, kernels: int) -> Outcome:
        """Run twice with other sources; there are so many kernels then."""
        with monkeypatch.context() as patch:
            patch.setattr(kernel_store, "_sources", lambda: sources)
            patch.setattr(fluid, "CRUSHED", crushed)
            first, second = outcome(scene), outcome(scene)
        assert second == replace(first, stored=True)
        assert len({path.read_bytes() for path in kernels_in(folder)}) == kernels
        return first

    assert edited("a sentence", fluid.CRUSHED, 1) == usual
    constant = edited("a constant", 1.5, 2)
    assert not constant.stored and constant.frame != usual.frame
    assert outcome(scene) == replace(usual, stored=True)
    # Taichi records uses in seconds.
    time.sleep(1.1)
    assert edited("another sentence", fluid.CRUSHED, 2) == usual
    assert edited("a constant", 1.5, 2) == replace(constant, stored=True)


def test_a_stale_kernel_is_not_linked(tmp_path: Path) -> None:
    """A stub becomes the kernel of its name that was used when it was compiled, if that is sound and the only one."""
    usual = {"stub": (20, 20, b"stub_key"), "a": (10, 20, tic(b"launch_own, a")), "b": (5, 19, tic(b"launch_own, b"))}

    def linked(**changed: tuple[int, int, bytes]) -> bytes:
        """Return the file of the stub after linking; a file is created and used at two times, s."""
        stub, *_ = files_of_taichi(tmp_path, {**usual, **changed})
        kernel_store._link("key", "launch_own", tmp_path)
        return stub.read_bytes()

    *_, a = usual["a"]
    *_, b = usual["b"]
    assert linked() == linked(b=(5, 20, a)) == linked(b=(5, 20, tic(b"launch_other"))) == a
    assert linked(a=(10, 19, a), b=(5, 20, b)) == b
    for changed in ({"b": (5, 20, b)}, {"a": (10, 19, a)}, {"a": (10, 20, a[:-1])}, {"a": (10, 20, b"")}):
        assert linked(**changed) == b"stub_key", changed


def test_replaced_stubs_do_not_fill_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first ones go; kernels, whose size Taichi knows, and stubs that are not replaced are Taichi's."""
    large = bytes(2 * kernel_store.STUB_BYTES)
    files = {name: (0, 0, content) for name, content in (("a", large), ("b", large), ("kernel", large), ("stub", b""))}
    monkeypatch.setattr(kernel_store, "CACHE_BYTES", 2 * len(large))
    paths = files_of_taichi(tmp_path, files, {"a": 10, "b": 10, "kernel": len(large), "stub": 0})
    for k, path in enumerate(paths):
        os.utime(path, (k, k))
    kernel_store._remove_oldest(tmp_path)
    assert all(path.exists() for path in paths)
    monkeypatch.setattr(kernel_store, "CACHE_BYTES", len(large))
    kernel_store._remove_oldest(tmp_path)
    assert [path.exists() for path in paths] == [False, True, True, True]


def test_sources_are_all_that_kernels_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A changed line of any module that the solver may import changes the digest, and one of a command does not."""
    for path in (ROOT / "mpmcli").rglob("*.py"):
        copy = tmp_path / path.relative_to(ROOT / "mpmcli")
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())
    monkeypatch.setattr(kernel_store, "PACKAGE", tmp_path)

    def digest() -> str:
        kernel_store._sources.cache_clear()
        return kernel_store._sources()

    try:
        usual = digest()
        for name in ("solver/grid/grid.py", "materials/fluid.py", "scene/schema.py", "stability/transfer_factors.py"):
            path = tmp_path / name
            text = path.read_text(encoding="utf-8")
            path.write_text(text + "\nchanged = True\n", encoding="utf-8")
            assert digest() != usual, name
            path.write_text(text.replace('"""', '"""Changed. ', 1) + "# changed\n", encoding="utf-8")
            assert digest() == usual, name
            path.write_text(text, encoding="utf-8")
            assert digest() == usual
        (tmp_path / "cli" / "simulate.py").write_text("", encoding="utf-8")
        assert digest() == usual
    finally:
        kernel_store._sources.cache_clear()


def test_prose_is_docstrings_and_comments() -> None:
    """Of every module that kernels are made from, the digest leaves out the docstrings, and no more."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    for path in kernel_store._files():
        source = path.read_bytes()
        nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, documented)]
        lines = sorted(node.body[0].lineno for node in nodes if ast.get_docstring(node) is not None)
        prose = [match for match in kernel_store.PROSE.finditer(source) if match[0].lstrip().startswith(b'"""')]
        assert [source.count(b"\n", 0, match.start()) + 1 for match in prose] == lines, path


def test_what_is_not_known_is_not_stored(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Laws or features from elsewhere, another version of Taichi, modules younger than the process, no cache."""
    scene = drop()
    kind = Resolved(scene).kind
    backend = choose_backend("cpu", 1, "f32")

    def may_store(kind: CompiledKind = kind, backend: Backend = backend, features: Sequence[Feature] = ()) -> bool:
        launch = SimpleNamespace(device=SimpleNamespace(features=features))
        return kernel_store.StoredLaunch(launch, kind, backend)._may_store()

    monkeypatch.setattr(kernel_store, "_unchanged_since", lambda began: True)
    assert may_store() and may_store(features=[Feature()])
    assert not may_store(features=[type("Marker", (Feature,), {"__module__": "marker"})()])
    foreign = type("Law", (type(kind.members[0]),), {"__module__": "law"})
    assert not may_store(replace(kind, members=(object.__new__(foreign),)))
    assert not may_store(backend=replace(backend, compile_cache=False))
    with monkeypatch.context() as patch:
        patch.setattr(kernel_store, "KNOWN_VERSIONS", ((1, 7, 3),))
        assert not may_store()
    with monkeypatch.context() as patch:
        patch.setenv(kernel_store.SWITCH, "off")
        assert not may_store()
    monkeypatch.undo()
    monkeypatch.setattr(kernel_store, "PACKAGE", tmp_path)
    assert not kernel_store._unchanged_since(0.0)
    (tmp_path / "module.py").write_text("", encoding="utf-8")
    changed = (tmp_path / "module.py").stat().st_mtime
    assert not kernel_store._unchanged_since(changed - 10) and not kernel_store._unchanged_since(changed + 1)
    assert kernel_store._unchanged_since(changed + 10)


PROCESS = """
import sys
from test_kernel_store import drop, outcome
found = outcome(drop())
print(found.stored, found.frame.hex())
"""


def process(folder: Path) -> subprocess.Popen:
    """Start a process that runs the scene with the files in a folder."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    environment = {**os.environ, "PYTHONPATH": path, "XDG_CACHE_HOME": str(folder.parent.parent)}
    return subprocess.Popen([sys.executable, "-c", PROCESS], stdout=subprocess.PIPE, text=True, env=environment)


@pytest.mark.slow
def test_processes_at_once_store_the_same_kernel(folder: Path) -> None:
    fresh = outcome(drop(), compile_cache=False)
    found = [one.communicate(timeout=300)[0].split()[-1] for one in [process(folder), process(folder)]]
    assert set(found) == {fresh.frame.hex()}
    assert outcome(drop()) == replace(fresh, stored=True)


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, 200])
def test_a_killed_process_leaves_no_other_code(folder: Path, kills: int) -> None:
    """Killed at any moment of a run and of its end, it leaves files with which the bytes are the same."""
    fresh = outcome(drop(), compile_cache=False)
    began = time.monotonic()
    process(folder).communicate(timeout=300)
    lasts = time.monotonic() - began
    for k in range(kills):
        if k % 10 == 0:
            for path in [*folder.glob("*")]:
                path.unlink()
        one = process(folder)
        time.sleep(lasts * (0.5 + 0.55 * ((k * 0.618) % 1)))
        one.send_signal(signal.SIGKILL)
        one.communicate(timeout=60)
        if kills < 10 or k % 10 == 9:
            assert outcome(drop()).frame == fresh.frame
    assert outcome(drop()).frame == fresh.frame
