"""Files that contradict themselves: refused with a sentence before they cost time, memory or the interpreter."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyvista as pv
from changed_result import changed
from command import run_here
from conftest import ROOT
from made_dataset import made_dataset
from made_result import write_made

from mpmcli.dataset.folder import Manifest, Row
from mpmcli.dataset.shard import checksum
from mpmcli.errors import InputError
from mpmcli.output import open_result, read_record
from mpmcli.plain_text import escaped
from mpmcli.scene.points import GeometryFileError, read_geometry
from mpmcli.scene.toml_file import apply_overrides, copied, too_deep

# A file of each kind, each of which once ended a command with a traceback.
CORPUS = ROOT / "tests" / "corpus"
READ = [("info", "{}"), ("check", "{}"), ("info", "{}", "--verify"), ("plot", "{}"), ("export", "{}", "--to", "npz")]
SCENE = """\
domain = {{ size = [2.0, 2.0, 2.0], cells = [16, 16, 16] }}
time = {{ end = 0.1, frames = 4 }}
[[bodies]]
name = "thing"
material = "jelly"
shape = {{ {shape} = {{ file = "{file}", {more} }} }}
"""


def with_manifest(directory: Path) -> Path:
    """Write a dataset of four trajectories with its manifest."""
    manifest = Manifest(made_dataset(directory))
    facts = {"count": 4, "seed": 0, "accept": "stable", "per_shard": 2, "part": [1, 1], "version": "0.1"}
    manifest.create({"key": "k", **facts})
    for shard in sorted((directory / "shards").iterdir()):
        with h5py.File(shard) as file:
            for group in file.values():
                known = {"verdict": "stable", "accepted": 1, "file": f"shards/{shard.name}", "draws": "{}"}
                known |= {"checksum": checksum(group), "frames": 11, "particles": group["position"].shape[1]}
                row = Row.failed(int(group.attrs["number"]), str(group.attrs["split"]))
                manifest.put([Row(**{**vars(row), **known})])
    return directory


def put(name: str, directory: Path) -> tuple[Path, list[tuple[str, ...]]]:
    """Put a file of the corpus where a command finds it; return what is given to the commands, and these."""
    checks = [("check", "{}"), ("info", "{}")]
    if name in ("mesh.obj", "points.npy"):
        shape, _, _ = name.partition(".")
        more = "" if shape == "mesh" else 'spacing = 0.1, velocity = ["vx", "vy", "vz"]'
        (directory / "scene.toml").write_text(SCENE.format(shape=shape, file=name, more=more), encoding="utf-8")
        shutil.copy(CORPUS / name, directory)
        return directory / "scene.toml", checks
    if name == "sweep.toml":
        shutil.copy(CORPUS / name, directory)
        shutil.copy(ROOT / "configs" / "jelly_drop_3d.toml", directory / "base.toml")
        return directory / name, [("sweep", "{}", "--dry-run")]
    if name.endswith(".toml"):
        return shutil.copy(CORPUS / name, directory), checks
    if name == "manifest.sqlite":
        shutil.copy(CORPUS / name, with_manifest(directory / "data"))
        return directory / "data", [("dataset", "status", "{}"), ("dataset", "verify", "{}")]
    run = write_made(directory / "run", "segments" if name.startswith("frame") else "packed", frames=2)
    shutil.copy(CORPUS / name, run / "segments" if name.startswith("frame") else run)
    return run, READ


@pytest.mark.parametrize("name", sorted(path.name for path in CORPUS.iterdir()))
def test_a_damaged_file_ends_with_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    given, commands = put(name, tmp_path)
    ends = []
    for words in commands:
        more = ("-o", tmp_path / "out") if words[0] == "export" else ()
        outcome = run_here(*(word.format(given) for word in words), *more)
        text = outcome.stdout + outcome.stderr
        assert "a fault of mpmcli" not in text and "Traceback" not in text and "\x1b" not in text, text
        ends.append(outcome.status)
    # What a record or a name says can be left out.
    assert max(ends) > 0 or name == "run.json"
    assert max(ends) <= 2


@pytest.mark.parametrize(
    "change",
    [{"dimension": 7}, {"bodies": 3}, {"origin": ["a", "b"]}, {"scene": "domain = 3"}, {"laws": [{"colour": 1}] * 2}],
)
def test_a_header_of_other_types(tmp_path: Path, change: dict) -> None:
    write_made(tmp_path)
    with changed(tmp_path / "particles.vtkhdf") as file:
        attributes = file["mpmcli"].attrs
        attributes["header"] = json.dumps(json.loads(attributes["header"]) | change)
        if "scene" in change:
            attributes["scene"] = change["scene"]
    with pytest.raises(InputError, match="is damaged: its header"):
        open_result(tmp_path)


@pytest.mark.parametrize("text", ["{", "[1]", '{"program": "other"}', '{"program": "mpmcli", "steps": "many"}'])
def test_a_record_that_is_none_counts_as_missing(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text, encoding="utf-8")
    assert read_record(tmp_path) is None


@pytest.mark.parametrize("form", ["s.ply", "s.stl", "s.obj"])
@pytest.mark.parametrize("binary", [True, False])
def test_surfaces_as_vtk_reads_them(tmp_path: Path, form: str, binary: bool) -> None:
    """A ball of triangles."""
    path = tmp_path / form
    shape = pv.Sphere(theta_resolution=7, phi_resolution=5)
    if form == "s.obj":
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in shape.points.astype(float).tolist()]
        # Forwards, and backwards from the latest vertex.
        faces = shape.regular_faces - (shape.n_points if not binary else -1)
        lines += [f"f {a} {b} {c}" for a, b, c in faces]
        path.write_text("\n".join(lines), encoding="utf-8")
    else:
        shape.save(path, binary=binary)
    found, told = read_geometry(path), pv.read(path)
    assert np.abs(found.vertices[found.triangles] - told.points[told.regular_faces]).max() < 1e-6
    path.write_bytes(path.read_bytes()[: 7 * path.stat().st_size // 10])
    # Others may end behind any triangle; trimesh finds none in a binary STL.
    if form == "s.ply":
        with pytest.raises(GeometryFileError):
            read_geometry(path)
    if form == "s.stl" and binary:
        assert not len(read_geometry(path).triangles)


def test_a_corner_that_is_no_vertex(tmp_path: Path) -> None:
    path = tmp_path / "s.vtk"
    path.write_text(
        "# vtk DataFile Version 3.0\n\nASCII\nDATASET POLYDATA\nPOINTS 1 float\n0 0 0\nPOLYGONS 1 4\n3 0 9999999 -99\n",
        encoding="utf-8",
    )
    with pytest.raises(GeometryFileError):
        read_geometry(path)


def test_tables_of_callers_that_share_one() -> None:
    """An unknown key that two bodies share was taken out twice."""
    shared = {"law": "fluid", "density": 1.0}
    scene = {"bodies": [{"material": shared}, {"material": shared}]}
    first, second = copied(scene)["bodies"]
    assert first == second == {"material": shared} and first["material"] is not second["material"]
    changed, _ = apply_overrides(scene, ["bodies[0].material.density=2.0"])
    assert [body["material"]["density"] for body in changed["bodies"]] == [2.0, 1.0]


def test_how_deep_tables_may_be() -> None:
    tree: object = 1
    for _ in range(59):
        tree = [tree]
    assert not too_deep(tree) and not too_deep({}) and too_deep([[tree]])
    with pytest.raises(InputError, match="lies so deep"):
        apply_overrides({"title": 1}, ["a" + ".a" * 100 + "=1"])


def test_control_characters_are_escaped() -> None:
    assert escaped("plain é\n\ttext") == "plain é\n\ttext"
    assert escaped("\x1b[31m\x07\x7f\u202e") == "\\u001b[31m\\u0007\\u007f\\u202e"
    assert json.loads(escaped(json.dumps("\x7f\u202e\U000e0001", ensure_ascii=False))) == "\x7f\u202e\U000e0001"
