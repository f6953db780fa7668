"""The cost table: every law on the same column, measured in turn, and held to its targets. No clock decides here."""

import importlib.util
import json
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import Annotated, Literal

import pytest
from command import run_here
from fake_contestant import FakeWorker, figures_of
from pydantic import Field

from mpmcli.bench import contestant, materials
from mpmcli.bench.cases import BenchCase
from mpmcli.bench.materials import cost_record, cost_table, parts_of, run_costs
from mpmcli.bench.side import BenchOptions, Setting, start_worker
from mpmcli.errors import RunError
from mpmcli.materials.law import StateBound
from mpmcli.materials.registry import laws, parameter_models
from mpmcli.scene import Scene, estimate_particles, parse_scene
from mpmcli.scene.bounds import scene_bounds
from mpmcli.scene.material import Knob, MaterialParameters
from mpmcli.scene.quantity import Positive
from mpmcli.stability.limits import mode_limit

SCRIPTS = Path(__file__).resolve().parent.parent / "scripts"
SMALL = BenchCase(dimension=2, cells=16, particles=576, step=5e-5)
CASES = materials.MATERIAL_CASES


def scene(names: tuple[str, ...], case: BenchCase) -> Scene:
    data = materials.scene_of(names, case, "f32")
    return parse_scene(data, laws=parameter_models(), source="bench").scene


class TestColumn:
    @pytest.mark.parametrize("case", [*CASES, SMALL], ids=lambda case: case.name)
    @pytest.mark.parametrize("names", [("fluid",), ("fluid", "sand")], ids=" + ".join)
    def test_particles_are_as_many_and_shared_equally(self, names: tuple[str, ...], case: BenchCase) -> None:
        column = scene(names, case)
        assert estimate_particles(column) == case.particles
        volumes = [body.shape.form.volume for body in column.bodies]
        assert volumes == pytest.approx([volumes[0]] * len(names))

    def test_a_place_without_a_law_is_empty_and_the_rest_is_as_before(self) -> None:
        whole, half = scene(("fluid", "sand"), SMALL), scene(("", "sand"), SMALL)
        assert half.bodies == whole.bodies[1:]
        assert half.domain == whole.domain

    @pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
    @pytest.mark.parametrize("law", sorted(laws()))
    def test_the_step_is_far_from_the_limit_of_every_law_at_rest(self, law: str, case: BenchCase) -> None:
        """So that one step serves all, with room for what stiffens under load."""
        column = scene((law,), case)
        parameters, _ = column.bodies[0].material.resolve(scene_bounds(column))
        modes = laws()[law]((parameters,), case.dimension).modes(parameters, StateBound())
        limits = [
            mode_limit(column.domain.spacing, parameters.density, mode.stiffness, mode.viscosity)[0] for mode in modes
        ]
        assert 4 * case.step < min(limits) < 8 * case.step

    def test_every_law_has_the_same_density_and_stiffness(self) -> None:
        found = [materials.material_of(model) for model in parameter_models()]
        assert {material["density"] for material in found} == {1000}
        assert {material[key] for material in found for key in ("youngs_modulus", "bulk_modulus") if key in material}
        assert {material["law"] for material in found} == set(laws())

    def test_mixes_are_of_laws_that_exist(self) -> None:
        assert {name for mix in materials.MIXES for name in mix} <= set(laws())


class TestNewLaws:
    """A law brings what the benchmark needs in its own file."""

    def test_a_parameter_that_must_be_given_is_taken_from_its_knob(self) -> None:
        class Parameters(MaterialParameters):
            law: Literal["slime"] = "slime"
            stickiness: Annotated[Positive, Field(description="Pa."), Knob("stick", 1.0, 100.0, "0 is dry")]

        assert materials.material_of(Parameters) == {
            "law": "slime",
            "density": 1000.0,
            "stickiness": pytest.approx(10.0),
        }

    def test_without_a_knob_the_law_is_named(self) -> None:
        class Parameters(MaterialParameters):
            law: Literal["slime"] = "slime"
            stickiness: Annotated[Positive, Field(description="Pa.")]

        with pytest.raises(RunError, match='The law "slime" needs stickiness'):
            materials.material_of(Parameters)


