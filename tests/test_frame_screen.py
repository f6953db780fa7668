"""Frames that are looked at together: the check of a run says what it says where each is looked at by itself."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from check_scenes import box
from hypothesis import given, settings
from hypothesis import strategies as st
from solver_state import scene_of

from mpmcli.check import result_check, result_motion
from mpmcli.check.result_check import ResultCheck, check_kept
from mpmcli.check.result_entries import kept_entries
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader
from mpmcli.scene import scene_to_toml
from mpmcli.solver.engine.build import build_run

FRAMES = 24


class Run(NamedTuple):
    header: RunHeader
    frames: list[Frame]
    ledger: list[LedgerRow]

    def __repr__(self) -> str:
        return f"Run of {len(self.frames)} frames"


@pytest.fixture(scope="module")
def run(backend_of: Callable) -> Run:
    """A drop of water that falls, hits the floor and splashes."""
    scene = scene_of(
        domain={"size": [1.0, 1.0], "cells": [32, 32], "gravity": [0.0, -9.81], "walls": "separate"},
        time={"end": 0.6, "frames": FRAMES},
        bodies=[
            {
                "name": "drop",
                "material": {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5},
                "shape": box([0.3, 0.5], [0.6, 0.8]),
            }
        ],
    )
    backend = {"arch": "cpu", "threads": 1, "precision": "f32"}
    header = RunHeader.of(scene, scene_to_toml(scene), [laws()["fluid"]], backend)
    frames, rows = zip(*build_run(scene, backend_of("f32", 1)).frames(), strict=True)
    return Run(header, list(frames), list(rows))


def one_by_one(run: Run) -> ResultCheck:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(result_check, "screen", lambda *_: None)
        return check_kept(*run)


def changed(run: Run, k: int, p: int, fault: str) -> Run:
    """Return the run with a fault at a particle of a frame."""
    header, frames, rows = run[0], list(run[1]), list(run[2])
    frame = frames[k]
    position, velocity = frame.position.copy(), frame.velocity.copy()
    fields = {name: array.copy() for name, array in frame.fields.items()}
    match fault:
        case "nan":
            velocity[p, 1] = np.nan
        case "field":
            fields["pressure"][p] = np.inf
        case "outside":
            position[p, 0] = 1.01
        case "wall":
            position[:, 1] = 0.0
        case "far":
            position[p] += 0.4 * (0.5 - position[p])
        case "nearby":
            position[p] += 1.2 / 32
        case "crushed":
            # The ledger follows the frame, as both are of the solver.
            fields["density"][p] *= 20
            rows[k] = replace(rows[k], volume_ratio_min=float(1000.0 / fields["density"][p]))
        case "repeated" if k:
            position, velocity = frames[k - 1].position.copy(), frames[k - 1].velocity.copy()
        case "missing":
            del frames[k], rows[k]
            return Run(header, frames, rows)
    frames[k] = replace(frame, position=position, velocity=velocity, fields=fields)
    return Run(header, frames, rows)


def assert_same(found: ResultCheck, expected: ResultCheck) -> None:
    assert [f.as_dict() for f in found.findings] == [f.as_dict() for f in expected.findings]
    assert found.figures.keys() == expected.figures.keys()
    for name, figure in expected.figures.items():
        assert found.figures[name] == (figure and pytest.approx(figure, rel=1e-6, nan_ok=True)), name


def test_nearly_all_frames_of_a_sound_run_need_no_second_look(run: Run) -> None:
    quiet = result_motion.screen(run[0], kept_entries(*run).entries).quiet
    assert quiet.tolist() == [False] + [True] * FRAMES
    assert_same(check_kept(*run), one_by_one(run))


@settings(max_examples=60, deadline=None)
@given(
    k=st.integers(0, FRAMES),
    p=st.integers(0, 300),
    fault=st.sampled_from(
        ["nan", "field", "outside", "wall", "far", "nearby", "crushed", "repeated", "missing", "none"]
    ),
    at_once=st.sampled_from([1, 3_000, 2**18]),
)
def test_what_is_wrong_is_found_wherever_it_is(run: Run, k: int, p: int, fault: str, at_once: int) -> None:
    faulty = changed(run, k, p, fault)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(result_motion, "AT_ONCE", at_once)
        found = check_kept(*faulty)
    assert_same(found, one_by_one(faulty))


@pytest.mark.parametrize(
    "fault", ["nan", "field", "outside", "wall", "far", "nearby", "crushed", "repeated", "missing"]
)
def test_each_fault_is_one(run: Run, fault: str) -> None:
    """The property above compares findings that there are."""
    assert len(check_kept(*changed(run, 9, 150, fault)).findings) > len(check_kept(*run).findings)


def test_a_run_with_fields_of_their_own_checks_is_not_screened(run: Run) -> None:
    header, frames, rows = run
    frames = [replace(frame, fields={**frame.fields, "mass": np.ones(len(frame.position))}) for frame in frames]
    assert result_motion.screen(header, kept_entries(header, frames, rows).entries) is None
