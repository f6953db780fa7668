"""The saved state of a run is complete: what is loaded goes on to the same bytes, for every law."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import state_run
from scenes import block, scene, slow

from mpmcli.errors import InputError
from mpmcli.materials.registry import laws
from mpmcli.solver.engine.run import build_run

RUN = Path(state_run.__file__)


# The scenes of the default suite: two laws, forces and expressions; two bodies that collide, in both ways.
USUAL = ("total", "forces", "contact")


@pytest.mark.parametrize(
    ("threads", "names"),
    [(3, USUAL), slow(1, state_run.NAMES), slow(3, state_run.NAMES)],
    ids=["3 threads", "all, 1 thread", "all, 3 threads"],
)
def test_a_loaded_run_has_the_bytes_of_one_that_went_on(threads: int, names: tuple[str, ...]) -> None:
    """Save, 50 steps, load, 50 steps; and the same in another run of the scene, by a route through JSON."""
    done = subprocess.run(
        [sys.executable, str(RUN), str(threads), *names], capture_output=True, text=True, timeout=600, check=True
    )
    found = json.loads(done.stdout)
    assert found.keys() == set(names)
    for name in names:
        assert found[name]["same run"] == [], name
        assert found[name].get("other run", []) == [], name
        assert ("other run" in found[name]) == (name in state_run.TWICE)


def test_there_is_a_scene_for_every_law() -> None:
    """Every law of the registry is in one of the scenes."""
    assert {law for name in state_run.NAMES for law in state_run.laws_in(name)} == set(laws())


def test_a_state_of_another_scene_is_refused(backend_of) -> None:
    backend = backend_of("f32")
    saved = build_run(state_run.scene_named("fluid"), backend).save().copied()
    with pytest.raises(InputError, match="belongs to another scene"):
        build_run(state_run.scene_named("sand"), backend).load(saved)


def test_the_numbers_are_plain(backend_of) -> None:
    """JSON can hold the numbers, and the arrays are numpy's."""
    saved = build_run(state_run.scene_named("fluid"), backend_of("f32")).save().copied()
    assert json.loads(json.dumps(saved.numbers, allow_nan=True)).keys() == saved.numbers.keys()
    assert all(isinstance(array, np.ndarray) for array in saved.arrays.values())


def test_particles_are_read_in_parts(backend_of: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same, whether one launch reads all of them or each seven, as with more than 32-bit indices reach."""
    jelly = {"law": "neo_hookean", "density": 800.0, "youngs_modulus": 6000.0}
    body = block("jelly", jelly, (0.1, 0.1), (0.4, 0.3), velocity_gradient=[[0.0, 1.0], [0.5, 0.0]])
    run = build_run(scene((5, 5), 0.1, [body], 0.1), backend_of("f32", 1))
    for _ in range(5):
        run.step(1e-3)
    whole = run.groups[0].read()
    monkeypatch.setattr("mpmcli.solver.particles.arrays.MOST_READ", 7)
    parts = run.groups[0].read()
    assert len(whole["id"]) > 14 and parts.keys() == whole.keys()
    for name, values in whole.items():
        assert np.array_equal(values, parts[name]), name
