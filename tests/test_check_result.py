"""A result is called stable when nothing is wrong with it, and whatever was broken on purpose is found and placed."""

import json
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from command import run_here
from hypothesis import given, settings
from hypothesis import strategies as st
from result_copies import FORMS, SCENE, StoredRun, real_run, stored_run

from mpmcli.check.finding import Finding
from mpmcli.check.result_check import ResultCheck, check_kept, check_result
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.header import RunHeader

K = 6  # the frame that is broken


@pytest.fixture(scope="module")
def run() -> StoredRun:
    return real_run()


@pytest.fixture
def checked(run: StoredRun, tmp_path: Path) -> Callable[..., ResultCheck]:
    """Return `checked(frames, rows, form)`: the check of a copy with these, whose findings are as in memory."""

    def check(frames: Sequence[Frame] = run.frames, rows: Sequence[LedgerRow] = run.rows, form: str = "packed"):
        check = check_result(run.write(tmp_path / "copy", form, frames, rows))
        assert check.findings == check_kept(RunHeader.read(run.header), frames, rows).findings
        return check

    return check


def the(check: ResultCheck, rule: str) -> Finding:
    """Return the gravest finding of a rule."""
    found = [finding for finding in check.findings if finding.rule == rule]
    assert found, [finding.line for finding in check.findings]
    return found[0]


def rules(check: ResultCheck) -> set[str]:
    return {finding.rule for finding in check.findings}


@pytest.mark.parametrize("form", FORMS)
def test_an_unbroken_result_is_stable_in_every_form(run, checked, form):
    check = checked(form=form)
    assert check.findings == () and check.verdict == "stable" and check.passes(strict=True)
    assert (check.kind, check.status) == (form, "finished")
    assert (check.frames, check.frames_expected, check.first_bad_frame) == (11, 11, None)
    figures = check.figures
    assert figures["mass_change"] == 0
    assert figures["courant_max"] == max(row.courant_max for row in run.rows)
    total = [row.energy for row in run.rows]
    assert figures["energy_growth"] < 1e-3 and figures["energy_lost"] * total[0] > 0
    # Nothing but gravity acts before the drop meets the floor; rounding is relative 6e-8 a step.
    assert figures["momentum_frames"] >= 3 and figures["momentum_drift"] < 1e-5
    for path in (run.directory, run.directory / "particles.vtkhdf"):
        assert check_result(path).verdict == "stable"


@pytest.mark.slow
def test_double_precision_is_held_to_its_own_rounding(tmp_path):
    """Without shifts, which change the momentum of the drop by 4e-6 of what moves (docs/theory.md, 5.12)."""
    check = check_result(stored_run(tmp_path, 'solver.precision="f64"', "solver.redistribute=false").directory)
    assert check.findings == ()
    assert check.figures["momentum_drift"] < 1e-12


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ["position", "velocity", "density", "affine"])
def test_a_nan_is_found_and_named(run, checked, name, form):
    check = checked(run.with_value(K, name, 17, np.nan), form=form)
    finding = the(check, "not-finite")
    assert check.verdict == "unstable" and check.first_bad_frame == K
    assert finding.frame == K and finding.body == "drop" and finding.value == 1
    assert f"In frame {K} {name} is not finite" in finding.what and 'number 17 of body "drop"' in finding.what
    assert check.limit == run.rows[K].limit
    # Where a particle is lost nothing else is made of it.
    assert rules(check) == {"not-finite"}


@settings(max_examples=10)
@given(data=st.data())
def test_a_nan_is_found_wherever_it_is(run, data):
    k, p = data.draw(st.integers(1, 10)), data.draw(st.integers(0, run.particles - 1))
    name = data.draw(st.sampled_from(["position", "velocity", *run.frames[0].fields]))
    value = data.draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    with TemporaryDirectory() as directory:
        check = check_result(run.patched(Path(directory) / "lost", k, name, p, value))
    assert the(check, "not-finite").frame == check.first_bad_frame == k


# The last one is on a wall, and rounded.
@pytest.mark.parametrize("place", [[1.6, 0.5], [0.0, -0.01], [-0.6, 1.2], [np.nextafter(np.float32(1.5), 2), 0.5]])
def test_an_escaped_particle_is_found(run, checked, place):
    check = checked(run.with_value(K, "position", 9, place))
    beyond = max(np.max(np.array([-0.5, 0.0]) - place), np.max(np.array(place) - [1.5, 1.0]))
    if beyond < 1e-6:
        assert "escaped" not in rules(check)
        return
    finding = the(check, "escaped")
    assert finding.frame == K and "number 9" in finding.what
    assert finding.value == pytest.approx(beyond, rel=1e-5)


