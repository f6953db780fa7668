"""Every validation case at its coarse level, with the default setting: bounds, orders, and the committed figures."""

import json
import tomllib
from collections.abc import Callable
from copy import deepcopy
from functools import cache

import pytest
from conftest import ROOT

from mpmcli.check.finding import passes
from mpmcli.check.scene_check import check_scene
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import parse_scene, scene_to_toml
from mpmcli.validation.case import KNOBS, Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runs import CaseRun, RunResult, carry_out, scene_of
from mpmcli.validation.verdict import ROUND_OFF, judge

CASES = all_cases()
COARSE = {name: sorted(case.levels["coarse"]) for name, case in CASES.items()}
# Of a kind one case is run always, and the others with -m slow.
SLOW = {
    "bar_fixed_free", "cantilever", "cantilever_small", "column_corotated", "column_hencky", "column_neo_hookean",
    "conservation", "conservation_3d", "homogeneous", "mms_2d_corotated", "mms_3d", "sand_column_1",
    "sand_column_2", "sand_column_5", "sloshing", "spinning_disc", "dam_at_rest", "stirred_pool", "still_bowl",
    "still_slope",
    "cook", "fluid_blocks", "metal_blocks", "metal_blocks_3d", "paste_blocks", "sand_blocks_3d", "snow_blocks",
    "dam_break_obstacle", "bingham", "cantilever_total", "column_dynamic", "dam_break", "floating_box", "galilean",
    "prandtl", "snow_oedometer", "toss", "two_disks", "two_disks_total", "u_tube", "vortex",
}  # fmt: skip
# The orders of these are taken always, those of the others with -m slow: a wave, one of large strain, a fluid at rest.
REFINED = {"bar_fixed_fixed", "mms_2d_neo_hookean", "hydrostatic"}


def marked(name: str, *resolutions: int) -> object:
    """Return a case and the resolutions that a test of it takes, as parameters."""
    slow = name in SLOW or (name not in REFINED and max(resolutions, default=0) > COARSE[name][0])
    return pytest.param(
        name, *resolutions, id="-".join(map(str, (name, *resolutions))), marks=[pytest.mark.slow] * slow
    )


RUNS = [marked(name, n) for name, resolutions in COARSE.items() for n in resolutions]
PAIRS = [
    marked(name, *COARSE[name][-2:])
    for name, case in CASES.items()
    if len(COARSE[name]) > 1 and any(measure.order is not None for measure in case.measures)
]
# Written by scripts/validation_report, perhaps on a machine whose sines and roots differ in the last digit. Steps
# longer by 1e-13 change none of the five digits that are kept, not even of the dam break and the sand.
ERRORS = json.loads((ROOT / "tests" / "validation_errors.json").read_text(encoding="utf-8"))
TOLERANCE = 1e-3


@pytest.fixture(scope="module")
def run_of(backend_of: Callable) -> Callable[[str, int], RunResult]:
    """Return `run(case, n)`: what came of it; each is computed once."""

    @cache
    def run(name: str, n: int) -> RunResult:
        return carry_out(CASES[name], n, Setting(), backend_of("f64"))

    return run


@pytest.mark.parametrize(("name", "n"), RUNS)
def test_a_case_is_within_its_bounds(run_of: Callable, record_property: Callable, name: str, n: int) -> None:
    result = run_of(name, n)
    for measure, value in result.values.items():
        record_property(measure, value)
    assert judge(CASES[name], {CaseRun(name, n, Setting()): result}).reasons == ()


@pytest.mark.parametrize(("name", "n", "finer"), PAIRS)
def test_a_case_converges_as_it_should(
    run_of: Callable, record_property: Callable, name: str, n: int, finer: int
) -> None:
    found = {CaseRun(name, k, Setting()): run_of(name, k) for k in (n, finer)}
    orders = [check for check in judge(CASES[name], found).checks if check.subject.startswith("order")]
    assert orders
    for check in orders:
        record_property(check.subject, check.figure)
        assert check.passed, check.sentence


@pytest.mark.parametrize(("name", "n"), RUNS)
def test_no_error_has_become_larger(run_of: Callable, name: str, n: int) -> None:
    """Bounds leave room for a third; a change of the solver that takes it is to be seen, and to have a reason."""
    values = run_of(name, n).values
    before = ERRORS.get(name, {}).get(str(n))
    assert before is not None, f"no errors of {name} at {n} are kept: run scripts/validation_report --coarse {name}"
    assert set(before) == set(values)
    for measure, value in values.items():
        assert abs(value) <= abs(before[measure]) * (1 + TOLERANCE) + ROUND_OFF, measure


@pytest.mark.parametrize("name", CASES)
def test_the_scene_of_a_case_is_a_public_one(name: str) -> None:
    """Written as TOML, as --write-scene does, it is the same scene again, and one that `simulate` accepts."""
    case = CASES[name]
    n = COARSE[name][0]
    loaded = parse_scene(case.scene_tables(n, Setting()), laws=parameter_models())
    again = parse_scene(tomllib.loads(scene_to_toml(loaded.scene)), laws=parameter_models())
    assert again.scene == loaded.scene
    findings = check_scene(loaded).findings
    assert passes(findings), [finding.what for finding in findings if finding.severity == "error"]


def emptied(tables: object) -> None:
    """Clear tables and lists, from the innermost on."""
    for part in tables.values() if isinstance(tables, dict) else tables:
        if isinstance(part, dict | list):
            emptied(part)
    tables.clear()


@pytest.mark.parametrize("name", CASES)
def test_what_a_caller_does_to_tables_does_not_reach_the_case(name: str) -> None:
    """Tables that two cases share would carry a change from the one to the other."""
    case = CASES[name]
    tables = case.tables(COARSE[name][0])
    as_it_was = deepcopy(tables)
    emptied(tables)
    assert case.tables(COARSE[name][0]) == as_it_was


@pytest.mark.parametrize("name", CASES)
def test_every_setting_makes_a_scene(name: str) -> None:
    """Every knob of the case is a key that scenes know, and all resolutions have a bound for each measure."""
    case = CASES[name]
    assert set(case.varies) <= set(KNOBS) and set(case.levels) == {"coarse", "default", "fine"}
    for level in case.levels.values():
        for n in level:
            assert all(measure.bound(n) >= 0 for measure in case.measures)
    for knob in set(case.varies):
        for value in KNOBS[knob]:
            scene = scene_of(case, COARSE[name][0], Setting(**{knob: value}))
            assert scene.solver.precision == (value if knob == "precision" else "f64")
            if knob == "safety":
                assert scene.time.safety == value
