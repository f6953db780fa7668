"""Valid input of every kind, small: files by name, made without a solver where it can be."""

from contextlib import suppress
from functools import cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from unittest import mock

import h5py
import numpy as np
from command import CONFIGS
from made_dataset import LAWS, made_dataset
from made_result import made_frame, made_row

from mpmcli.dataset.folder import Manifest, Row
from mpmcli.dataset.shard import checksum
from mpmcli.output import SegmentStore, VtkSeriesStore
from mpmcli.output.checkpoints import Checkpoint, write_checkpoint
from mpmcli.output.collider_files import RESTING

Files = dict[str, bytes]

RECORD = b"""{"program": "mpmcli", "version": "0.1", "command": ["mpmcli", "simulate", "scene.toml"],
"backend": {"arch": "cpu", "threads": 1, "precision": "f32"}, "seeds": {}, "frames_expected": 6, "particles": 4,
"notes": ["left: none"],
"status": "finished", "frames_written": 6, "steps": 50, "time": 0.1, "timings": {"wall_s": 1.0},
"limits": {"wave": 2, "speed": 2}, "energy": {"first": 20.0, "last": 20.0}, "started": "2026-01-01T00:00:00+00:00",
"failure": {"message": "It stopped.", "step": 3, "limit": "wave"}, "ended": "2026-01-01T00:00:01+00:00"}
"""
SCENE = """\
title = "Two that fall"
[domain]
size = [{ones}]
spacing = 0.05
gravity = [{gravity}]
walls = {{ default = "slip", x_min = "stick" }}
friction = {{ x_max = 0.2 }}
[constants]
depth = 0.3
[time]
end = 0.1
frames = 5
[[bodies]]
name = "left"
material = {{ law = "fluid", density = 1000.0 }}
shape = {{ box = {{ min = [{low}], max = [{high}] }} }}
[[bodies]]
name = "right"
material = {{ law = "sand", density = 1500.0, friction_angle = 30.0 }}
shape = {{ ball = {{ center = [{high}], radius = 0.1 }} }}
[[colliders]]
name = "stone"
shape = {{ ball = {{ center = [{low}], radius = 0.1 }} }}
velocity = [{still}]
"""
BODIES = """\
[domain]
size = [2.0, 2.0, 2.0]
cells = [16, 16, 16]
gravity = [0.0, 0.0, -9.81]
[time]
end = 0.1
frames = 4
[[bodies]]
name = "thing"
material = "jelly"
"""
SHAPES = {
    "mesh": 'shape = {{ mesh = {{ file = "{file}", translate = [1.0, 1.0, 1.0] }} }}\n',
    "points": 'shape = {{ points = {{ file = "{file}", spacing = 0.1{more} }} }}\n',
}


@cache
def scenes() -> tuple[Files, ...]:
    """Return the examples of the repository, with the files that they name."""
    meshes = {f"meshes/{path.name}": path.read_bytes() for path in (CONFIGS / "meshes").iterdir()}
    found = []
    for path in sorted(CONFIGS.glob("*.toml")):
        text = path.read_bytes()
        files = {"scene.toml": text} | {name: data for name, data in meshes.items() if name.encode() in text}
        # Those with meshes take a hundred times as long.
        found += [files] * (1 if len(files) > 1 else 10)
    return tuple(found)


@cache
def sweeps() -> tuple[Files, ...]:
    """Return the example sweeps with their base scenes."""
    base = {f"base/{path.name}": path.read_bytes() for path in (CONFIGS / "sweeps" / "base").iterdir()}
    base |= {f"../{path.name}": path.read_bytes() for path in CONFIGS.glob("*.toml")}
    found = []
    for path in sorted((CONFIGS / "sweeps").glob("*.toml")):
        text = path.read_bytes()
        name = text.split(b'base = "')[1].split(b'"')[0]
        found.append({"sweep.toml": text.replace(name, b"base.toml"), "base.toml": base[name.decode()]})
    return tuple(found)


@cache
def meshes() -> tuple[Files, ...]:
    """Return a scene with a tetrahedron and with a box, in files of every kind that is read."""
    import pyvista as pv

    found = []
    with TemporaryDirectory() as place:
        for shape in (pv.Tetrahedron(), pv.Box(quads=False)):
            solid = shape.delaunay_3d()
            for name, written, options in (
                *(("a.stl", shape, {"binary": True}), ("b.stl", shape, {"binary": False})),
                *(("a.ply", shape, {"binary": True}), ("b.ply", shape, {"binary": False})),
                *(("a.vtp", shape, {"binary": True}), ("b.vtp", shape, {"binary": False}), ("a.obj", shape, {})),
                *(("a.vtu", solid, {"binary": True}), ("b.vtu", solid, {"binary": False}), ("a.vtk", shape, {})),
            ):
                path = Path(place) / name
                if name.endswith(".obj"):
                    pv.save_meshio(path, written)
                else:
                    written.save(path, **options)
                text = BODIES + SHAPES["mesh"].format(file=name)
                found.append({"scene.toml": text.encode(), name: path.read_bytes()})
    return tuple(found)


