"""Meshes: against an analytic ball, a torus, a box, and files that make no closed surface."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import body, liquid, tables_of

from mpmcli.check.geometry import distance_between, thickness
from mpmcli.dataset.draw import draw
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.errors import InputError
from mpmcli.materials.registry import laws, parameter_models
from mpmcli.output.header import RunHeader
from mpmcli.scene import Scene, parse_scene, sample_bodies, scene_to_toml
from mpmcli.scene.load import LoadedScene
from mpmcli.scene.mesh import Mesh, _surface_of, read_mesh
from mpmcli.scene.points import GeometryFileError, distinct_rows
from mpmcli.scene.shapes import Ball, Shape, distance_grid

R = 0.4


def saved(directory: Path, surface: pv.PolyData, name: str = "mesh.stl") -> str:
    """Write a surface, and return its path."""
    # PyVista would turn triangles that face inwards.
    surface.save(directory / name, recompute_normals=False)
    return str(directory / name)


def ball(steps: int = 60) -> pv.PolyData:
    """Return a ball of radius R about the origin, of 2 steps^2 triangles."""
    return pv.Sphere(radius=R, theta_resolution=steps, phi_resolution=steps)


def mesh(path: str, **keys: object) -> Mesh:
    """Return the form that a scene has."""
    return Mesh.model_validate({"file": path, **keys}, context={"dimension": 3})


def loaded(shape: dict, directory: Path, size: tuple[float, ...] = (1.0, 1.0, 1.0)) -> LoadedScene:
    """Return a scene of water in a shape, with its notes."""
    own = body("b", liquid(1e5, density=800.0), shape)
    data = tables_of(own, size=list(size), spacing=0.05, contact={})
    return parse_scene(data, laws=parameter_models(), directory=directory)


def scene_of(shape: dict, size: tuple[float, ...] = (1.0, 1.0, 1.0), directory: Path = Path()) -> Scene:
    """Return a scene of water in a shape."""
    return loaded(shape, directory, size).scene


def test_the_inside_of_a_ball(tmp_path: Path) -> None:
    """The facets of 2 k^2 triangles lie R (1 - cos(pi / k)) under the sphere at most; volume 4/3 pi R^3 (1 - O(1/k^2)).

    Points are on the lines through vertices and along edges, too, where a triangle could be counted twice or missed.
    """
    form = mesh(saved(tmp_path, ball(60)))
    assert form.volume == pytest.approx(4 / 3 * math.pi * R**3, rel=2 * (math.pi / 60) ** 2)
    random = np.random.default_rng(0).uniform(-0.5, 0.5, (50_000, 3))
    vertices = form.surface.vertices
    lines = np.concatenate([vertices * [1, 1, s] for s in (-2.0, -0.5, 0.0, 0.5, 2.0)])
    for points in (random, lines, (vertices + np.roll(vertices, 1, axis=0)) / 2 * [1, 1, 0.3]):
        away = np.linalg.norm(points, axis=1)
        depth = R * (1 - math.cos(math.pi / 60) ** 2)
        assert form.contains(points)[away < R - depth].all() and not form.contains(points)[away > R].any()


def test_the_place_of_a_hole_is_told(tmp_path: Path) -> None:
    """A ball without seven triangles apart and a patch of the 6 triangles round a vertex, whose rim has 6 edges."""
    import trimesh

    whole = trimesh.creation.icosphere(subdivisions=3, radius=R)
    vertex = int(np.flatnonzero(np.bincount(whole.faces.ravel()) == 6)[50])
    patch = (whole.faces == vertex).any(axis=1)
    far = np.flatnonzero(whole.triangles_center @ whole.vertices[vertex] < 0)[::80][:7]
    patch[far] = True
    trimesh.Trimesh(whole.vertices, whole.faces[~patch]).export(tmp_path / "open.ply")
    with pytest.raises(GeometryFileError, match=rf"round {len(far) + 1} holes, the largest of 6 edges at \[") as caught:
        read_mesh(tmp_path / "open.ply")
    told = np.array([float(one) for one in str(caught.value).split("at [")[1].split("]")[0].split(",")])
    assert np.linalg.norm(told - whole.vertices[vertex]) < 0.05 * R
    # The three next, of one triangle each, about its middle.
    others = re.findall(r"3 edges at \[(.*?)\]", str(caught.value))
    places = np.array([[float(one) for one in place.split(",")] for place in others])
    away = np.linalg.norm(places[:, None] - whole.triangles_center[far], axis=-1)
    assert len(others) == 3 and np.all(away.min(axis=1) < 1e-5) and len({*away.argmin(axis=1)}) == 3


def test_small_holes_are_closed(tmp_path: Path) -> None:
    """Of a ball without seven triangles: its volume again, by pyramids from the middle over them, which the note says.

    The file may be inside out; the volume is that of `scale`^3.
    """
    import trimesh

    whole = trimesh.creation.icosphere(subdivisions=3, radius=R)
    gone = np.arange(len(whole.faces)) % 180 == 0
    trimesh.Trimesh(whole.vertices, whole.faces[~gone][:, ::-1]).export(tmp_path / "open.ply")
    found = read_mesh(tmp_path / "open.ply", scale=2.0, close=True)
    exact = trimesh.load(whole.export(tmp_path / "whole.ply") and tmp_path / "whole.ply", process=False)
    assert found.volume == pytest.approx(8 * exact.volume, rel=1e-12)
    pyramids = 8 * np.abs(np.linalg.det(exact.triangles[gone])).sum() / 6
    assert found.notes == (
        f"open.ply: close fills {gone.sum()} holes of at most 3 edges, which adds {pyramids:.3g} m^3, "
        f"{pyramids / found.volume:.2g} of the volume",
    )
    scene = {"mesh": {"file": "open.ply", "close": True, "translate": [0.5] * 3}}
    assert loaded(scene, tmp_path).notes == (f"b: {read_mesh(tmp_path / 'open.ply', close=True).notes[0]}",)


def channel(width: float) -> pv.PolyData:
    """Return a channel of a U-shaped profile, 1 long and open at z = 0, whose rim there has eight edges."""
    corners = np.array([(0, 0), (3, 0), (3, 3), (3 - width, 3), (3 - width, 1), (width, 1), (width, 3), (0, 3)], float)
    whole = pv.PolyData(np.pad(corners, ((0, 0), (0, 1))), faces=[8, *range(8)]).triangulate()
    whole = whole.extrude((0, 0, 1), capping=True).triangulate().clean()
    flat = whole.cell_centers().points[:, 2] == 0
    return whole.extract_cells(~flat).extract_surface(algorithm=None)


def test_a_hole_that_is_not_convex_is_closed_within_its_rim(tmp_path: Path) -> None:
    """Volume of the profile, 3 x 1 + 2 x 2 w; between the arms, at the height of the rim, the nearest is an arm."""
    form = mesh(saved(tmp_path, channel(0.5), "channel.vtp"), close=True)
    assert form.volume == pytest.approx(3 + 4 * 0.5, rel=1e-12)
    assert form.signed_distance(np.array([[1.5, 2.5, 0.0], [0.25, 2.0, 0.1]])) == pytest.approx([1.0, -0.1])


def test_a_large_hole_is_not_closed(tmp_path: Path) -> None:
    """The rim of a tube has 13 edges; at twelve it is closed to a prism."""
    for n in (12, 13):
        tube = pv.Cylinder(radius=1.0, height=2.0, resolution=n, direction=(0, 0, 1), capping=False).triangulate()
        path = saved(tmp_path, tube.clean(), f"{n}.vtp")
    with pytest.raises(GeometryFileError, match=r"round 2 holes, the largest of 13 .* of at most 12 edges"):
        read_mesh(path, close=True)
    assert read_mesh(tmp_path / "12.vtp", close=True).volume == pytest.approx(12 * math.sin(math.pi / 6), rel=1e-6)


def cube(low: tuple[float, float, float], size: float = 1.0, way: int = 1) -> pv.PolyData:
    """Return the surface of a cube, which faces inwards with `way` -1."""
    bounds = np.stack([low, np.add(low, size)], axis=1).ravel()
    found = pv.Box(bounds=bounds, quads=False)
    return found if way > 0 else found.flip_faces()


@given(st.tuples(*[st.integers(-4, 4)] * 3), st.sampled_from([0.5, 0.75, 1.0]))
@settings(max_examples=60, deadline=None)
def test_shells_that_overlap_are_united(tmp_path_factory, steps, size) -> None:
    """The union of two cubes by inclusion and exclusion, also where they share corners, edges, faces, or all of it."""
    shift = np.array(steps) / 4
    path = tmp_path_factory.getbasetemp() / "cubes.vtp"
    pv.merge([cube((0, 0, 0)), cube(tuple(shift), size)], merge_points=False).save(path, recompute_normals=False)
    common = np.prod(np.maximum(0, np.minimum(1, shift + size) - np.maximum(0, shift)))
    assert read_mesh(path).volume == pytest.approx(1 + size**3 - common, rel=1e-6)


def test_distances_of_united_shells_are_those_of_the_union(tmp_path: Path) -> None:
    """Two cubes that make a box of 1.5 x 1 x 1, in which one of 0.2 is hollow; a third lies in that hollow."""
    parts = [cube((0, 0, 0)), cube((0.5, 0, 0)), cube((0.1, 0.4, 0.4), 0.2, -1), cube((0.15, 0.45, 0.45), 0.1)]
    form = mesh(saved(tmp_path, pv.merge(parts, merge_points=False), "cubes.vtp"))
    assert form.volume == pytest.approx(1.5 - 0.2**3 + 0.1**3, rel=1e-6)
    assert form.surface.notes == ("cubes.vtp: shells that overlap are united, which takes 0.5 m^3, 0.33 of the volume",)
    points = np.random.default_rng(3).uniform(-0.3, 1.8, (4000, 3)) * [1, 0.8, 0.8]

    def box(low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
        away = np.maximum(np.array(low) - points, points - high)
        return np.linalg.norm(np.maximum(away, 0), axis=1) + np.minimum(away.max(axis=1), 0)

    hollow = np.maximum(box((0.1, 0.4, 0.4), (0.3, 0.6, 0.6)), -box((0.15, 0.45, 0.45), (0.25, 0.55, 0.55)))
    exact = np.maximum(box((0, 0, 0), (1.5, 1, 1)), -hollow)
    assert np.allclose(form.signed_distance(points), exact, rtol=0, atol=1e-6)
    assert np.array_equal(form.contains(points), exact < 0)


def test_a_triangle_given_twice_is_one(tmp_path: Path) -> None:
    """A cube each of whose triangles begins at another vertex the second time."""
    once = cube((0, 0, 0))
    twice = pv.PolyData.from_regular_faces(once.points, np.concatenate([one := once.regular_faces, np.roll(one, 1, 1)]))
    assert mesh(saved(tmp_path, twice, "twice.vtp")).volume == pytest.approx(1.0, rel=1e-12)


def test_an_off_file_may_begin_with_a_comment(tmp_path: Path) -> None:
    """A unit cube of quads, as geometry programs write it."""
    quads = "4 0 3 2 1\n4 4 5 6 7\n4 0 1 5 4\n4 1 2 6 5\n4 2 3 7 6\n4 3 0 4 7\n"
    corners = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 1\n1 0 1\n1 1 1\n0 1 1\n"
    (tmp_path / "cube.off").write_text(f"# made for a test\nOFF\n8 6 0\n{corners}{quads}", encoding="utf-8")
    assert mesh(str(tmp_path / "cube.off")).volume == pytest.approx(1.0, rel=1e-12)


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]))
def test_rows_are_told_apart_as_numpy_does(seed: int, k: int) -> None:
    rows = np.random.default_rng(seed).integers(-2, 2, (40, k)) * 0.1
    _, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    found = distinct_rows(rows)
    assert np.array_equal(found[0], first) and np.array_equal(found[1], which.reshape(-1))


def test_distances_of_a_torus(tmp_path: Path) -> None:
    """Facets are off by 0.1 (1 - cos(pi / 20)) and 0.4 (1 - cos(pi / 40)) at most; signs are VTK's."""
    torus = pv.ParametricTorus(ringradius=0.3, crosssectionradius=0.1, u_res=41, v_res=21, w_res=4)
    path = saved(tmp_path, torus.triangulate().clean(tolerance=1e-6), "torus.ply")
    form = mesh(path)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (4000, 3)) * [1, 1, 0.5]
    exact = np.hypot(np.hypot(points[:, 0], points[:, 1]) - 0.3, points[:, 2]) - 0.1
    found = form.signed_distance(points)
    depth = 0.1 * (1 - math.cos(math.pi / 20)) + 0.4 * (1 - math.cos(math.pi / 40))
    assert np.all(np.abs(found - exact) < depth)
    surface = pv.PolyData.from_regular_faces(form.surface.vertices, form.surface.triangles)
    right = np.array(pv.PolyData(points).compute_implicit_distance(surface)["implicit_distance"])
    assert np.array_equal(found < 0, right < 0) and np.array_equal(form.contains(points), right < 0)
    assert np.array_equal(form.contains(points, inset=0.03), found <= -0.03)


