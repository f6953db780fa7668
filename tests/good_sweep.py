"""A sweep and its base scene that load, to be changed by the tests."""

from pathlib import Path

import pytest

from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.sweep_file import load_sweep
from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models

LAWS = parameter_models()

BASE = """\
[domain]
size = [1.0, 1.0]
cells = [32, 32]
gravity = [0.0, -9.81]
[time]
end = 0.1
frames = 4
[[bodies]]
name = "sand"
material = { preset = "sand", friction_angle = 30.0 }
shape = { box = { min = [0.1, 0.1], max = [0.3, 0.3] } }
sampling = "jittered"
[[bodies]]
name = "stone"
material = "jelly"
shape = { ball = { center = [0.7, 0.2], radius = 0.1 } }
"""

SWEEP = """\
base = "base.toml"
count = 1000
seed = 7
[vary]
"bodies.sand.material.friction_angle" = { uniform = [25, 40] }
"domain.gravity.1" = { choice = [-9.81, -3.7] }
[place]
body = "sand"
count = { integers = [1, 3] }
size = { uniform = [[0.15, 0.15], [0.3, 0.3]] }
velocity = { uniform = [[-2.5, -2.5], [2.5, 2.5]] }
region = { min = [0.2, 0.2], max = [0.8, 0.8] }
min_distance = 0.02
[split]
train = 0.8
valid = 0.1
test = 0.1
"""

# Only what every sweep has; the tests add what they draw.
BARE = 'base = "base.toml"\ncount = 1000\nseed = 7\n'


def sweep_of(text: str, base: str = BASE, count: int | None = None) -> Sweep:
    """Load a file sweep.toml of the present directory that holds the text, with its base scene beside it."""
    Path("base.toml").write_text(base, encoding="utf-8")
    Path("sweep.toml").write_text(text, encoding="utf-8")
    return load_sweep("sweep.toml", laws=LAWS, count=count)


def refusal(text: str, base: str = BASE) -> list[str]:
    """Return the lines with which the sweep is refused."""
    with pytest.raises(InputError) as refused:
        sweep_of(text, base)
    return str(refused.value).splitlines()


def varied(*lines: str, head: str = BARE) -> str:
    """Return a sweep with some lines in [vary]."""
    return "\n".join([head, "[vary]", *lines, ""])
