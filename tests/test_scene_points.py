"""Bodies from point files: positions and velocities as they stand there, volumes as asked, faults in one sentence."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
import scenes
from command import run_here
from drawn_results import JELLY, WATER, frame, header
from drawn_results import write as write_result
from scenes import liquid, tables_of

from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.output import open_result
from mpmcli.scene import Scene, estimate_particles, highest_speed, parse_scene, sample_bodies
from mpmcli.scene.points import read_points
from mpmcli.solver.engine.run_group import require_inside

RANDOM = np.random.default_rng(3)
POINTS = {d: RANDOM.uniform(0.1, 0.9, (50, d)) for d in (2, 3)}
SPEEDS = {d: RANDOM.normal(size=(50, d)) for d in (2, 3)}
COLUMNS = {2: ["x", "y", "vx", "vy"], 3: ["x", "y", "z", "vx", "vy", "vz"]}


def write(path: Path, d: int) -> dict[str, Any]:
    """Write points with velocities, and return the table that reads them."""
    both = np.concatenate([POINTS[d], SPEEDS[d]], axis=1)
    if path.suffix == ".csv":
        # The order of columns is that of the file, and others may stand between.
        rows = np.concatenate([both[:, ::-1], np.ones((50, 1))], axis=1)
        np.savetxt(path, rows, delimiter=",", header=",".join([*COLUMNS[d][::-1], "id"]), comments="", fmt="%.17g")
        return {"file": path.name, "velocity": COLUMNS[d][d:]}
    if path.suffix == ".npy":
        if "named" in path.name:
            both = np.array(list(map(tuple, both)), dtype=[(name, "f8") for name in COLUMNS[d]])
        np.save(path, both)
        return {"file": path.name, "velocity": COLUMNS[d][d:]}
    cloud = pv.PolyData(np.pad(POINTS[d], ((0, 0), (0, 3 - d))))
    cloud.point_data["motion"] = np.pad(SPEEDS[d], ((0, 0), (0, 3 - d)))
    (cloud.cast_to_unstructured_grid() if path.suffix == ".vtu" else cloud).save(path)
    return {"file": path.name, "velocity": "motion"}


def scene_data(table: dict[str, Any], d: int = 2, **body: Any) -> dict[str, Any]:
    """Return the tables of a scene of water in points."""
    own = scenes.body("b", liquid(1e5, density=800.0), {"points": table}, **body)
    return tables_of(own, size=[1.0] * d, spacing=0.1, contact={})


def scene_of(directory: Path, table: dict[str, Any], d: int = 2, **body: Any) -> Scene:
    """Return that scene."""
    return parse_scene(scene_data(table, d, **body), laws=parameter_models(), directory=directory).scene


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", ["p.csv", "p.npy", "named.npy", "p.vtu", "p.vtp"])
def test_particles_are_where_and_as_fast_as_the_file_says(tmp_path: Path, name: str, d: int) -> None:
    """Positions, velocities on top of that of the body, and spacing^d of volume each, whatever the grid."""
    table = write(tmp_path / name, d)
    scene = scene_of(tmp_path, {**table, "spacing": 0.02}, d, velocity=[1.0] * d)
    (particles,) = sample_bodies(scene)
    error = 1e-6 if name.endswith(("vtu", "vtp")) else 0.0  # VTK writes single precision as it is given
    assert np.allclose(particles.position, POINTS[d], rtol=0, atol=error)
    assert np.allclose(particles.velocity, SPEEDS[d] + 1.0, rtol=0, atol=4 * error)
    assert particles.volume == pytest.approx(0.02**d, rel=1e-12)
    assert particles.count == estimate_particles(scene) == 50
    assert highest_speed(scene.bodies[0]) >= np.linalg.norm(particles.velocity, axis=1).max()
    assert scene.bodies[0].particles_per_cell == 5**d


def test_the_volume_of_the_whole_scale_and_translate(tmp_path: Path) -> None:
    """A PLY in millimetres; the mass is density times the volume asked; velocities stay out unless asked for."""
    pv.PolyData(np.pad(1000 * POINTS[2], ((0, 0), (0, 1)))).save(tmp_path / "p.ply")
    table = {"file": "p.ply", "total_volume": 0.3, "scale": 1e-3, "translate": [0.0, 0.05]}
    (particles,) = sample_bodies(scene_of(tmp_path, table))
    assert np.allclose(particles.position, POINTS[2] + [0, 0.05], rtol=0, atol=1e-6)
    assert particles.count * particles.mass == pytest.approx(800 * 0.3, rel=1e-12)
    assert not particles.velocity.any()


BAD = [
    ("none.csv", None, {}, "none.csv: there is no such file"),
    ("p.csv", "x,y\n1,2\n3\n", {}, "p.csv: line 3 must hold 2 numbers, one for each column"),
    ("p.csv", "x,y\n1,2\n3,nan\n", {}, "point 2 is not finite"),
    ("p.csv", "0.1,0.2\n", {}, "its first line must name the columns, such as x,y"),
    ("p.csv", "x,y\n", {}, "it holds no point"),
    ("p.csv", "x,Y\n1,2\n", {}, 'it has no column "y"; its columns are "x" and "Y"'),
    ("p.csv", "x,y,u\n1,2,3\n", {"velocity": ["u", "w"]}, 'it has no column "w"; its columns are "x", "y" and "u"'),
    ("p.csv", "x,y\n1,2\n", {"velocity": "v"}, 'velocity must name 2 columns, such as ["vx", "vy"]'),
    ("p.csv", "x,y\n1,2\n", {"velocity": ["v"]}, 'velocity must name 2 columns, such as ["vx", "vy"]'),
    ("p.npy", "hello", {}, "p.npy: it is not a numpy array"),
    ("p.vtu", "hello", {}, "p.vtu: it is not a readable file of points|it holds no point"),
    ("p.csv", "x,y\n.1,.2\n.1,.5\n", {"spacing": None}, "needs either spacing or total_volume, which the mass"),
    ("p.csv", "x,y\n.1,.2\n.1,.5\n", {"spacing": None}, "its points are some 0.3 m apart"),
    ("p.csv", "x,y\n.1,.2\n.1,1.5\n", {}, 'body "b" leaves the domain through y_max by 0.5 m'),
]


@pytest.mark.parametrize(("name", "text", "keys", "said"), BAD)
def test_a_bad_file_is_one_sentence(tmp_path: Path, name: str, text: str | None, keys: dict, said: str) -> None:
    """Which file, what is wrong, and what would be right."""
    if text is not None:
        (tmp_path / name).write_text(text, encoding="utf-8")
    table = {key: value for key, value in {"file": name, "spacing": 0.1, **keys}.items() if value is not None}
    with pytest.raises(InputError) as caught:
        scene_of(tmp_path, table)
    assert any(one in str(caught.value) for one in said.split("|")), caught.value
    assert "\n" not in str(caught.value)


PLY = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(
    f"property float {name}\n" for name in ("x", "y", "z", "vx", "vy", "vz")
)
# Two points, (0.25, 0.5) at (1, 2) m/s and (0.75, 0.125) at (3, 4) m/s, as programs write them.
WRITTEN = {
    "paraview.csv": ('"v:0","v:1","v:2","Points:0","Points:1","Points:2"\n1,2,0,.25,.5,0\n3,4,0,.75,.125,0\n', "v"),
    "upper.csv": ("X,Y,Z,U,V\n.25,.5,0,1,2\n.75,.125,0,3,4\n", ("U", "V")),
    "savetxt.csv": ("# x y vx vy\n.25 .5 1 2\n.75 .125 3 4\n", ("vx", "vy")),
    "commented.txt": ("# made by hand\n#x,y,vx,vy\n.25,.5,1,2\n\n.75,.125,3,4\n", ("vx", "vy")),
    "german.csv": ("x;y;vx;vy\n0,25;0,5;1,0;2,0\n0,75;0,125;3,0;4,0\n", ("vx", "vy")),
    "tabs.txt": ("x\ty\tvx\tvy\n.25\t.5\t1\t2\n.75\t.125\t3\t4\n", ("vx", "vy")),
    "cloud.xyz": (".25 .5 0 1 2 0\n.75 .125 0 3 4 0\n", ("vx", "vy")),
    "atoms.xyz": ("2\nwater\nO .25 .5 0\nH .75 .125 0\n", None),
    "cloud.ply": (PLY + "end_header\n.25 .5 0 1 2 0\n.75 .125 0 3 4 0\n", ("vx", "vy")),
}


@pytest.mark.parametrize("name", [*WRITTEN, "vectors.npz", "columns.npz"])
def test_points_as_programs_write_them(tmp_path: Path, name: str) -> None:
    position, speeds = np.array([[0.25, 0.5], [0.75, 0.125]]), np.array([[1.0, 2.0], [3.0, 4.0]])
    if name == "vectors.npz":
        np.savez(tmp_path / name, position=position, velocity=speeds, note="made")
        velocity = "velocity"
    elif name == "columns.npz":
        np.savez(tmp_path / name, x=position[:, 0], y=position[:, 1], vx=speeds[:, 0], vy=speeds[:, 1])
        velocity = ("vx", "vy")
    else:
        text, velocity = WRITTEN[name]
        (tmp_path / name).write_text(text, encoding="utf-8")
    found = read_points(tmp_path / name, 2, velocity)
    np.testing.assert_array_equal(found[0], position)
    assert (found[1] is None) == (velocity is None)
    if velocity is not None:
        np.testing.assert_array_equal(found[1], speeds)


@pytest.mark.parametrize("suffix", [".pkl", ".pickle", ".pvd", ".pvtu", ".vtm", ".gltf", ".xdmf", ".bdf", ""])
def test_a_file_of_another_kind_is_not_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    """PyVista 0.45 to 0.47 runs the code of a pickle, and files that name others have digests without them."""
    asked = []
    for reader in ("pyvista.read", "trimesh.load", "meshio.read"):
        monkeypatch.setattr(reader, lambda *found, **_: asked.append(found))
    (tmp_path / f"p{suffix}").write_bytes(b"cos\nsystem\n(S'touch ran'\ntR.")
    for shape in ({"points": {"file": f"p{suffix}", "spacing": 0.1}}, {"mesh": {"file": f"p{suffix}"}}):
        with pytest.raises(InputError, match=r"the files that are read are \.obj, .* and \.vtu; save it as"):
            scene_of(tmp_path, {}, 3, shape=shape)
    assert not asked


def test_points_are_not_combined_and_lie_in_their_plane(tmp_path: Path) -> None:
    """What an array must be, and where points make no sense."""
    table = write(tmp_path / "p.vtp", 3)
    with pytest.raises(InputError, match="its points lie in space, and the scene is 2D"):
        scene_of(tmp_path, {**table, "spacing": 0.1})
    with pytest.raises(InputError, match='its points have no array "speed"; they have "motion"'):
        scene_of(tmp_path, {**table, "spacing": 0.1, "velocity": "speed"}, 3)
    np.save(tmp_path / "p.npy", np.zeros((4, 5)))
    with pytest.raises(
        InputError, match=r"it must be of numbers, \(n, 2\), or \(n, 4\) with velocities; it is \(4, 5\)"
    ):
        scene_of(tmp_path, {"file": "p.npy", "spacing": 0.1})


# Files with several times.

TIMES = (0.0, 0.01, 0.02)


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """Return the directory of a result of two bodies, of which particle 1 has gone from frame 1 on, in three frames."""
    facts = header((1.0, 1.0), 0.1, [WATER, JELLY])
    frames = []
    for k in range(len(TIMES)):
        position, gradient = POINTS[2][:6] * (1 - 0.1 * k), np.tile([1.0 + k, 0.5, 0.0, 1.0], (6, 1))
        own = {"density": np.full(6, 1000.0 / (1 + k)), "deformation_gradient": gradient, "affine": gradient - k}
        made = frame(k, position, [0, 0, 0, 0, 1, 1], SPEEDS[2][:6] + k, **own)
        made.fields["status"] = np.array([1, 1 if k == 0 else 2, 1, 1, 1, 1], np.int8)
        frames.append(made)
    write_result(tmp_path / "run", facts, frames)
    return tmp_path


@pytest.mark.parametrize(
    ("keys", "k"), [({}, 2), ({"frame": 0}, 0), ({"frame": 1}, 1), ({"time": 0.02}, 2), ({"time": 0.012}, 1)]
)
def test_one_of_several_times_is_read_and_said(result: Path, keys: dict, k: int) -> None:
    """By default the last, and only particles that are there, with their velocity, C, and J from the density."""
    table = {"file": "run/particles.vtkhdf", "spacing": 0.05, "velocity": "velocity", "body": "body 0", **keys}
    rows = [0, 2, 3] if k else [0, 1, 2, 3]
    data = liquid(1e5)
    scene = scene_of(result, table, material=data)
    (found,) = sample_bodies(scene)
    assert found.position == pytest.approx(POINTS[2][rows] * (1 - 0.1 * k), abs=1e-6)
    assert found.velocity == pytest.approx(SPEEDS[2][rows] + k, abs=1e-6)
    assert found.deformation == pytest.approx(np.full(len(rows), 1.0 + k))
    assert found.affine == pytest.approx(np.tile([[1.0, 0.5 - k], [-k, 1.0 - k]], (len(rows), 1, 1)))
    # The volume that is given is that at rest.
    assert found.volume == pytest.approx(0.05**2)
    (note,) = scene.bodies[0].shape.notes
    assert f"is read at frame {k} of 0 to 2, t = {TIMES[k]:.6g} s" in note
    assert ("selects another" in note) == (not keys)


def test_a_solid_goes_on_with_its_deformation(result: Path) -> None:
    table = {"file": "run/particles.vtkhdf", "spacing": 0.05, "body": "body 1", "frame": 1}
    (found,) = sample_bodies(scene_of(result, table, material=JELLY))
    assert found.deformation == pytest.approx(np.tile([[2.0, 0.5], [0.0, 1.0]], (2, 1, 1)))
    loaded = parse_scene(scene_data(table, material=JELLY), laws=parameter_models(), directory=result)
    assert "b: run/particles.vtkhdf has no initial_position (output.fields): as at rest" in loaded.notes


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"frame": 3}, "points.frame: {}: it has frames 0 to 2; found 3"),
        ({"time": 0.5}, "points.time: {}: its times are 0 to 0.02 s; found 0.5"),
        ({"time": 0.01, "frame": 1}, "points.time: is given as well as frame; leave one of them out"),
        ({"body": "water"}, 'points.body: {}: it has no body "water"; its bodies are "body 0" and "body 1"'),
    ],
)
def test_what_a_result_does_not_have_is_one_sentence(result: Path, keys: dict, sentence: str) -> None:
    table = {"file": "run/particles.vtkhdf", "spacing": 0.05, **keys}
    with pytest.raises(InputError) as refused:
        scene_of(result, table)
    assert sentence.format(result / "run" / "particles.vtkhdf") in str(refused.value)


@pytest.mark.parametrize(("out", "word", "fits"), [(0.4, "slip", True), (0.6, "slip", False), (1.9, "open", True)])
def test_particles_of_a_result_may_be_beyond_faces(tmp_path: Path, out: float, word: str, fits: bool) -> None:
    """By half a cell where they overlap a wall, and by two where they have yet to be retired at an open face."""
    write_result(tmp_path / "run", header((1.0, 1.0), 0.1, [WATER]), [frame(0, [[0.5, 0.5], [1.0 + 0.1 * out, 0.5]])])
    data = scene_data({"file": "run/particles.vtkhdf", "spacing": 0.05})
    data["domain"]["walls"] = {"default": "slip", "x_max": word}
    if fits:
        scene = parse_scene(data, laws=parameter_models(), directory=tmp_path).scene
        require_inside(scene, sample_bodies(scene))
    else:
        with pytest.raises(InputError, match="leaves the domain through x_max"):
            parse_scene(data, laws=parameter_models(), directory=tmp_path)


def test_a_file_of_one_time_has_no_frames(tmp_path: Path) -> None:
    for name in ("p.csv", "p.vtu"):
        table = write(tmp_path / name, 2)
        with pytest.raises(InputError, match="frame is for VTKHDF files, which have several times; leave it out"):
            scene_of(tmp_path, {**table, "spacing": 0.05, "frame": 1})


GOES_ON = """\
domain = {{ size = [1.4, 0.7], spacing = 0.05, gravity = [0.0, -9.81] }}
time = {{ end = {end}, frames = {frames}, step = 2e-4 }}
solver = {{ precision = "f64" }}
output = {{ fields = ["velocity", "affine", "deformation_gradient", "initial_position", "plastic_volume_ratio"] }}
[[bodies]]
name = "jelly"
material = {{ law = "neo_hookean", density = 1000.0, youngs_modulus = 2e4, poissons_ratio = 0.3 }}
shape = {{ {jelly} }}
{velocity}
[[bodies]]
name = "snow"
material = "snow"
shape = {{ {snow} }}
{velocity}
"""


def test_a_run_goes_on_from_a_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A jelly on the floor and snow are where the whole run has them, to the half step by which velocities lag."""
    monkeypatch.chdir(tmp_path)
    starts = {"jelly": 0.2, "snow": 0.9}
    boxes = {name: f"box = {{ min = [{x}, 0.05], max = [{x + 0.3:.1f}, 0.35] }}" for name, x in starts.items()}
    table = 'file = "whole/particles.vtkhdf", total_volume = 0.09, time = 0.08, velocity = "velocity"'
    parts = {name: f'points = {{ {table}, body = "{name}" }}' for name in starts}
    runs = {"whole": GOES_ON.format(end=0.16, frames=4, velocity="velocity = [0.0, -1.0]", **boxes)}
    runs["part"] = GOES_ON.format(end=0.08, frames=2, velocity="", **parts)
    for name, text in runs.items():
        Path(f"{name}.toml").write_text(text, encoding="utf-8")
        done = run_here("simulate", f"{name}.toml", "-o", name, "-q")
        assert (done.status, done.stderr) == (0, "")
    whole, part = (open_result(Path(name)) for name in runs)
    for label in range(2):
        before, after, found = whole.frame(2), whole.frame(4), part.frame(2)
        own = after.body == label
        for name in ("position", "deformation_gradient", *["plastic_volume_ratio"] * label):
            start, right, here = (frame.fields.get(name, frame.position)[own] for frame in (before, after, found))
            assert np.linalg.norm(here - right) < 0.1 * np.linalg.norm(right - start), (label, name)
