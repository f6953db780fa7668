"""Error bars: the formula on synthetic data, siblings that keep walls and drives, and runs that are kept."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from command import run_here
from scenes import block

from mpmcli.error_bars import report
from mpmcli.error_bars.bars import FLOOR, MARGIN, MATTERS, bars_of
from mpmcli.error_bars.observables import DENSITY, Map, Observer, Series, read_observed, spread_quantiles
from mpmcli.error_bars.siblings import CAUSES, NUDGE, LeftOut, Reach, Sibling, siblings_of, tables_of
from mpmcli.error_bars.study import Student, Study, StudyPlan, chosen_causes
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import parameter_models
from mpmcli.output import open_result
from mpmcli.scene import load_scene, parse_scene, sample_bodies
from mpmcli.scene.examples import examples

TIMES = np.linspace(0.0, 1.0, 41)
WHOLE = Reach(np.zeros(2), np.ones(2), np.full(2, 0.5))


def series_of(maps: np.ndarray | None = None, **values: np.ndarray) -> Series:
    """Return a series of observables by name; a double underscore stands for a dot."""
    found = {name.replace("__", "."): np.broadcast_to(one, TIMES.shape) for name, one in values.items()}
    return Series(TIMES, found, np.tile([0.5, 0.5], (len(TIMES), 1)) if maps is None else maps, WHOLE)


def grid(ratio: float) -> Sibling:
    return Sibling(f"x {ratio}", "grid", {}, ratio)


def test_a_first_order_error_is_its_bar_less_the_margin() -> None:
    """With q_h = q + c h, |q_rh - q_h| / (r - 1) is c h for any r; the margin is on top."""
    truth, error = np.sin(TIMES), 0.02
    base = series_of(a__low__x=truth + error)
    runs = [(grid(r), series_of(a__low__x=truth + error * r)) for r in (1.4, 2.0)]
    assert bars_of(base, runs).of["a.low.x"].bar == pytest.approx(MARGIN * error)
    assert bars_of(base, runs, 95).of["a.low.x"].bar == pytest.approx(1.42 * MARGIN * error)


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 3.0])
def test_the_larger_of_two_grids_contains_errors_of_orders_up_to_three(order: float) -> None:
    """With q_h = q + c h^p, |q_rh - q_h| / (r - 1) is c h^p (r^p - 1) / (r - 1): at least the error from p = 1 on."""
    base = series_of(a__low__x=0.01)
    runs = [(grid(r), series_of(a__low__x=0.01 * r**order)) for r in (1.4, 2.0)]
    parts = [(r**order - 1) / (r - 1) for r in (1.4, 2.0)]
    expected = max(*parts, MARGIN * min(parts))
    bar = bars_of(base, runs).of["a.low.x"].bar
    assert bar == pytest.approx(0.01 * expected, rel=1e-4)
    assert (expected >= MARGIN - 1e-9) == (order >= 1)


def test_a_difference_that_crosses_zero_keeps_its_bar() -> None:
    """The largest |cos| within 5 % of the duration around its zero at 1/2 is sin(pi/20)."""
    base, sibling = series_of(a__low__x=0.0), series_of(a__low__x=np.cos(np.pi * TIMES))
    bar = bars_of(base, [(grid(2.0), sibling)]).of["a.low.x"].bar
    assert bar[20] == pytest.approx(MARGIN * math.sin(math.pi * 0.05))
    assert bar[0] == pytest.approx(MARGIN)


def test_causes_add_as_squares_and_the_largest_sibling_counts() -> None:
    base = series_of(a__low__x=0.0)
    runs = [(grid(2.0), series_of(a__low__x=0.3 / MARGIN))]
    runs += [(Sibling(f"s{k}", "sample", {}), series_of(a__low__x=off)) for k, off in enumerate((0.1, -0.4))]
    one = bars_of(base, runs).of["a.low.x"]
    assert one.bar == pytest.approx(0.5) and one.main_cause(0) == "sample, grid"


def test_the_map_of_the_mass_counts_what_is_elsewhere() -> None:
    """A quarter of the mass that moves to the other node is 1/4, and so is the difference at ratio 2."""
    base, moved = series_of(), series_of(np.tile([0.75, 0.25], (len(TIMES), 1)))
    assert bars_of(base, [(grid(2.0), moved)]).of[DENSITY].bar == pytest.approx(MARGIN / 4)


def test_what_is_conserved_has_a_bar_of_rounding_beside_what_moves() -> None:
    base = series_of(a__velocity__x=1e-10, a__velocity__y=TIMES)
    bars = bars_of(base, [(grid(2.0), series_of(a__velocity__x=3e-10, a__velocity__y=TIMES))])
    one = bars.of["a.velocity.x"]
    assert one.size == 1.0 and one.bar == pytest.approx(FLOOR) and one.text(-1) == "0.000000 ± 0.000010"
    assert one.main_cause(-1) == ""


def test_what_coarser_grids_do_not_have_has_no_bar() -> None:
    """A volume error is there where cells are inside of a liquid: no cell of a coarser grid says nothing of it."""
    there, late = np.where(TIMES < 0.5, 0.1, np.nan), np.where(TIMES > 0.7, 0.1, np.nan)
    runs = [(grid(1.4), series_of(a=there)), (grid(2.0), series_of(b=1.0))]
    bars = bars_of(series_of(a=0.1, b=late, c=1.0), runs).of
    assert list(bars) == [DENSITY, "a", "b"]
    assert (np.isfinite(bars["a"].value) == (TIMES < 0.5)).all() and (
        np.isfinite(bars["b"].value) == (TIMES > 0.7)
    ).all()
    assert (bars["a"].bar[TIMES > 0.5] == 0).all()


def test_what_spins_in_place_is_compared_with_its_momentum() -> None:
    """L <= R sqrt(2 m E): its centre at rest is no measure. A spin that is 10 % off has that bar."""
    mass, energy = 8.0, 4.0
    at_rest = {"a__velocity__x": 1e-10, "energy__kinetic": energy}
    base = replace(series_of(spin__z=5.0, spin__x=1e-9, **at_rest), mass=mass)
    bars = bars_of(base, [(grid(2.0), series_of(spin__z=5.0 + 0.5 / MARGIN, spin__x=2e-9, **at_rest))]).of
    assert bars["spin.z"].size == pytest.approx(math.sqrt(2 * mass * energy))
    assert bars["spin.z"].text(-1) == "5.0 ± 0.5" and bars["a.velocity.x"].size == 1.0
    assert bars["spin.x"].bar == pytest.approx(FLOOR * bars["spin.z"].size)


@pytest.mark.parametrize("moved", [0.02, 0.2])
def test_a_choice_of_the_model_counts_where_it_moves_more_than_the_grid(moved: float) -> None:
    """It is compared on the coarse grid: by 0.02 it is within the bar of the grid, by 0.2 the bar contains both."""
    base, coarse = series_of(a__low__x=0.0, a__high__x=1.0), series_of(a__low__x=0.1, a__high__x=1.0)
    other = Sibling("automatic moduli x 0.5", "model", {}, 2.0)
    still = series_of(a__low__x=0.1 + moved, a__high__x=1.0 + 0.9 * MATTERS)
    bars = bars_of(base, [(grid(2.0), coarse), (other, still)])
    expected = math.hypot(MARGIN * 0.1, moved if moved > MARGIN * 0.1 else 0.0)
    assert bars.of["a.low.x"].bar == pytest.approx(expected, rel=1e-6)
    assert dict(bars.depends) == ({other.name: ["a.low.x"]} if moved > MARGIN * 0.1 else {})
    assert not bars_of(base, [(other, still)]).of


def test_runs_part_where_rounding_moves_half_a_percent_of_the_mass() -> None:
    far = np.where(TIMES > 0.6, 0.006, 0.004)
    maps = np.stack([0.5 + far, 0.5 - far], axis=1)
    runs = [(Sibling("gravity", "rounding", {}), series_of(maps))]
    assert bars_of(series_of(), runs).parted == pytest.approx(TIMES[TIMES > 0.6][0])
    assert bars_of(series_of(), []).parted is None


@pytest.mark.parametrize(("value", "bar", "said"), [
    (0.8314, 0.0234, "0.831 ± 0.023"),
    (0.8314, 0.051, "0.83 ± 0.05"),
    (12401, 54.2, "12401 ± 54"),
    (0.2, 3, "0 ± 3"),
    (0.459, 0.0099, "0.459 ± 0.010"),
])  # fmt: skip
def test_a_value_has_the_digits_of_its_bar(value: float, bar: float, said: str) -> None:
    found = bars_of(series_of(a__low__x=value), [(grid(2.0), series_of(a__low__x=value + bar / MARGIN))])
    assert found.of["a.low.x"].text(-1) == said


def test_extents_do_not_depend_on_the_number_of_particles() -> None:
    """A bar from 0 to 1 of any number of particles, each with its width: quantiles are the shares."""
    for n in (7, 40):
        x = (np.arange(n) + 0.5) / n
        assert spread_quantiles(x, 1 / n, (0.01, 0.5, 0.99)) == pytest.approx([0.01, 0.5, 0.99])


def scene_of(*overrides: str, name: str = "dam_break_2d"):
    return load_scene(examples()[name], overrides, laws=parameter_models()).scene


@pytest.mark.parametrize("name", sorted(examples()))
def test_coarser_examples_keep_walls_bodies_and_drives(name: str) -> None:
    """All examples have two coarser grids; faces that material is near stay, and nothing but domain changes."""
    scene = scene_of(name=name)
    tables = tables_of(scene)
    low, high = (np.array(scene.domain.origin), np.array(scene.domain.origin) + scene.domain.size)
    reach = Reach(low, high.copy(), (low + high) / 2)
    h = scene.domain.spacing
    # The last axis has room above: its upper face may move out.
    reach.high[-1] -= 3 * h
    found = list(siblings_of(tables, reach, ("grid",)))
    assert all(isinstance(one, Sibling) for one in found) and 1.24 < found[0].ratio < 1.59
    assert 1.75 < found[1].ratio < 2.25
    for one in found:
        changed = parse_scene(one.tables, laws=parameter_models(), directory=examples()[name].parent).scene
        new_low, new_high = np.array(changed.domain.origin), np.array(changed.domain.origin) + changed.domain.size
        new = changed.domain.spacing
        assert changed.domain.spacing == pytest.approx(one.ratio * h)
        assert np.abs(new_low - low).max() < 0.26 * new and np.abs(new_high - high)[:-1].max() < 0.26 * new
        assert new_high[-1] > high[-1] - 0.26 * new
        assert {key: value for key, value in one.tables.items() if key != "domain"} == {
            key: value for key, value in tables.items() if key != "domain"
        }
        assert one.tables["domain"]["gravity"] == tables["domain"]["gravity"]


def test_free_domains_keep_the_middle_of_the_material_within_a_cell() -> None:
    scene = scene_of(name="elliptical_drop_2d")
    tables, h = tables_of(scene), scene.domain.spacing
    middle = np.array([0.1234, -0.4321]) + scene.domain.origin + np.array(scene.domain.size) / 2
    reach = Reach(middle - 1.0, middle + 1.0, middle)
    before = (middle - scene.domain.origin) / h % 1
    for one in siblings_of(tables, reach, ("grid",)):
        domain = one.tables["domain"]
        assert (middle - domain["origin"]) / domain["spacing"] % 1 == pytest.approx(before)
        assert [one.ratio] == pytest.approx([1.4]) or one.ratio == pytest.approx(2.0)


def test_siblings_that_do_not_exist_say_why() -> None:
    narrow = scene_of("domain.size=[0.1, 3.0]", "bodies.column.shape.box.max=[0.1, 2.0]")
    found = list(siblings_of(tables_of(narrow), Reach(np.zeros(2), np.array([0.1, 2.0]), np.zeros(2)), CAUSES))
    left = {one.cause: one.reason for one in found if isinstance(one, LeftOut)}
    assert "fits between its walls" in left["grid"] and "walls of every axis" in left["placement"]
    still = scene_of("domain.gravity=[0, 0]")
    left = [one for one in siblings_of(tables_of(still), WHOLE, ("rounding",)) if isinstance(one, LeftOut)]
    assert [one.reason for one in left] == ["there is no gravity"]


def test_the_other_siblings_change_one_thing() -> None:
    scene = scene_of()
    tables = tables_of(scene)
    reach = Reach(np.array([1.0, 0.5]), np.array([5.0, 2.5]), np.array([3.0, 1.5]))
    found = {one.name: one.tables for one in siblings_of(tables, reach, CAUSES) if isinstance(one, Sibling)}
    assert found["gravity x (1 + 1e-6)"]["domain"]["gravity"][1] == pytest.approx(-9.81 * NUDGE, rel=1e-12)
    assert found["half step"]["time"]["safety"] == tables["time"]["safety"] / 2
    moved = found["grid moved by 0.37 of a cell"]["domain"]
    assert moved["origin"] == pytest.approx([-0.37 * 0.02] * 2) and moved["size"] == pytest.approx([6.02, 3.02])
    assert found["more particles"]["bodies"][0]["particles_per_cell"] == 9
    assert found["other sample"]["bodies"][0]["sampling"] == "turned"
    choices = {"column": ("bulk_modulus", "sampling")}
    models = {one.name: one.tables for one in siblings_of(tables, reach, ("model",), choices)}
    coarsest = list(siblings_of(tables, reach, ("grid",)))[-1].tables
    assert models["turned sample"]["bodies"][0]["sampling"] == "turned"
    for name, changed in models.items():
        assert changed["domain"] == coarsest["domain"]
        factor = {"automatic moduli x 0.5": 0.5, "turned sample": 1.0}[name]
        modulus = changed["bodies"][0]["material"]["bulk_modulus"]
        assert modulus == factor * tables["bodies"][0]["material"]["bulk_modulus"]
    for changed in (*found.values(), *models.values()):
        parse_scene(changed, laws=parameter_models())


def test_observables_are_those_of_the_frame() -> None:
    """A box of 1 m that falls: centre, extents, velocity, potential about the origin, and a share by an expression."""
    scene = scene_of("domain.spacing=0.1", "domain.origin=[-1, -1]", "bodies.column.velocity=[0.5, -2]")
    particles = sample_bodies(scene)
    position, mass = particles[0].position, particles[0].mass
    n = len(position)
    velocity = np.tile([0.5, -2.0], (n, 1))
    momentum = n * mass * np.array([0.5, -2.0])
    arm = (position - scene.domain.origin).mean(axis=0)
    spin = arm[0] * momentum[1] - arm[1] * momentum[0]
    row = LedgerRow(0.0, 0, 0.0, 0.0, "", 2.1, 0.0, 1.0, 1.0, n * mass, 4.0, 1.0, 7.0, tuple(momentum), (float(spin),))
    observed = read_observed(["right=1 if x > 0.25 else 0"], scene)
    observer = Observer(scene, particles, Map.of(scene), observed)
    observer.take(Frame(0, 0.0, 0, position, velocity, np.zeros(n, int), np.zeros(n, int)), row)
    value = {name: one[0] for name, one in observer.series().values.items()}
    assert value["column.low.x"] == pytest.approx(0.01) and value["column.high.y"] == pytest.approx(1.98)
    assert value["column.centre.y"] == pytest.approx(1.0) and value["column.velocity.y"] == -2.0
    assert value["energy.potential"] == pytest.approx(2000 * 9.81 * 1.0)
    # About the origin of coordinates, wherever the domain begins.
    assert value["spin.z"] == pytest.approx(2000 * (0.5 * -2.0 - 1.0 * 0.5))
    assert value["right"] == pytest.approx(0.75)
    assert observer.series().maps.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("right", "give NAME=EXPRESSION"),
        ("right=x >", "cannot be read"),
        ("right=q", "names"),
        ("right=2", "the same for all particles"),
    ],
)
def test_bad_observables_have_a_sentence(text: str, said: str) -> None:
    with pytest.raises(InputError, match=r"--observe right") as raised:
        read_observed([text], scene_of())
    assert said in str(raised.value)
    with pytest.raises(InputError, match=r"^a.toml: error_bars.observe: right"):
        read_observed([text], scene_of(), "a.toml: error_bars.observe:")


SCENE = """
title = "Drop"
domain = { size = [1.2, 0.8], spacing = 0.05, gravity = [0, -9.81] }
time = { end = 0.2, frames = 10 }
[[bodies]]
name = "water"
material = { law = "fluid", density = 1000, bulk_modulus = 2e4 }
shape = { box = { min = [0, 0], max = [0.4, 0.4] } }
"""


@pytest.fixture(scope="module")
def bars(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """The result and the JSON of `mpmcli simulate --error-bars` of a column of water."""
    folder = tmp_path_factory.mktemp("bars")
    (folder / "drop.toml").write_text(SCENE)
    outcome = run_here("simulate", folder / "drop.toml", "-o", folder / "drop", "--error-bars", "--json")
    assert outcome.status == 0, outcome.stderr
    return folder / "drop", json.loads(outcome.stdout)


def test_a_run_says_how_wrong_it_is(bars: tuple[Path, dict]) -> None:
    """End to end: the front has an error bar that two coarser grids explain, in JSON, on the page and in info."""
    directory, printed = bars
    found = printed["error_bars"]
    assert found["headline"].startswith("front of water at 0.2 s: ") and " m ± " in found["headline"]
    assert [run["cause"] for run in found["runs"]] == ["", "grid", "grid", "model"] and found["left_out"] == []
    front = found["observables"]["water.high.x"]
    assert len(front["bar"]) == 11 and 0 < front["bar"][-1] < 0.2 and "grid" in front["causes"]
    assert found["headline"] in (directory / "error_bars" / "report.md").read_text()
    shown = run_here("info", directory, "--json")
    assert json.loads(shown.stdout)["headline"] == found["headline"]
    # Where the files are that the scene names, if it does; `validate RESULT` finds them there.
    assert open_result(directory).record["scene"] == str(directory.with_name("drop.toml"))


def test_runs_that_are_kept_are_not_computed_again(bars: tuple[Path, dict], monkeypatch: pytest.MonkeyPatch) -> None:
    """After a kill one sibling may be missing; it alone is computed, and the bars are the same numbers."""
    directory, printed = bars
    kept = sorted((directory / "error_bars").glob("*.npz"), key=lambda path: path.stat().st_mtime)
    kept[-1].unlink()
    (directory / "error_bars" / "error_bars.json").unlink()
    computed = []
    compute = Student.compute

    def noted(student: Student, name: str, tables: dict, stop: object) -> Series:
        there = len(list(student.plan.directory.glob("*.npz")))
        series = compute(student, name, tables, stop)
        computed.extend([name] * (len(list(student.plan.directory.glob("*.npz"))) - there))
        return series

    monkeypatch.setattr(Student, "compute", noted)
    outcome = run_here("validate", directory, "--json", "--target", "front:2%")
    assert outcome.status == 0, outcome.stderr
    assert computed == ["turned sample"]
    again, before = json.loads(outcome.stdout), printed["error_bars"]
    assert again["observables"] == before["observables"]


def test_the_result_is_plotted_with_bands_and_overwritten_with_its_bars(
    bars: tuple[Path, dict], tmp_path: Path
) -> None:
    from mpmcli.plot.ledger_figure import read_history

    directory, _ = bars
    history = read_history(open_result(directory))
    assert history.bars["energy.kinetic"].shape == history.times.shape
    copy = tmp_path / "drop"
    shutil.copytree(directory, copy)
    stale = read_history(open_result(copy))
    assert len(stale.bars)
    scene = directory.with_name("drop.toml")
    outcome = run_here("simulate", scene, "-o", copy, "--overwrite", "--set", "time.frames=5", "-q")
    assert outcome.status == 0 and not (copy / "error_bars").exists()


def test_a_target_gives_the_spacing_of_first_order() -> None:
    """A bar of 4 % at h = 0.05 asks for 0.025 to stay within 2 %, at 2^3 times the seconds."""
    water = block("water", "water", [0, 0], [0.4, 0.4])
    scene = scenes.scene_of(water, size=[1.0, 0.5], spacing=0.05, frames=40, contact={})
    base = series_of(water__high__x=0.5)
    base.seconds = 10.0
    study = Study(scene, base, [(grid(2.0), series_of(water__high__x=0.5 + 0.04 / MARGIN))])
    assert report.target_text(study, *report.target_of("front:2%")).splitlines() == [
        "water.high.x within 0.02 m needs a spacing of 0.025 m, 2 times finer, and about 80 s:",
        "spacing = 0.025",
    ]
    assert "out of reach" in report.target_text(study, "front", 0.001)
    for text, said in (("frnt:2%", "there is no observable"), ("front:-1%", "percent of its size")):
        with pytest.raises(InputError, match=said):
            report.target_text(study, *report.target_of(text))


def test_what_bars_do_not_contain_is_said() -> None:
    def told(*overrides: str, name: str) -> str:
        return " ".join(Study(scene_of(*overrides, name=name), series_of(), [(grid(2.0), series_of())]).warnings())

    assert "Bodies stick" in told('contact={default="stick"}', name="billiard_2d")
    assert "Bodies stick" not in told('contact={default="separate"}', name="billiard_2d")
    assert told(name="dam_break_2d") == "" == told(name="dam_break_obstacle_3d")
    assert told(name="mixer_2d") == ""
    assert "paddle: thinner than a cell" in told("domain.spacing=0.125", name="mixer_2d")
    assert "column: fewer than 4 cells thick" in told("domain.spacing=0.15", name="dam_break_2d")


def test_a_scene_without_siblings_is_told_so(tmp_path: Path) -> None:
    """A shaft of five cells has no coarser grid: the run itself is stored, and the exit code is 1."""
    scene = tmp_path / "shaft.toml"
    scene.write_text(SCENE.replace("size = [1.2, 0.8]", "size = [0.25, 0.8]").replace("max = [0.4", "max = [0.25"))
    outcome = run_here("simulate", scene, "-o", tmp_path / "r", "--error-bars", "-q")
    assert outcome.status == 1 and "no sibling was computed" in outcome.stderr
    assert (tmp_path / "r" / "particles.vtkhdf").exists()


@pytest.mark.parametrize(("words", "said"), [
    (("--level", "step", "--budget", "1h"), "without --level, --only and --skip"),
    (("--only", "grids"), 'there is no cause "grids"'),
    (("--skip", "grid"), "leave nothing to compute, as model needs grid"),
    (("--only", "step", "--skip", "step"), "leave nothing to compute:"),
    (("--budget", "0.001s"), "allows nothing"),
    (("--levels", "fine"), "--levels"),
])  # fmt: skip
def test_options_that_cannot_be_used_have_a_sentence(tmp_path: Path, words: tuple[str, ...], said: str) -> None:
    (tmp_path / "drop.toml").write_text(SCENE)
    outcome = run_here("validate", tmp_path / "drop.toml", *words)
    assert outcome.status == 2 and said in outcome.stderr, outcome.stderr
    outcome = run_here("validate", "couette", "--target", "front:2%")
    assert outcome.status == 2 and "is for a scene" in outcome.stderr


def test_levels_name_their_causes() -> None:
    assert chosen_causes("grids") == ("grid", "model") and chosen_causes("all") == CAUSES
    assert chosen_causes("grids", only=("step", "grid"), skip=("grid",)) == ("step",)
    grids = StudyPlan(("grid",))
    assert grids.cost(2) == pytest.approx(0.48, abs=0.01) and grids.cost(3) == pytest.approx(0.31, abs=0.01)
    assert StudyPlan().cost(2) < 0.7