class Spring:
    """A simulation of which a step takes 10 ms of a clock of its own, and the more the further it has gone."""

    particles = 7
    bytes_per_particle = 64
    threads = 1
    smallest_step = 1e-3

    def __init__(self) -> None:
        self.now, self.place, self.kept = 0.0, 0, -1

    @property
    def watch_seconds(self) -> float:
        return 0.02 * self.now

    def advance(self, count: int) -> int:
        for _ in range(count):
            self.place += 1
            self.now += 0.01 * self.place
        return count

    def sync(self) -> None:
        pass

    def is_sound(self) -> bool:
        return True

    def keep(self) -> None:
        self.kept = self.place

    def rewind(self) -> None:
        self.place = self.kept
        self.now += 100

    def flowing(self) -> float:
        return 0.5


class TestWorker:
    def test_the_same_steps_are_taken_again_and_rewinding_is_free(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Steps 4, 5 and 6 take 0.15 s, so that a block of 0.4 s has three times these."""
        spring, answers = Spring(), []
        for clock in ("perf_counter", "process_time"):
            monkeypatch.setattr(contestant.time, clock, lambda: spring.now)
        commands = ["first\n", "keep 2\n", "repeat 3 0.4\n", "repeat 3 0\n", "flowing\n", "finish\n"]
        assert contestant.serve(lambda: spring, commands, lambda **values: answers.append(values)) == 0
        _, _, kept, *blocks, flowing, _ = answers
        assert kept == {}
        for block, times in zip(blocks, (3, 1), strict=True):
            assert block["steps"] == 3 * times
            assert block["seconds"] == block["processor_seconds"] == pytest.approx(0.15 * times)
            assert block["watch_seconds"] == pytest.approx(0.02 * 0.15 * times)
        assert flowing == {"share": 0.5}

    def test_a_column_runs_in_its_own_process(self) -> None:
        """Of two laws, and late enough that some sand flows: the same steps from the kept state let the same flow."""
        with start_worker("sand,neo_hookean", SMALL, Setting(threads=1)) as process:
            assert process.ready["particles"] == SMALL.particles
            assert process.ready["bytes_per_particle"] > 50
            assert process.ask("first")["seconds"] > 0
            process.ask("keep 700")
            assert process.ask("repeat 10 0.01")["steps"] % 10 == 0
            shares = [process.ask("flowing")["share"]]
            process.ask("repeat 10 0")
            shares.append(process.ask("flowing")["share"])
            assert 0 < shares[0] == shares[1] < 1
            assert process.ask("finish")["sound"] is True

    def test_an_unknown_law_is_a_sentence(self) -> None:
        with pytest.raises(RunError, match=r"There is no law lead\."):
            start_worker("lead", SMALL, Setting(threads=1))


# ns per particle and step.
COSTS = {"fluid": 40.0, "neo_hookean": 60.0, "sand": 180.0, "fluid,": 42.0, ",sand": 188.0, "fluid,sand": 126.5}


def started(who: str, log: list[tuple[str, str]], particles: int = SMALL.particles) -> FakeWorker:
    if "" in who.split(","):
        particles //= 2
    return FakeWorker(who, 1e-9 * COSTS[who] * particles, particles, SMALL.step, log=log, wall=2)


class TestRun:
    def run(self, threads: int = 1, fails: str = "", **options) -> tuple[dict, list[tuple[str, str]]]:
        log, workers = [], []

        def start(who: str, case: BenchCase, setting: Setting) -> FakeWorker:
            if who == fails:
                raise RunError("It has no stiffness.")
            workers.append(started(who, log))
            return workers[-1]

        names, mixes = ["fluid", "neo_hookean", "sand"], [("fluid", "sand")]
        chosen = BenchOptions((threads,), 0.5, blocks=2, start=start, **options)
        record = run_costs([SMALL], chosen, names=names, mixes=mixes)
        assert all(fake.closed for fake in workers)
        return record, log

    def test_blocks_are_in_turn(self) -> None:
        _, log = self.run()
        assert [who for who, command in log if command.startswith("repeat")] == [*COSTS] * 2
        assert {command for _, command in log if command.startswith(("keep", "repeat"))} == {
            "keep 1000",
            "repeat 200 0.5",
        }

    def test_costs_and_ratios(self) -> None:
        record, _ = self.run()
        assert [row["ns_per_particle_step"] for row in record["results"]] == pytest.approx([*COSTS.values()])
        assert record["results"][0]["compile_s"] == pytest.approx(2.0)
        assert record["results"][0]["watch_share"] == pytest.approx(0.01)
        _, _, sand, _, _, mix = record["results"]
        assert sand["over_fluid"] == pytest.approx(4.5)
        assert parts_of("fluid,sand") == ["fluid,", ",sand"]
        assert mix["over_sum_of_parts"] == pytest.approx(1.1)

    def test_several_threads_are_timed_by_the_wall(self) -> None:
        record, _ = self.run(threads=2)
        assert record["results"][0]["ns_per_particle_step"] == pytest.approx(80)
        assert record["clock"] == "wall time"

    def test_progress_is_told(self) -> None:
        lines = []
        self.run(progress=lines.append)
        assert len(lines) == 9
        assert lines[-1] == (
            "2d-16: block 2 of 2, ns: fluid 40, neo_hookean 60, sand 180, half of fluid 42, half of sand 188, "
            "fluid + sand 126"
        )

    def test_a_law_that_cannot_run_is_left_out_with_a_reason(self) -> None:
        record, _ = self.run(fails=",sand")
        assert [(row["laws"], row["share_of_column"]) for row in record["results"]][3:] == [
            (["fluid"], 0.5),
            (["fluid", "sand"], 1.0),
        ]
        assert record["results"][-1]["over_sum_of_parts"] is None
        assert record["flaws"] == ["half of sand at 2d-16 could not be measured. It has no stiffness."]
        assert "Beware: half of sand at 2d-16 could not be measured." in cost_table(record)

    def test_another_number_of_particles_is_refused(self) -> None:
        options = BenchOptions(start=lambda who, case, setting: started(who, [], particles=575))
        assert "575 particles instead of 576" in run_costs([SMALL], options, names=["fluid"], mixes=[])["flaws"][0]


class TestCommand:
    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (["--case", "3d-128"], 'error: there is no case "3d-128"; the cases are 2d-128, 3d-64.'),
            (["--quick"], "error: --quick is about the comparison"),
        ],
    )
    def test_options_of_the_comparison_are_refused(self, arguments: list[str], sentence: str) -> None:
        outcome = run_here("bench", "--materials", *arguments)
        assert outcome.status == 2
        assert outcome.stderr.startswith(sentence)


FACTS = {"compile_s": 1.94, "device_bytes_per_particle": 104, "flowing": 0.66, "watch_share": 0.012}
HALF = FACTS | {"particles": CASES[0].particles // 2}


class TestReport:
    fluid = figures_of("fluid", CASES[0], (20e-9, 22e-9, 30e-9), **FACTS)
    neo_hookean = figures_of("neo_hookean", CASES[0], (30e-9, 33e-9, 40e-9), **FACTS)
    corotated = figures_of("fixed_corotated", CASES[0], (60e-9, 72.6e-9, 80e-9), **FACTS)
    left = figures_of("fluid,", CASES[0], (21e-9, 23e-9, 24e-9), **HALF)
    right = figures_of(",neo_hookean", CASES[0], (30e-9, 32e-9, 34e-9), **HALF)
    mix = figures_of("fluid,neo_hookean", CASES[0], (25e-9, 27.5e-9, 34e-9), **FACTS)

    def record(self, *results: dict) -> dict:
        results = results or (self.fluid, self.neo_hookean, self.corotated, self.left, self.right, self.mix)
        return cost_record(results, [], BenchOptions()) | {"machine": {"processor": "A processor", "taichi": "1.7.4"}}

    def test_table(self) -> None:
        lines = [" ".join(line.split()) for line in cost_table(self.record()).splitlines()]
        assert lines[0] == "A processor, cpu, 1 thread, f32, taichi 1.7.4"
        assert "2d-128 neo_hookean 33.0 30.0-40.0 1.50 1.00 104 1.9 66 % 1.2 %" in lines
        assert "2d-128 fluid + neo_hookean 27.5 25.0-34.0 1.00 1.9" in lines
        assert "Beware" not in cost_table(self.record())

    def test_targets(self) -> None:
        found = {target["target"]: (target["ratio"], target["met"]) for target in self.record()["targets"]}
        assert found == {
            "fluid over the next cheapest, neo_hookean": (pytest.approx(2 / 3), True),
            "fixed_corotated over neo_hookean": (pytest.approx(2.2), False),
            "fluid + neo_hookean over the sum of its parts": (pytest.approx(1.0), True),
        }
        said = cost_table(self.record())
        assert "2d-128: fixed_corotated over neo_hookean: 2.200, should be at most 2, MISSED." in said

    def test_ratios_are_of_one_case(self) -> None:
        other = self.neo_hookean | {"case": CASES[1].name}
        assert self.record(self.fluid, other)["results"][1]["over_fluid"] is None

    def test_range_of_a_ratio_is_that_of_the_rounds(self) -> None:
        (target,) = self.record(self.fluid, self.neo_hookean)["targets"]
        assert (target["ratio_min"], target["ratio_max"]) == pytest.approx((2 / 3, 0.75))

    def test_table_warns_of_smaller_steps_and_of_a_run_that_broke_down(self) -> None:
        said = cost_table(self.record(self.fluid | {"smallest_step_s": 1e-5, "sound": False}))
        assert "Beware: the limits of fluid at 2d-128 asked for steps down to 1e-05 s, below the 4e-05 s" in said
        assert "Beware: fluid at 2d-128 broke down" in said

    def test_dictionary_is_json(self) -> None:
        found = json.loads(json.dumps(self.record()))
        _, _, corotated, left, _, mix = found["results"]
        assert (left["laws"], left["share_of_column"], left["particles"]) == (["fluid"], 0.5, CASES[0].particles // 2)
        assert corotated["laws"] == ["fixed_corotated"]
        assert corotated["ns_per_particle_step"] == pytest.approx(72.6)
        assert corotated["over_neo_hookean"] == pytest.approx(2.2)
        assert corotated["device_bytes_per_particle"] == 104
        assert mix["over_sum_of_parts"] == pytest.approx(1.0)
        assert found["targets"][0]["met"] is True
        assert found["clock"] == "processor time"

    def test_the_script_writes_both_tables(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.syspath_prepend(str(SCRIPTS))
        loader = SourceFileLoader("materials_table", str(SCRIPTS / "materials_table"))
        script = importlib.util.module_from_spec(importlib.util.spec_from_loader("materials_table", loader))
        monkeypatch.setattr("sys.dont_write_bytecode", True)
        loader.exec_module(script)
        lines = script.tables(self.record()).splitlines()
        assert lines[0].startswith("A processor, cpu, 1 thread, f32, Taichi 1.7.4; 36,864 particles in 2D.")
        assert "| `fixed_corotated` | 72.6 | 3.30 | 2.20 | 104 | 1.9 | 1.2 |" in lines
        assert "| `fluid` + `neo_hookean` | 27.5 | 1.00 |" in lines
        assert lines[-1] == "* Missed, 2d-128: fixed_corotated over neo_hookean: 2.200 instead of 2."