def test_distances_of_many_triangles(tmp_path: Path) -> None:
    """Far from a ball of 7,200 triangles, and deep in it, too large by 0.3 % of its diameter at most."""
    form = mesh(saved(tmp_path, ball(60)))
    points = np.random.default_rng(2).uniform(-2, 2, (4000, 3)) * np.linspace(0, 1, 4000)[:, None]
    exact = np.linalg.norm(points, axis=1) - R
    error = np.abs(form.signed_distance(points)) - np.abs(exact)
    depth = R * (1 - math.cos(math.pi / 60) ** 2)
    assert np.abs(error).max() < depth + 0.003 * 2 * R
    assert np.abs(error[np.abs(exact) < 0.2 * R]).max() < depth
    assert np.array_equal(form.signed_distance(points) < 0, form.contains(points))


def test_the_grid_of_distances_of_a_box_is_that_of_the_form(tmp_path: Path) -> None:
    """Twelve triangles give the distances of the analytic box."""
    low, high = np.array([0.1, 0.2, 0.3]), np.array([0.9, 0.7, 0.6])
    form = mesh(saved(tmp_path, pv.Box(bounds=np.stack([low, high], axis=1).ravel()).triangulate()))
    box = scene_of({"box": {"min": low.tolist(), "max": high.tolist()}}).bodies[0].shape.form
    assert form.volume == pytest.approx(box.volume, rel=1e-6)
    found, origin, h = distance_grid(form, 0.02, 0.11)
    assert found.dtype == np.float32 and h == 0.02
    last = origin + h * (np.array(found.shape) - 1)
    nodes = np.stack(
        np.meshgrid(*(o + h * np.arange(n) for o, n in zip(origin, found.shape, strict=True)), indexing="ij")
    )
    exact = box.signed_distance(nodes.reshape(3, -1).T).reshape(found.shape)
    assert np.allclose(distance_grid(box, 0.02, 0.11)[0][1, 1, 1], math.sqrt(3) * 0.09, rtol=0.1)
    assert np.all(origin <= low - 0.11 + 1e-6) and np.all(last >= high + 0.11 - 1e-6)
    assert np.allclose(np.abs(found), np.abs(exact), rtol=0, atol=1e-6)
    off = np.abs(exact) > 1e-6  # nodes on the surface, of the file's single precision, have either sign
    assert np.array_equal((found < 0)[off], (exact < 0)[off])


