"""A scene that loads, to be damaged by the tests, and what loading it says."""

from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import LoadedScene, load_scene

GOOD = """\
title = "Dam break"
[domain]
size = [4.0, 2.0]
spacing = 0.02
gravity = [0.0, -9.81]
[time]
end = 1.5
frames = 150
[[bodies]]
name = "column"
material = { law = "fluid", density = 1000.0, bulk_modulus = "auto" }
shape = { box = { min = [0.0, 0.0], max = [1.0, 1.0] } }
[[bodies]]
name = "drop"
shape.ball = { center = [3.0, 1.0], radius = 0.5 }
[bodies.material]
law = "neo_hookean"
density = 1100
youngs_modulus = 1e5
"""


def load(text: str, *overrides: str) -> LoadedScene:
    """Load a file scene.toml, alone in its directory, that holds the text."""
    with TemporaryDirectory() as place, chdir(place):
        Path("scene.toml").write_text(text, encoding="utf-8")
        return load_scene("scene.toml", overrides, laws=parameter_models())


def refusal(text: str, *overrides: str) -> list[str]:
    """Return the lines with which the scene is refused."""
    with pytest.raises(InputError) as refused:
        load(text, *overrides)
    return str(refused.value).splitlines()