@pytest.mark.parametrize("k", [0, K])
@pytest.mark.parametrize("form", FORMS)
def test_a_mass_that_changes_in_the_ledger_is_found(run, checked, k, form):
    check = checked(rows=run.with_row(k, mass=run.rows[k].mass * (1 + 1e-5)), form=form)
    assert the(check, "mass").frame == check.first_bad_frame == k
    assert check.figures["mass_change"] == pytest.approx(1e-5, rel=1e-6)


@pytest.mark.parametrize(("share", "severity"), [(5e-3, None), (0.05, "warning"), (0.5, "error")])
def test_energy_from_nowhere_is_found(run, checked, share, severity):
    """What was turned over is the largest kinetic energy and the ranges of the others."""
    kinetic, potential, elastic = (
        np.array([getattr(row, name) for row in run.rows[: K + 1]]) for name in ("kinetic", "potential", "elastic")
    )
    lowest = min(row.energy for row in run.rows[:K])
    turned = kinetic.max() + np.ptp(potential) + np.ptp(elastic)
    added = share * turned + lowest - run.rows[K].energy
    check = checked(rows=run.with_row(K, elastic=elastic[-1] + added))
    if severity is None:
        assert check.verdict == "stable"
        return
    finding = the(check, "energy")
    assert (finding.severity, finding.frame, check.first_bad_frame) == (severity, K, K)
    # The range of the elastic energy grows, too; and rounding has its ten-thousandth.
    grown = turned - np.ptp(elastic) + np.ptp([*elastic[:-1], elastic[-1] + added])
    assert finding.value == pytest.approx(share * turned / grown, rel=1e-3)


@pytest.mark.parametrize(("share", "lasts", "fires"), [(0.02, False, False), (0.05, False, True), (0.02, True, True)])
def test_energy_that_is_gone_at_once_may_grow_by_more(run, checked, share, lasts, fires):
    """The error of a step oscillates in a compression; of energy that stays a hundredth is found."""
    energies, before = np.array([row.energy for row in run.rows]), run.rows[: K + 1]
    turned = max(row.kinetic for row in before)
    turned += sum(np.ptp([getattr(row, name) for row in before]) for name in ("potential", "elastic"))
    rows = [
        replace(row, elastic=row.elastic + energies[:K].min() + share * turned - row.energy)
        if k == K or (lasts and k > K)
        else row
        for k, row in enumerate(run.rows)
    ]
    check = checked(rows=rows)
    assert check.figures["energy_growth"] == pytest.approx(share, rel=0.15)
    assert (rules(check), check.first_bad_frame) == (({"energy"}, K) if fires else (set(), None))


def test_a_start_under_stress_is_named_as_a_cause(run):
    """Of energy that grows; a finding of another rule keeps its advice."""
    grown = run.with_row(K, elastic=1e6, courant_max=1.2)
    scene = run.header["scene"].replace("[[bodies]]", '[[bodies]]\ndeformation = "0.97"', 1)
    assert scene != run.header["scene"]
    plain, stressed = (
        check_kept(RunHeader.read(run.header | {"scene": text}), run.frames, grown)
        for text in (run.header["scene"], scene)
    )
    assert the(plain, "energy").fix.startswith("Halve time.safety; ")
    assert 'start with a "deformation"' in the(stressed, "energy").fix
    assert the(stressed, "courant") == the(plain, "courant")


@pytest.mark.parametrize(
    ("name", "value", "rule", "severity"),
    [
        ("courant_max", 1.05, "courant", None),
        ("courant_max", 1.15, "courant", "warning"),
        ("courant_max", 1.9, "courant", "warning"),
        ("courant_max", 2.2, "courant", "error"),
        ("volume_ratio_min", 0.11, "volume", None),
        ("volume_ratio_min", 0.05, "volume", "warning"),
        ("volume_ratio_min", -0.1, "volume", "error"),
        ("volume_ratio_max", 9.0, "volume", None),
        ("volume_ratio_max", 20.0, "volume", "warning"),
        ("kinetic", float("nan"), "ledger-not-finite", "error"),
    ],
)
def test_a_number_of_the_ledger_out_of_bounds_is_found(run, checked, name, value, rule, severity):
    check = checked(rows=run.with_row(K, **{name: value}))
    assert [(f.rule, f.severity, f.frame) for f in check.findings] == ([(rule, severity, K)] if severity else [])
    if rule == "ledger-not-finite":
        assert name in check.findings[0].what
    else:
        assert check.figures[name] == value and all(finding.value == value for finding in check.findings)


def test_surfaces_that_overlap_by_more_than_a_cell_are_found(run, checked):
    """Where bodies separate the ledger has how deep."""
    assert checked().figures["contact_overlap"] is None
    for deepest, found in ((0.9, []), (1.1, [("overlap", "warning", K)])):
        rows = [replace(row, contact_overlap=deepest * (k == K)) for k, row in enumerate(run.rows)]
        check = checked(rows=rows)
        assert [(f.rule, f.severity, f.frame) for f in check.findings] == found
        assert check.figures["contact_overlap"] == deepest