@given(
    scale=st.floats(0.01, 100),
    axis=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    angle=st.floats(-360, 360),
    shift=st.tuples(*[st.floats(-10, 10)] * 3),
)
@settings(max_examples=15)
def test_a_mesh_is_scaled_then_turned_then_moved(tmp_path_factory, scale, axis, angle, shift) -> None:
    """Volume as scale^3; a turned vertex keeps its part along the axis and turns by the angle about it."""
    path = tmp_path_factory.getbasetemp() / "cone.ply"
    if not path.exists():
        pv.Cone(resolution=7).triangulate().save(path)
    plain, moved = read_mesh(path), read_mesh(path, scale, axis, angle, shift)
    assert moved.volume == pytest.approx(scale**3 * plain.volume, rel=1e-6)
    n = np.array(axis) / np.linalg.norm(axis)
    before, after = scale * plain.vertices, moved.vertices - shift
    assert np.allclose(before @ n, after @ n, rtol=0, atol=1e-9 * (scale + 10))
    across = [v - (v @ n)[:, None] * n for v in (before, after)]
    turned = np.cos(np.radians(angle)) * across[0] + np.sin(np.radians(angle)) * np.cross(n, across[0])
    assert np.allclose(turned, across[1], rtol=0, atol=1e-8 * (scale + 10))


