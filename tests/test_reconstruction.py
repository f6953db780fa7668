"""Surfaces of particles in space, and in the plane, against bodies whose size is known."""

from pathlib import Path

import numpy as np
import pytest

from mpmcli.frames.frame import Frame
from mpmcli.render.reconstruction import Mesh, flat_mesh, reconstruct, save_surface, surface_paths, write_series
from mpmcli.render.render_scene import APPEARANCES, RenderScene

LOWER, UPPER = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
DISTANCE = 0.02


def lattice(counts: tuple[int, ...], corner: tuple[float, ...], distance: float = DISTANCE) -> np.ndarray:
    axes = [start + distance * (np.arange(n) + 0.5) for n, start in zip(counts, corner, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(counts))


def ball(radius: float, distance: float = DISTANCE) -> np.ndarray:
    points = lattice((50, 50, 50), (0.0, 0.0, 0.0), distance)
    return points[np.linalg.norm(points - 25 * distance, axis=1) < radius]


def open_edges(mesh: Mesh) -> int:
    """Count edges that do not have exactly one triangle on each side."""
    pairs = np.concatenate([mesh.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    count = np.unique(np.sort(pairs, axis=1), axis=0, return_counts=True)[1]
    return int((count != 2).sum())


def volume(mesh: Mesh) -> float:
    """Volume within a mesh, m^3, by the divergence theorem."""
    corners = (mesh.points[mesh.triangles] - mesh.points.mean(axis=0)).astype(np.float64)
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6.0


def test_the_volume_of_a_ball_is_that_of_its_particles() -> None:
    position = ball(0.2)
    mesh = reconstruct(position, DISTANCE, LOWER, UPPER)
    # The surface is found within a share of a particle: 3 dr / r with dr = distance / 10.
    assert volume(mesh) == pytest.approx(len(position) * DISTANCE**3, rel=0.03)
    radii = np.linalg.norm(mesh.points - 0.5, axis=1)
    assert abs(radii - 0.2).max() < DISTANCE
    assert open_edges(mesh) == 0
    outwards = (mesh.points - 0.5) / radii[:, None]
    assert (mesh.normals * outwards).sum(axis=1).min() > 0.9


def test_a_block_in_a_corner_is_flat_on_its_walls() -> None:
    position = lattice((20, 15, 10), (0.0, 0.0, 0.0))
    mesh = reconstruct(position, DISTANCE, LOWER, UPPER)
    # Only the free edges are rounded: three of 10 to 20 particles, by less than a particle squared each.
    assert volume(mesh) == pytest.approx(len(position) * DISTANCE**3, rel=0.03)
    assert mesh.points.min() >= 0.0
    for axis in range(3):
        on_wall = mesh.points[mesh.points[:, axis] < 1e-6]
        others = [k for k in range(3) if k != axis]
        assert np.ptp(on_wall[:, others], axis=0) == pytest.approx(
            np.ptp(position[:, others], axis=0), abs=DISTANCE * 2
        )
        face = np.isclose(mesh.points[mesh.triangles][:, :, axis], 0.0, atol=1e-6).all(axis=1)
        corners = mesh.points[mesh.triangles[face]].astype(float)
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        assert area.sum() == pytest.approx(np.prod(np.array([20, 15, 10])[others]) * DISTANCE**2, rel=0.03)


@pytest.mark.parametrize("gap", [0.8, 0.95, 1.2, 2.0, 3.0])
def test_a_body_above_a_wall_leaves_nothing_on_it(gap: float) -> None:
    position = lattice((10, 10, 10), (0.3, 0.3, gap * DISTANCE))
    mesh = reconstruct(position, DISTANCE, LOWER, UPPER)
    assert mesh.points[mesh.triangles][..., 2].min() > max(gap - 1.0, 0.3) * DISTANCE
    assert open_edges(mesh) == 0


def test_a_flat_pool_is_flat() -> None:
    """Particles thrown about their places leave a surface smoother than they are."""
    random = np.random.default_rng(5)
    position = lattice((50, 20, 8), (0.0, 0.0, 0.0))
    position += random.uniform(-0.3, 0.3, position.shape) * DISTANCE
    mesh = reconstruct(position, DISTANCE, LOWER, (1.0, 0.4, 1.0))
    middle = (np.abs(mesh.points[:, :2] - (0.5, 0.2)) < (0.4, 0.1)).all(axis=1) & (mesh.points[:, 2] > 0.1)
    height = mesh.points[middle, 2]
    assert height.std() < 0.1 * DISTANCE
    assert height.mean() == pytest.approx(8 * DISTANCE, abs=0.3 * DISTANCE)


def test_the_mesh_is_the_same_at_every_call() -> None:
    random = np.random.default_rng(1)
    position = random.uniform(0.0, 0.5, (4000, 3))
    rows = random.uniform(size=4000)
    first = reconstruct(position, DISTANCE, LOWER, UPPER, {"rows": rows})
    for _ in range(4):
        again = reconstruct(position, DISTANCE, LOWER, UPPER, {"rows": rows})
        for name in ("points", "triangles", "normals"):
            assert getattr(first, name).tobytes() == getattr(again, name).tobytes(), name
        assert first.attributes["rows"].tobytes() == again.attributes["rows"].tobytes()


def test_a_linear_field_is_carried_over() -> None:
    position = ball(0.2)
    mesh = reconstruct(position, DISTANCE, LOWER, UPPER, {"x": position[:, 0]})
    # Means over the kernel are drawn inwards by the centroid of the half that is full.
    assert np.abs(mesh.attributes["x"] - mesh.points[:, 0]).max() < 1.5 * DISTANCE
    assert np.corrcoef(mesh.attributes["x"], mesh.points[:, 0])[0, 1] > 0.999


def test_few_particles_do_not_fail() -> None:
    one = reconstruct(np.array([[0.5, 0.5, 0.5]]), DISTANCE, LOWER, UPPER)
    # It must not be smoothed away; the kernel reaches two and a half radii, so that it may be somewhat large.
    assert 0.5 < volume(one) / DISTANCE**3 < 3.0
    lost = np.array([[np.nan, 0.5, 0.5], [0.5, np.inf, 0.5], [7.0, 0.5, 0.5]])
    assert len(reconstruct(lost, DISTANCE, LOWER, UPPER, {"a": np.zeros(3)}).triangles) == 0
    assert len(reconstruct(np.empty((0, 3)), DISTANCE, LOWER, UPPER).points) == 0
    both = reconstruct(np.concatenate([lost, [[0.5, 0.5, 0.5]]]), DISTANCE, LOWER, UPPER)
    assert volume(both) == pytest.approx(volume(one))


@pytest.mark.parametrize("corner", [(0.0, 0.0), (0.3, 0.2)])
def test_the_area_of_a_flat_block_is_that_of_its_particles(corner: tuple[float, float]) -> None:
    position = lattice((30, 20), corner)
    mesh = flat_mesh(position, DISTANCE, LOWER, UPPER)
    assert area_of(mesh) == pytest.approx(600 * DISTANCE**2, rel=0.02)
    assert mesh.points[:, :2].min(axis=0) == pytest.approx(corner, abs=0.1 * DISTANCE)
    assert not mesh.points[:, 2].any()


def test_a_flat_disk_and_its_hole() -> None:
    position = lattice((50, 50), (0.0, 0.0))
    radii = np.linalg.norm(position - 0.5, axis=1)
    ring = position[(radii < 0.3) & (radii > 0.15)]
    mesh = flat_mesh(ring, DISTANCE, LOWER, UPPER)
    assert area_of(mesh) == pytest.approx(len(ring) * DISTANCE**2, rel=0.01)
    middles = mesh.points[mesh.triangles].mean(axis=1)[:, :2]
    assert np.linalg.norm(middles - 0.5, axis=1).min() > 0.15 - DISTANCE


def area_of(mesh: Mesh) -> float:
    a, b, c = (mesh.points[mesh.triangles[:, k], :2].astype(float) for k in range(3))
    twice = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    assert (twice > 0).all()
    return 0.5 * float(twice.sum())


def subject_with(dimension: int, *names: str) -> RenderScene:
    upper = UPPER if dimension == 3 else (1.0, 1.0, 0.0)
    up = (0.0, 0.0, 1.0) if dimension == 3 else (0.0, 1.0, 0.0)
    bodies = tuple(range(len(names)))
    appearances = tuple(APPEARANCES[name] for name in names)
    distances, densities = (DISTANCE,) * len(names), (1e3,) * len(names)
    return RenderScene("", dimension, LOWER, upper, up, names, appearances, bodies, distances, densities)


def frame_of(position: np.ndarray, body: np.ndarray | int = 0, index: int = 12) -> Frame:
    bodies = np.broadcast_to(np.asarray(body, dtype=np.int32), len(position))
    return Frame(index, 0.25, 7, position, np.zeros_like(position), bodies, np.zeros_like(bodies))


@pytest.mark.parametrize("dimension", [2, 3])
def test_saved_surfaces_are_read_by_others(dimension: int, tmp_path: Path) -> None:
    import pyvista as pv

    scene = subject_with(dimension, "water", "sand")
    first, second = (lattice((12,) * dimension, (corner,) * dimension) for corner in (0.0, 0.5))
    frame = frame_of(np.concatenate([first, second]), np.repeat([0, 1], 12**dimension))
    written = save_surface(scene, frame, tmp_path / "meshes")
    assert written == surface_paths(scene, tmp_path / "meshes", 12)
    assert [path.name for path in written[:2]] == ["surface_water_000012.vtp", "surface_water_000012.obj"]
    for path, corner in zip(written, (0.0, 0.0, 0.5, 0.5), strict=True):
        data = pv.read(path)
        size = data.volume if dimension == 3 else data.area
        assert size == pytest.approx((12 * DISTANCE) ** dimension, rel=0.06), path.name
        assert data.bounds[0] == pytest.approx(corner, abs=0.3 * DISTANCE)
    if dimension == 3:
        # An OBJ has y up, the z of the scene, and x to the right: turned by 90 degrees about x, without a mirror.
        upright, turned = (np.asarray(pv.read(path).points) for path in written[2:4])
        assert np.allclose(turned, np.stack([upright[:, 0], upright[:, 2], -upright[:, 1]], axis=1), atol=1e-6)
    assert pv.read(written[0]).field_data["TimeValue"][0] == 0.25
    index = write_series(scene, tmp_path / "meshes", [(13, 0.5), (12, 0.25)])[0]
    assert index.read_text().index("000012") < index.read_text().index("000013")


def test_a_material_without_particles_has_an_empty_file(tmp_path: Path) -> None:
    import pyvista as pv

    paths = save_surface(subject_with(3, "water"), frame_of(np.full((3, 3), np.nan)), tmp_path)
    assert [path.name for path in paths] == ["surface_water_000012.vtp", "surface_water_000012.obj"]
    assert pv.read(paths[0]).n_points == 0