@cache
def points() -> tuple[Files, ...]:
    """Return a scene with points and velocities, in files of every kind that is read."""
    import pyvista as pv

    places = np.random.default_rng(1).uniform(0.2, 1.8, (20, 3))
    cloud = pv.PolyData(places.astype(np.float32))
    cloud.point_data["velocity"] = np.ones((20, 3), np.float32)
    named = np.zeros(20, [(name, "f8") for name in ("x", "y", "z", "vx", "vy", "vz")])
    for k, axis in enumerate("xyz"):
        named[axis] = places[:, k]
    rows = "\n".join(",".join(f"{x:.4f}" for x in (*p, 0.0, 0.1, 0.2)) for p in places)
    columns, array = ', velocity = ["vx", "vy", "vz"]', ', velocity = "velocity"'
    found = []
    with TemporaryDirectory() as directory:
        place = Path(directory)
        (place / "a.csv").write_text("x,y,z,vx,vy,vz\n" + rows + "\n", encoding="utf-8")
        np.save(place / "a.npy", named)
        np.save(place / "b.npy", np.hstack([places, places]))
        cloud.save(place / "a.ply", binary=True)
        cloud.save(place / "a.vtp")
        cloud.cast_to_unstructured_grid().save(place / "a.vtu", binary=False)
        cloud.save(place / "a.vtk", binary=False)
        for name, more in (
            *(("a.csv", columns), ("a.npy", columns), ("b.npy", columns)),
            *(("a.ply", ""), ("a.vtp", array), ("a.vtu", array), ("a.vtk", array)),
        ):
            text = BODIES + SHAPES["points"].format(file=name, more=more)
            found.append({"scene.toml": text.encode(), name: (place / name).read_bytes()})
    return tuple(found)


def result_header(dimension: int) -> dict:
    """Return the header of a small run with two bodies and a collider."""
    text = SCENE.format(
        ones=", ".join(["1.0"] * dimension),
        gravity=", ".join(["0.0"] * (dimension - 1) + ["-9.81"]),
        low=", ".join(["0.2"] * dimension),
        high=", ".join(["0.6"] * dimension),
        still=", ".join(["0.0"] * dimension),
    )
    return {
        "version": "0.1",
        "title": "Two that fall",
        "dimension": dimension,
        "spacing": 0.05,
        "origin": [0.0] * dimension,
        "size": [1.0] * dimension,
        "bodies": ["left", "right"],
        "materials": list(LAWS),
        "laws": [{"deformation": "J", "coherent": False}, {"deformation": "F", "coherent": False}],
        "precision": "f32",
        "backend": {"arch": "cpu", "threads": 1, "precision": "f32"},
        "scene": text,
    }


@cache
def results(form: str) -> tuple[Files, ...]:
    """Return a result in 2D and one in 3D as "packed", "segments" or "series"."""
    found = []
    for d in (2, 3):
        with TemporaryDirectory() as place, mock.patch("os.fsync"):
            directory = Path(place) / "result"
            store = (VtkSeriesStore if form == "series" else SegmentStore)(
                directory, result_header(d), hold=np.inf if form == "packed" else 0.0
            )
            frames = 3 if form == "packed" else 2
            for k in range(frames):
                store.write(made_frame(k, d), made_row(k, d))
            if form != "segments":
                store.finish()
            (directory / "run.json").write_bytes(RECORD)
            if form == "packed":
                _write_surfaces(directory / RESTING)
            found.append(_files_in(directory, "result"))
    return tuple(found)


@cache
def checkpoints() -> tuple[Files, ...]:
    """Return two checkpoints of a small run."""
    backend = {"arch": "cpu", "precision": "f32"}
    with TemporaryDirectory() as place, mock.patch("os.fsync"):
        for step in (3, 7):
            arrays = {"fluid.x": np.full((20, 3), step, np.float32), "numbers": np.arange(40.0), "counts": np.arange(9)}
            numbers = {"time": 0.1, "drift": np.inf, "frames": [1, {"smallest": [0.1, "wave"]}, 0.0]}
            write_checkpoint(Path(place), Checkpoint(1, step, 0.1, backend, False, numbers, arrays), 1000)
        return (_files_in(Path(place), "run"),)


@cache
def datasets() -> tuple[Files, ...]:
    """Return a dataset of four trajectories with its manifest."""
    with TemporaryDirectory() as place:
        directory = made_dataset(Path(place) / "data")
        facts = {
            "key": "k",
            "count": 4,
            "seed": 0,
            "accept": "stable",
            "per_shard": 2,
            "part": [1, 1],
            "version": "0.1",
        }
        manifest = Manifest(directory)
        manifest.create(facts)
        rows = []
        for shard in sorted((directory / "shards").iterdir()):
            with h5py.File(shard) as file:
                for group in file.values():
                    number, split = int(group.attrs["number"]), str(group.attrs["split"])
                    known = {"verdict": "stable", "accepted": 1, "file": f"shards/{shard.name}", "draws": "{}"}
                    known |= {"checksum": checksum(group), "frames": 11, "particles": group["position"].shape[1]}
                    rows.append(Row(**{**vars(Row.failed(number, split)), **known}))
        manifest.put(rows)
        return (_files_in(directory, "data"),)


def _write_surfaces(path: Path) -> None:
    with h5py.File(path, "w") as file:
        group = file.create_group("mpmcli/surfaces/0")
        group["vertices"] = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        group["triangles"] = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def _files_in(directory: Path, name: str) -> Files:
    found = {}
    for path in sorted(directory.rglob("*")):
        with suppress(IsADirectoryError):
            found[f"{name}/{path.relative_to(directory)}"] = path.read_bytes()
    return found


def chosen(seeds: tuple[Files, ...], rng: Random) -> Files:
    """Return a copy of one of the seeds."""
    return dict(rng.choice(seeds))