@pytest.mark.parametrize("name", ["m.stl", "m.ply", "m.vtp", "m.obj", "m.vtu", "m.off"])
def test_every_format_gives_the_same_surface(tmp_path: Path, name: str) -> None:
    """One surface in several files; the VTU holds cells, whose surface it is. Single precision: 1e-6."""
    cells = pv.ImageData(dimensions=(4, 3, 2)).cast_to_unstructured_grid()
    surface = pv.Box(bounds=(0, 3, 0, 2, 0, 1)).triangulate()
    if name == "m.vtu":
        cells.save(tmp_path / name)
    elif name in ("m.obj", "m.off"):
        pv.save_meshio(tmp_path / name, surface)
    else:
        surface.save(tmp_path / name)
    form = mesh(str(tmp_path / name))
    assert form.volume == pytest.approx(6.0, rel=1e-6)
    assert np.allclose(form.bounds(), [[0, 0, 0], [3, 2, 1]], atol=1e-6)


def test_cells_may_be_inside_out(tmp_path: Path) -> None:
    """A box of tetrahedra, every third of which has a negative volume."""
    cells = pv.ImageData(dimensions=(4, 3, 2)).to_tetrahedra()
    corners = cells.cells.reshape(-1, 5).copy()
    corners[::3, 1:3] = corners[::3, 2:0:-1]
    pv.UnstructuredGrid(corners, cells.celltypes, cells.points).save(tmp_path / "m.vtu")
    assert mesh(str(tmp_path / "m.vtu")).volume == pytest.approx(6.0, rel=1e-6)


