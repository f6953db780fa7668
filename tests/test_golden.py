"""Small results of every version: what they hold is known by formula, not by what was read before."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from command import run_here

import mpmcli.dataset
from mpmcli.dataset.shard import VERSION
from mpmcli.errors import InputError
from mpmcli.output import open_result
from mpmcli.output.vtkhdf import FORMAT

GOLDEN = Path(__file__).resolve().parent / "golden"
VERSIONS = sorted(int(path.name) for path in GOLDEN.iterdir() if path.is_dir())
# Of fall.toml: m/s^2, m/s, s between frames, and the corner of the block, m.
G, VELOCITY, PAUSE, CORNER = 9.81, (0.5, 1.0), 0.025, (-0.125, 0.5)
# Longest step, s; velocities and energies are those of its middle.
STEP = 0.003


def assert_falls(positions, velocities, times, start) -> None:
    """The centre of mass follows the parabola to the error of a step, and the block keeps its shape."""
    for x, v, t in zip(positions, velocities, times, strict=True):
        fallen = np.array([0.0, -0.5 * G * t**2])
        np.testing.assert_allclose(x.mean(0) - positions[0].mean(0), np.array(start) * t + fallen, atol=G * STEP * t)
        np.testing.assert_allclose(v.mean(0), [start[0], start[1] - G * t], atol=G * STEP + 1e-6)
        np.testing.assert_allclose(x - x.mean(0), positions[0] - positions[0].mean(0), atol=2e-6)


def test_there_is_a_golden_result_of_every_version():
    assert list(range(1, FORMAT + 1)) == VERSIONS and VERSION == FORMAT
    for path in GOLDEN.rglob("*/*"):
        if path.is_dir() and path.parent.parent == GOLDEN:
            assert sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) < 100_000


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("kind", ["packed", "died", "series"])
def test_a_result_of_this_version_falls_freely(version, kind):
    result = open_result(GOLDEN / str(version) / kind)
    count = 3 if kind == "died" else 5
    assert result.frame_count == count and result.field_names == ("density", "pressure")
    np.testing.assert_allclose(result.times, PAUSE * np.arange(count), rtol=1e-12)
    frames = list(result.frames())
    assert_falls(
        [f.position.astype(float) for f in frames], [f.velocity.astype(float) for f in frames], result.times, VELOCITY
    )
    # 8 x 8 particles at the centres of the quarters of cells of 1/16 m.
    lattice = [c + (np.arange(8) + 0.5) / 32 for c in CORNER]
    expected = np.stack(np.meshgrid(*lattice, indexing="ij"), -1).reshape(-1, 2)
    order = np.lexsort(frames[0].position.T[::-1])
    np.testing.assert_allclose(frames[0].position[order], expected, atol=1e-7)
    mass = 700.0 * 0.25**2
    for row, t in zip(result.ledger, result.times, strict=True):
        assert row.mass == pytest.approx(mass, rel=1e-6)
        momentum = (mass * VELOCITY[0], mass * (VELOCITY[1] - G * t))
        np.testing.assert_allclose(row.linear_momentum, momentum, atol=mass * G * STEP)
    assert [collider.name for collider in result.colliders] == ["paddle"]
    # Whole, or without checksums.
    outcome = run_here("info", GOLDEN / str(version) / kind, "--verify")
    assert outcome.status == 0 and ("no checksums" in outcome.stdout) == (version == 1)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_dataset_of_this_version_falls_freely(version):
    path = GOLDEN / str(version) / "dataset"
    dataset = mpmcli.dataset.open(path)
    assert dataset.numbers == (0, 1)
    for trajectory in dataset:
        start = trajectory.draws["bodies.jelly.velocity"]
        assert_falls(trajectory.position.astype(float), trajectory.velocity.astype(float), trajectory.times, start)
        assert [row.steps for row in trajectory.ledger] == [0, 9, 9, 9, 9]
    assert run_here("dataset", "verify", path, "-q").status == 0


def test_a_newer_version_is_refused_in_a_sentence(tmp_path):
    import shutil

    source = GOLDEN / str(FORMAT)
    for kind in ("packed", "series", "dataset"):
        shutil.copytree(source / kind, tmp_path / kind)
    with h5py.File(tmp_path / "packed/particles.vtkhdf", "r+") as file:
        file["mpmcli"].attrs["format"] = FORMAT + 1
    header = tmp_path / "series/particles.json"
    header.write_text(header.read_text().replace(f'"format": {FORMAT}', f'"format": {FORMAT + 1}'))
    with h5py.File(tmp_path / "dataset/shards/00000.h5", "r+") as file:
        file.attrs["version"] = VERSION + 1
    for kind in ("packed", "series"):
        with pytest.raises(InputError, match="newer version of mpmcli"):
            open_result(tmp_path / kind)
    with pytest.raises(InputError, match="newer version of mpmcli"):
        mpmcli.dataset.open(tmp_path / "dataset")
    for kind in ("packed", "series", "dataset"):
        outcome = run_here("info", tmp_path / kind, "--verify")
        assert outcome.status == 1 and "newer version" in outcome.stdout
