"""The table of what features cost: scenes with and without one, measured in turn. No clock decides here."""

import importlib.util
from importlib.machinery import SourceFileLoader
from pathlib import Path

import numpy as np
import pytest
from command import run_here
from fake_contestant import FakeWorker

from mpmcli.bench import features
from mpmcli.bench.cases import BenchCase
from mpmcli.bench.features import FEATURE_CASES, FEATURES, Feature, feature_table, run_features
from mpmcli.bench.side import BenchOptions, Setting, start_worker
from mpmcli.errors import RunError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import Scene, parse_scene, sample_bodies
from mpmcli.scene.mesh import read_mesh
from mpmcli.scene.triangles import ClosedSurface

SCRIPTS = Path(__file__).resolve().parent.parent / "scripts"
SMALL = BenchCase(dimension=2, cells=16, particles=576, step=1e-3)


def scene(name: str, case: BenchCase, directory: Path) -> Scene:
    (directory / "mesh.obj").write_text(features.octahedron(features.OCTAHEDRON), encoding="utf-8")
    data = features.scene_of(name, case, "f32")
    return parse_scene(data, laws=parameter_models(), directory=directory).scene


class TestScenes:
    @pytest.mark.parametrize("case", FEATURE_CASES, ids=lambda case: case.name)
    def test_all_have_as_much_material_as_the_plain_one(self, case: BenchCase, tmp_path: Path) -> None:
        """A collider displaces what it takes, to a layer of particles; an emitter adds a tenth at most."""
        names = [feature.name for feature in FEATURES]
        assert {feature.base for feature in FEATURES} <= {None, *names}
        for feature in FEATURES:
            found = scene(feature.name, case, tmp_path)
            bodies = sum(len(body.position) for body in sample_bodies(found)[: len(found.bodies)])
            assert bodies == pytest.approx(
                case.particles, rel=0.03 if found.colliders else 0.1 if len(found.bodies) > 1 else 0
            )
            emitted = sum(len(body.position) for body in sample_bodies(found)) - bodies
            assert (0.01 < emitted / bodies < 0.1) == bool(found.emitters)
        counts = [sum(len(b.position) for b in sample_bodies(scene(n, case, tmp_path))) for n in ("jet", "emitter")]
        assert counts[0] == pytest.approx(counts[1], rel=0.01)

    @pytest.mark.parametrize("case", FEATURE_CASES, ids=lambda case: case.name)
    def test_each_differs_from_its_base_by_its_feature(self, case: BenchCase, tmp_path: Path) -> None:
        plain = scene("plain", case, tmp_path)
        for name in ("moving ball", "moving mesh"):
            collider = scene(name, case, tmp_path).colliders[0]
            assert collider.motion.moves
            assert collider.friction == 0
        assert scene("friction of the ball", case, tmp_path).colliders[0].friction > 0
        assert scene("moving wall", case, tmp_path).domain.wall_speed > 0
        assert scene("friction of walls", case, tmp_path).domain.frictions != plain.domain.frictions
        assert scene("force with exp", case, tmp_path).forces
        found = [scene(name, case, tmp_path).solver.f_bar for name in ("jelly", "f_bar")]
        assert found == [False, True]

    def test_the_octahedron_is_closed_and_faces_outward(self, tmp_path: Path) -> None:
        (tmp_path / "mesh.obj").write_text(features.octahedron(0.25), encoding="utf-8")
        surface = ClosedSurface(*read_mesh(tmp_path / "mesh.obj"))
        assert surface.volume == pytest.approx(4 / 3 * 0.25**3)
        assert np.ptp(np.linalg.norm(read_mesh(tmp_path / "mesh.obj")[0], axis=1)) < 1e-6


# ns per particle and step.
COSTS = {"plain": 40.0, "plain again": 40.2, "moving ball": 44.8, "friction of the ball": 45.0}
SOME = FEATURES[:4]