def test_a_binary_ply_may_mix_triangles_and_quads(tmp_path: Path) -> None:
    """A cube of five quads and two triangles, as programs for modelling write it."""
    corners = [(x, y, z) for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4), (3, 4, 7)]
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 8\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "element face 7\nproperty list uchar uint vertex_indices\nend_header\n"
    data = np.array(corners, "<f4").tobytes() + b"".join(bytes([len(f)]) + np.array(f, "<u4").tobytes() for f in faces)
    (tmp_path / "cube.ply").write_bytes(head.encode() + data)
    assert mesh(str(tmp_path / "cube.ply")).volume == 1.0


def test_particles_fill_a_mesh(tmp_path: Path) -> None:
    """The mass is that of the enclosed volume; the path is relative to the scene; inverted triangles are turned."""
    saved(tmp_path, ball().flip_faces(), "ball.ply")
    scene = scene_of({"mesh": {"file": "ball.ply", "translate": [0.5, 0.5, 0.5]}}, directory=tmp_path)
    (particles,) = sample_bodies(scene)
    form = scene.bodies[0].shape.form
    assert particles.count * particles.mass == pytest.approx(800 * form.volume, rel=1e-12)
    assert particles.count == pytest.approx(form.volume / 0.025**3, rel=0.02)
    assert np.linalg.norm(particles.position - 0.5, axis=1).max() < R


def wound_twice(n: int = 11) -> pv.PolyData:
    """Return a prism on a polygon that goes twice round the middle, outwards: one shell."""
    turn, radius = 4 * np.pi * np.arange(n) / n, 1 + 0.1 * np.arange(n)
    rim = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(n)], axis=1)
    points = np.concatenate([rim, rim + np.array([0, 0, 1]), [[0, 0, 0], [0, 0, 1]]])
    i, j = np.arange(n), (np.arange(n) + 1) % n
    low, high = np.full(n, 2 * n), np.full(n, 2 * n + 1)
    sides = [(low, j, i), (high, i + n, j + n), (i, j, j + n), (i, j + n, i + n)]
    return pv.PolyData.from_regular_faces(points, np.concatenate([np.stack(one, axis=1) for one in sides]))


