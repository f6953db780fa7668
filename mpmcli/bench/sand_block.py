"""The sweep of `mpmcli bench --dataset`: a block of dry sand thrown about in a closed square.

It is the scene of the GNS project's generator: 64 x 64 cells, 1,444 particles, and 350 frames of 2.5 ms.
"""

from pathlib import Path

from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.materials.registry import parameter_models

FRAMES = 350
# Time between two frames, s.
INTERVAL = 2.5e-3

SCENE = """\
title = "A block of sand"
[domain]
size = [1.0, 1.0]
cells = [64, 64]
gravity = [0.0, -9.81]
walls = "stick"
[time]
end = {end!r}
frames = {frames}
[[bodies]]
name = "sand"
material = {{ preset = "sand", youngs_modulus = 2.0e6, friction_angle = 30.0 }}
shape = {{ box = {{ min = [0.35, 0.4], max = [0.65, 0.7] }} }}
velocity = [1.0, 0.0]
"""
# What is drawn changes neither the number of particles nor the step.
SWEEP = """\
base = "base.toml"
count = {count}
seed = 1
[vary]
"bodies.sand.material.friction_angle" = {{ uniform = [25, 40] }}
"bodies.sand.velocity.0" = {{ uniform = [-1.0, 1.0] }}
"""


def sand_sweep(directory: Path, count: int, frames: int = FRAMES) -> Sweep:
    """Write the sweep of so many trajectories and its scene to a directory, and return it.

    Args:
        frames: of a trajectory, after the first.
    """
    (directory / "base.toml").write_text(SCENE.format(end=frames * INTERVAL, frames=frames), encoding="utf-8")
    path = directory / "sweep.toml"
    path.write_text(SWEEP.format(count=count), encoding="utf-8")
    return load_sweep(path, laws=parameter_models())