def test_a_collapsed_step_is_found(run, checked):
    check = checked(rows=run.with_row(K, step_min=1e-3 * run.rows[1].step_max, limit="deformation"))
    finding = the(check, "step-collapse")
    assert (finding.severity, finding.frame, check.limit) == ("warning", K, "deformation")
    assert finding.value == check.figures["step_ratio"] == pytest.approx(1e-3)


@pytest.mark.parametrize("also", [False, True], ids=["frame alone", "ledger also"])
@pytest.mark.parametrize(
    ("J", "severity", "word"),
    [(-0.2, "error", "has no volume left"), (0.05, "warning", "is crushed"), (20.0, "warning", "is blown up")],
)
def test_a_particle_of_a_wrong_volume_is_named_once(run, checked, J, severity, word, also):
    p = run.particles - 1
    row = {"volume_ratio_max" if J > 1 else "volume_ratio_min": J} if also else {}
    finding = the(checked(run.with_value(K, "volume_ratio", p, J), rows=run.with_row(K, **row)), "volume")
    assert (finding.severity, finding.frame, finding.body) == (severity, K, "ball")
    assert f'particle {p} of body "ball" {word}' in finding.what


def test_momentum_that_drifts_without_a_wall_is_found(run, checked):
    """Before anything is near the floor the momentum is P0 + M g t."""
    k = 2
    push = 1e-2 * np.sqrt(2 * run.rows[k].mass * run.rows[k].kinetic)
    momentum = (run.rows[k].linear_momentum[0] + push, run.rows[k].linear_momentum[1])
    check = checked(rows=run.with_row(k, linear_momentum=momentum))
    assert the(check, "momentum").frame == k
    assert check.figures["momentum_drift"] == pytest.approx(1e-2, rel=1e-2)


def test_it_is_told_to_programs_and_to_people(run, checked):
    check = checked(run.with_value(K, "velocity", 3, np.nan))
    told = json.loads(json.dumps(check.as_dict(), allow_nan=False))
    assert (told["ok"], told["verdict"], told["first_bad_frame"]) == (False, "unstable", K)
    assert (told["frames"], told["frames_expected"], told["limit"]) == (11, 11, run.rows[K].limit)
    assert told["findings"][0]["rule"] == "not-finite" and told["figures"]["mass_change"] == 0
    first, *_, last = check.text().splitlines()
    assert first.endswith(f': unstable, first bad frame {K}, nearest limit "{run.rows[K].limit}"')
    assert last == f"error: {check.findings[0].what} {check.findings[0].fix}"
    for finding in check.findings:
        for sentence in (finding.what, finding.fix):
            assert sentence[0].isupper() and sentence.endswith(".")


def test_a_run_that_breaks_is_unstable_and_its_diagnosis_is_repeated(tmp_path):
    """Thirty times the speed of sound crushes the ball on the wall: the run stops by itself."""
    scene = tmp_path / "crash.toml"
    scene.write_text(SCENE.replace("[0.3, 0.0]", "[300.0, 0.0]").replace("end = 0.2", "end = 0.02"), encoding="utf-8")
    outcome = run_here("simulate", scene, "-o", tmp_path / "result", "--threads", 1, "--quiet")
    assert outcome.status == 1
    check = check_result(tmp_path / "result")
    record = json.loads((tmp_path / "result" / "run.json").read_text(encoding="utf-8"))
    assert (check.verdict, check.status) == ("unstable", "unstable")
    assert record["failure"]["message"] in the(check, "unstable-run").what + "."
    assert the(check, "unstable-run").frame == check.frames == record["frames_written"]


def test_memory_is_that_of_a_few_frames(run, tmp_path):
    n, count = 20_000, 40
    tile = np.arange(n) % run.particles
    first = run.frames[0]
    base = {name: getattr(first, name)[tile] for name in ("position", "velocity", "body", "material")}
    frames = [Frame(index=k, time=0.02 * k, step=k, **base, fields={}) for k in range(count)]
    rows = [replace(run.rows[1], time=0.02 * k, steps=min(k, 1)) for k in range(count)]
    path = run.write(tmp_path / "long", frames=frames, rows=rows)
    size = sum(array.nbytes for array in base.values())
    check_result(path)
    tracemalloc.start()
    check_result(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12 * size < count * size / 3


@pytest.mark.parametrize(("error", "named"), [(0.08, True), (-0.08, True), (0.04, False)])
def test_a_lasting_volume_error_is_named(run, checked, error, named):
    """Above 5 % in every frame of the last quarter, with one sign."""
    check = checked(rows=[replace(row, volume_error=error) for row in run.rows])
    assert rules(check) == ({"volume-error"} if named else set())
    assert check.verdict == "stable"
    assert check.figures["volume_error"] == error
    splashed = [replace(row, volume_error=error if k < len(run.rows) // 2 else 0.0) for k, row in enumerate(run.rows)]
    assert rules(checked(rows=splashed)) == set()