BAD = {
    "open": (lambda: pv.Box().triangulate().extract_cells(range(10)).extract_surface(algorithm=None),
         "its surface is open: 4 of 17"),
    "turned": (lambda: pv.PolyData(BOX.points, np.concatenate([BOX.faces[:4][[0, 2, 1, 3]], BOX.faces[4:]])),
         "its triangles face different sides across 3 of 18 edges"),
    "overlap": (lambda: wound_twice(), "its surface overlaps itself, for example at ["),
    "inside out": (lambda: pv.merge([cube((0, 0, 0)), cube((2, 0.1, 0.1), 0.02, -1)], merge_points=False),
         "a part of its surface is inside out, at [2.01, 0.11, 0.11] in its own units"),
    "points": (lambda: pv.PolyData(np.eye(3)), "it holds no triangle"),
}  # fmt: skip
BOX = pv.Box().triangulate()


@pytest.mark.parametrize("name", BAD)
def test_a_file_that_makes_no_closed_surface_is_named(tmp_path: Path, name: str) -> None:
    """One sentence each, with the file in it."""
    made, said = BAD[name]
    path = saved(tmp_path, made(), "bad.vtp")
    with pytest.raises(GeometryFileError, match=said.replace("[", r"\[")):
        read_mesh(path)
    with pytest.raises(InputError, match=r"bodies\[0\].shape.mesh.file: .*bad.vtp: " + said.replace("[", r"\[")):
        scene_of({"mesh": {"file": path}})


@pytest.mark.parametrize(("name", "content"), [
    ("m.stl", b"hello"), ("m.obj", b"v 1 2 x\n"), ("m.ply", b"ply\n"), ("m.vtu", b"<VTK"), ("m.csv", b"1,2,3"),
    ("m.stl", b""),
])  # fmt: skip
def test_a_damaged_file_is_one_sentence_and_nothing_else(
    tmp_path: Path, capfd: pytest.CaptureFixture, name: str, content: bytes
) -> None:
    """VTK writes to the terminal what it thinks of it, unless it is kept from it."""
    (tmp_path / name).write_bytes(content)
    with pytest.raises(GeometryFileError, match=r"not a readable mesh|no triangle|files that are read are"):
        read_mesh(tmp_path / name)
    assert capfd.readouterr() == ("", "")


def test_sentences_of_a_mesh_in_a_scene(tmp_path: Path) -> None:
    """A missing file, two dimensions, millimetres, a mesh beside the domain."""
    saved(tmp_path, ball(), "ball.stl")

    def said(size: tuple[float, ...] = (1.0, 1.0, 1.0), **keys: object) -> str:
        with pytest.raises(InputError) as caught:
            scene_of({"mesh": {"file": "ball.stl", **keys}}, size, tmp_path)
        return str(caught.value)

    assert f"bodies[0].shape.mesh.file: {tmp_path / 'bal.stl'}: there is no such file" in said(file="bal.stl")
    assert "shape.mesh: is a shape of 3D scenes and this one is 2D; use box" in said((1.0, 1.0))
    much = 'body "b" leaves the domain: the mesh is 799.7 x 799.7 x 800 m, the domain 1 x 1 x 1 m'
    assert said(scale=1000).endswith(f"shape: {much}; it would fit with scale = 1")
    assert said(translate=[0.5, 0.5, 0.2]).endswith("; give translate = [0.5, 0.5, 0.4] or enlarge the domain")
    saved(tmp_path, ball().scale(1000), "large.stl")
    assert said(file="large.stl").endswith(f"{much}; if it is in millimetres, give scale = 0.001")
    assert "mesh.rotate.axis: must have a direction" in said(rotate={"axis": [0, 0, 0], "angle": 3})


