"""Datasets that no solver made: particles of two bodies on smooth paths in a box, written as the sweep writes them."""

from pathlib import Path

import h5py
import numpy as np

from mpmcli.dataset.shard import TrajectoryData, write_trajectory
from mpmcli.frames.ledger import LedgerRow

PAUSE = 0.01
LAWS = ("fluid", "sand")
SPLITS = ("train", "train", "valid", "test")
COUNTS = (30, 24, 36, 24)
SCENE = """\
title = "Two that drift"
domain = {{ origin = [{origin}], size = [{size}], walls = {{ {walls} }}, spacing = 0.05, gravity = [{gravity}] }}
time = {{ end = 0.1, frames = 10 }}
[[bodies]]
name = "pool"
particles_per_cell = {cell}
material = {{ law = "fluid", density = 1000.0, viscosity = {viscosity} }}
shape = {{ box = {{ min = [{low}], max = [{high}] }} }}
[[bodies]]
name = "heap"
particles_per_cell = {cell}
material = {{ law = "sand", density = {density}, friction_angle = 30.0 }}
shape = {{ box = {{ min = [{low}], max = [{high}] }} }}
"""


def made_header(
    dimension: int = 2, *, viscosity: float = 0.0, density: float = 1000.0, origin: float = 0.0, periodic: str = ""
) -> dict:
    """Return the header of a run with two bodies of two laws, in a box of 1 m with cells of 0.05 m.

    `periodic` has the letters of the axes that repeat.
    """

    def vector(value: float) -> str:
        return ", ".join([repr(value)] * dimension)

    text = SCENE.format(
        origin=vector(origin),
        size=vector(1.0),
        walls=", ".join(f'{axis}_{end} = "periodic"' for axis in periodic for end in ("min", "max")),
        gravity=vector(-1.0),
        low=vector(origin + 0.25),
        high=vector(origin + 0.5),
        cell=2**dimension,
        viscosity=viscosity,
        density=density,
    )
    return {
        "version": "0", "title": "Two that drift", "dimension": dimension, "spacing": 0.05,
        "origin": [origin] * dimension, "size": [1.0] * dimension, "bodies": ["pool", "heap"], "materials": list(LAWS),
        "laws": [{"deformation": "J", "coherent": False}, {"deformation": "F", "coherent": False}], "precision": "f32",
        "backend": {"arch": "cpu", "threads": 1, "precision": "f32"}, "scene": text,
    }  # fmt: skip


def made_row(k: int, dimension: int) -> LedgerRow:
    """Return a row of a ledger, other values in each one."""
    steps, step = (10 + k, 1e-3 / (10 + k)) if k else (0, 0.0)
    momentum = tuple(0.1 * (k + axis) for axis in range(dimension))
    angular = (0.5 * k,) if dimension == 2 else (0.5 * k, 0.0, 1.0)
    name = ("wave", "speed")[k % 2] if k else ""
    rates = (1.0 + k, 0.1 * k, 0.9, 1.1, 2.0, 0.5 * k, 0.25 * k, 3.0 - k)
    return LedgerRow(k * PAUSE, steps, 0.9 * step, step, name, *rates, momentum, angular)


def made_trajectory(
    number: int,
    *,
    dimension: int = 2,
    particles: int = 24,
    frames: int = 11,
    split: str = "train",
    dtype: type = np.float32,
    pause: float = PAUSE,
    speed: float = 0.0,
    origin: float = 0.0,
    **header: float | str,
) -> TrajectoryData:
    """Return a trajectory whose paths follow from its number: a third of the particles is of the second body.

    All drift at `speed` along the first axis, and come in again where it repeats.
    """
    rng = np.random.default_rng(number)
    start = rng.uniform(0.2, 0.5, (particles, dimension))
    drift, pull = rng.uniform(-0.5, 0.5, (2, particles, dimension))
    t = (np.arange(frames) * pause)[:, None, None]
    body = (np.arange(particles) % 3 == 2).astype(np.int32)
    drift[:, 0] += speed
    position, velocity = start + drift * t + pull * t**2, drift + 2 * pull * t
    position[..., 0] %= 1.0
    position += origin
    pressure = rng.random((frames, particles)).astype(dtype)
    gradient = rng.random((frames, particles, dimension, dimension)).astype(dtype)
    return TrajectoryData(
        number=number,
        split=split,
        draws={"bodies[0].material.viscosity": header.get("viscosity", 0.0), "name": "wide"},
        header=made_header(dimension, origin=origin, **header),
        position=position.astype(dtype),
        velocity=velocity.astype(dtype),
        body=body,
        material=body,
        time=np.arange(frames) * pause,
        step=np.cumsum([made_row(k, dimension).steps for k in range(frames)]),
        frame=np.arange(frames),
        ledger=[made_row(k, dimension) for k in range(frames)],
        # Not in the order of the alphabet, which must not matter.
        fields={"pressure": pressure, "deformation_gradient": gradient},
    )


def write_dataset(directory: Path, trajectories: list[TrajectoryData], *, compress: bool = False) -> Path:
    """Write trajectories to two shards in turn, and return the directory."""
    (directory / "shards").mkdir(parents=True)
    (directory / "sweep.toml").write_text("", encoding="utf-8")
    for shard in range(min(2, len(trajectories))):
        with h5py.File(directory / "shards" / f"{shard:05d}.h5", "w") as file:
            for trajectory in trajectories[shard::2]:
                write_trajectory(file, trajectory, compress=compress)
    return directory


def made_dataset(directory: Path, **changes: object) -> Path:
    """Write four trajectories: two to train, one to validate, one to test, with different numbers of particles."""
    made = [
        made_trajectory(number, particles=particles, split=split, **changes)
        for number, (particles, split) in enumerate(zip(COUNTS, SPLITS, strict=True))
    ]
    return write_dataset(directory, made)