class TestRun:
    def run(self, fails: str = "", wanted: tuple[Feature, ...] = SOME) -> tuple[dict, list]:
        log = []

        def start(who: str, case: BenchCase, setting: Setting) -> FakeWorker:
            if who == fails:
                raise RunError("It has no ball.")
            each = 1e-9 * SMALL.particles * COSTS[who]
            return FakeWorker((who, setting.threads), each, SMALL.particles, SMALL.step, log=log, wall=2)

        return run_features([SMALL], BenchOptions((1, 2), 0.001, blocks=2, start=start), features=wanted), log

    def test_blocks_are_in_turn_and_take_as_many_steps(self) -> None:
        """A block of the first takes 1 ms of wall time, of which a step takes 2 x 40 ns x 576: 22 steps."""
        _, log = self.run()
        measured = [(who, command) for (who, threads), command in log if threads == 1 and "repeat" in command]
        assert measured == [(name, "repeat 100 0") for name in COSTS] + [(name, "repeat 22 0") for name in COSTS] * 2

    def test_ratios_and_bounds(self) -> None:
        record, _ = self.run()
        found = record["features"]
        assert [row["threads"] for row in found] == [1] * 4 + [2] * 4
        assert [row["ns_per_particle_step"] for row in found] == pytest.approx(
            [scale * cost for scale in (1, 2) for cost in COSTS.values()]
        )
        assert [row["ratio"] for row in found[:4]] == [
            None,
            pytest.approx(1.005),
            pytest.approx(1.12),
            pytest.approx(45.0 / 44.8),
        ]
        assert [row["met"] for row in found[:4]] == [None, True, False, True]
        lines = [" ".join(line.split()) for line in feature_table(record).splitlines()]
        assert "2d-16 1 moving ball plain 44.8 1.120 1.120-1.120 1.120 1.10 MISSED" in lines

    def test_a_scene_that_cannot_run_is_left_out_with_a_reason(self) -> None:
        record, _ = self.run(fails="plain")
        assert [row["ratio"] is None for row in record["features"][:3]] == [True, True, False]
        assert record["flaws"][0] == '"plain" at 2d-16 could not be measured. It has no ball.'
        assert "Beware" in feature_table(record)

    def test_a_scene_runs_in_its_own_process(self) -> None:
        """One block is as many steps on, from the time that the last one ended at."""
        with start_worker("friction of the ball", SMALL, Setting(threads=1)) as process:
            assert process.ask("first")["seconds"] > 0
            assert process.ask("repeat 20 0")["steps"] == 20
            end = process.ask("finish")
            assert end["sound"] is True
            assert end["smallest_step"] == pytest.approx(SMALL.step)

    def test_the_script_writes_the_table(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.syspath_prepend(str(SCRIPTS))
        loader = SourceFileLoader("bench_table", str(SCRIPTS / "bench_table"))
        script = importlib.util.module_from_spec(importlib.util.spec_from_loader("bench_table", loader))
        monkeypatch.setattr("sys.dont_write_bytecode", True)
        loader.exec_module(script)
        record, _ = self.run()
        lines = script.features_table(record).splitlines()
        cell = "**1.120** (1.120 to 1.120), 1.120"
        assert f"| moving ball | plain | 1.10 | 44.8 | {cell} | 89.6 | {cell} |" in lines
        assert lines[-1].startswith("* Missed, 2d-16, 2 threads: moving ball, 1.120")


class TestCommand:
    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (["--case", "3d-128"], 'error: there is no case "3d-128"; the cases are 2d-128, 3d-32.'),
            (["--quick"], "error: --features has one table"),
            (["--dataset"], "error: --dataset has one scene"),
        ],
    )
    def test_options_of_others_are_refused(self, arguments: list[str], sentence: str) -> None:
        outcome = run_here("bench", "--features", *arguments)
        assert outcome.status == 2
        assert outcome.stderr.startswith(sentence)