def test_a_result_is_read_after_its_mesh_is_gone(tmp_path: Path) -> None:
    """The header keeps the volumes of a scene with files, and only of such a scene."""
    path = Path(saved(tmp_path, ball(), "ball.stl"))
    table = {"file": "ball.stl", "translate": [0.5, 0.5, 0.5]}
    scene = scene_of({"mesh": table}, directory=tmp_path)
    facts = {"arch": "cpu", "threads": 1, "precision": "f32"}
    stored = RunHeader.of(scene, scene_to_toml(scene), [laws()["fluid"]], facts).stored
    path.unlink()
    _surface_of.cache_clear()
    (body,) = RunHeader.read(stored).bodies
    assert body.volume == pytest.approx(4 / 3 * math.pi * R**3, rel=0.01)
    plain = scene_of({"ball": {"center": [0.5] * 3, "radius": R}})
    assert "volumes" not in RunHeader.of(plain, scene_to_toml(plain), [laws()["fluid"]], facts).stored


def test_what_check_says_of_a_mesh_is_what_it_says_of_the_ball(tmp_path: Path) -> None:
    """Thickness to a cell of 48; the distance of two balls to a thousandth of them."""
    form = mesh(saved(tmp_path, ball()))
    assert thickness(form) == pytest.approx(2 * R, abs=4 * 2 * R / 48)
    other = Ball.model_validate({"center": [1.0, 0.2, 0.1], "radius": 0.3}, context={"dimension": 3})
    gap = math.dist((1.0, 0.2, 0.1), (0, 0, 0)) - R - 0.3
    assert distance_between(form, other) == pytest.approx(gap, abs=2e-3)


def test_a_sweep_varies_a_mesh_beside_its_base_scene(tmp_path: Path) -> None:
    """Paths are relative to the base scene; scales are drawn, and a body sampled at random gets a seed of its own."""
    (tmp_path / "scenes").mkdir()
    saved(tmp_path / "scenes", ball(12), "ball.stl")
    (tmp_path / "scenes" / "base.toml").write_text(
        "[domain]\nsize = [1.0, 1.0, 1.0]\nspacing = 0.1\n[time]\nend = 1.0\nframes = 1\n"
        '[[bodies]]\nname = "b"\nmaterial = "jelly"\nsampling = "poisson"\n'
        'shape = { mesh = { file = "ball.stl", translate = [0.5, 0.5, 0.5] } }\n',
        encoding="utf-8",
    )
    lines = 'base = "scenes/base.toml"\ncount = 2\n[vary]\n"bodies.b.shape.mesh.scale" = { uniform = [0.5, 1.1] }\n'
    (tmp_path / "sweep.toml").write_text(lines, encoding="utf-8")
    sweep = load_sweep(tmp_path / "sweep.toml", laws=parameter_models())
    bodies = [draw(sweep, number).scene(parameter_models()).scene.bodies[0] for number in range(2)]
    assert bodies[0].seed != bodies[1].seed
    for one in bodies:
        scale = one.shape.mesh.scale
        assert one.shape.form.volume == pytest.approx(
            scale**3 * mesh(str(tmp_path / "scenes/ball.stl")).volume, rel=1e-6
        )
    (tmp_path / "sweep.toml").write_text(lines.replace("1.1", "2.0"), encoding="utf-8")
    with pytest.raises(InputError, match=r'with 2.0: .*"b" leaves the domain: the mesh is 1\.58'):
        load_sweep(tmp_path / "sweep.toml", laws=parameter_models())


@pytest.mark.slow
def test_what_is_left_of_a_mesh_has_its_volume(tmp_path: Path) -> None:
    """Half of a mesh, and a mesh with a hollow: by quadrature, to 1e-4."""
    table = {"mesh": {"file": saved(tmp_path, ball())}}
    whole = mesh(table["mesh"]["file"]).volume
    half = {"box": {"min": [-1, -1, 0], "max": [1, 1, 1]}}
    hollow = {"ball": {"center": [0, 0, 0], "radius": 0.3}}
    for removed, left in ((half, whole / 2), (hollow, whole - 4 / 3 * math.pi * 0.3**3)):
        form = Shape.model_validate({**table, "subtract": [removed]}, context={"dimension": 3}).form
        assert form.volume == pytest.approx(left, rel=1e-4)
