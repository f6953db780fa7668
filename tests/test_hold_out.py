"""Splits by rule: what they hold out, that no path to a dataset changes it, and what card, metadata and audit say."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import made_sweep
import pytest
from command import ROOT, run_here
from good_sweep import BASE, SWEEP, refusal, sweep_of
from made_sweep import made_workers, make_dataset  # noqa: F401

import mpmcli.dataset
from mpmcli.dataset.audit import audit
from mpmcli.dataset.export import ExportSettings, export
from mpmcli.dataset.folder import Manifest
from mpmcli.dataset.merge import merge
from mpmcli.dataset.sweep import Sweep

pytestmark = pytest.mark.usefixtures("made_workers")

ANGLE, GRAVITY = "bodies.sand.material.friction_angle", "domain.gravity.1"
# The made-up trajectory `number` has 20 + number particles, all real ones more than 100.
RULES = f"""
[[split.test]]
"{ANGLE}" = [35, 50]
"{GRAVITY}" = [-4.0, 0.0]
[[split.test]]
particles = [45, 100_000]
"place.sand.count" = [2, 3]
"""
COUNT = 40


def holding(rules: str, fractions: str = "train = 0.75\nvalid = 0.25\n") -> str:
    """Return a sweep with fractions and rules."""
    return SWEEP[: SWEEP.index("train")] + fractions + rules


@pytest.fixture
def held(monkeypatch) -> None:
    """Let the made sweep hold out."""
    monkeypatch.setattr(made_sweep, "small_sweep", lambda count: sweep_of(holding(RULES), BASE, count))


def is_held(draws: dict[str, Any], particles: int) -> bool:
    both = 35 <= draws[ANGLE] <= 50 and draws[GRAVITY] == -3.7
    return both or (particles >= 45 and len(draws["place.sand"]) >= 2)


@pytest.mark.usefixtures("held")
def test_each_trajectory_follows_the_rules_however_the_dataset_is_made():
    whole = make_dataset("whole", count=COUNT)
    rows = Manifest(whole).rows()
    right = {row.number: is_held(json.loads(row.draws), row.particles) for row in rows}
    assert {row.number: row.split == "test" for row in rows} == right and 3 < sum(right.values()) < 30
    opened = mpmcli.dataset.open(whole)
    assert all(right[one.number] == (one.split == "test") for one in opened)
    # The others have the splits of a sweep without rules.
    plain = sweep_of(holding("", "train = 0.75\nvalid = 0.25\n"), BASE, COUNT)
    assert all(row.split == plain.split_of(row.number) for row in rows if not right[row.number])
    make_dataset("resumed", broken_after=2, count=COUNT)
    merge([make_dataset(f"part{i}", (i, 2), count=COUNT) for i in (1, 2)], Path("merged"))
    for other in ("resumed", "merged"):
        assert (Path(other) / "README.md").read_bytes() == (whole / "README.md").read_bytes()
        assert {row.number: row.split for row in Manifest(Path(other)).rows()} == {r.number: r.split for r in rows}


@pytest.mark.usefixtures("held")
def test_card_and_manifest_state_the_rules():
    dataset = make_dataset("whole", count=COUNT)
    facts, card = Manifest(dataset).facts(), (dataset / "README.md").read_text(encoding="utf-8")
    assert facts["hold_out"]["test"][0] == {ANGLE: [35, 50], GRAVITY: [-4.0, 0.0]}
    rows = [row for row in Manifest(dataset).rows() if row.accepted]
    draws = [json.loads(row.draws) for row in rows]
    both = sum(drawn[ANGLE] >= 35 and drawn[GRAVITY] == -3.7 for drawn in draws)
    told = f"* test: `{ANGLE}` from 35 to 50 and `{GRAVITY}` from -4 to 0: {both} trajectories included\n"
    assert told in card and "* test: `particles` from 45 to 100000 and `place.sand.count` from 2 to 3: " in card
    line = next(line for line in card.splitlines() if line.startswith(f"| `{GRAVITY}`"))
    low = sum(d[GRAVITY] == -9.81 for d, row in zip(draws, rows, strict=True) if row.split == "test")
    assert f"| -9.81: {low}, -3.7: {sum(row.split == 'test' for row in rows) - low} |" in line


def narrowed(facts: dict[str, Any]) -> None:
    facts["hold_out"]["test"][0][ANGLE][0] = 39.9


def widened(facts: dict[str, Any]) -> None:
    facts["hold_out"]["test"][0][ANGLE][0] = 25


def nearly_trained(facts: dict[str, Any]) -> None:
    """Give a trajectory of train the draws of a held-out one, almost."""
    train, test = (f"{facts['trajectories'][split][0]:06d}" for split in ("train", "test"))
    facts["draws"][train] = {**facts["draws"][test], ANGLE: facts["draws"][test][ANGLE] * (1 + 1e-7)}


@pytest.mark.usefixtures("held")
@pytest.mark.parametrize("form", ["npz", "gns"])
def test_the_audit_holds_each_split_to_the_rules(form):
    export(
        mpmcli.dataset.open(make_dataset("whole", count=COUNT)), ExportSettings(form, Path("export"), present="always")
    )
    path = Path("export/metadata.json")
    sound = path.read_text(encoding="utf-8")

    def sentences(rule: str, change: Callable[[dict[str, Any]], None] = lambda facts: None) -> list[str]:
        facts = json.loads(sound)
        change(facts)
        path.write_text(json.dumps(facts), encoding="utf-8")
        return [one["sentence"] for one in audit(path.parent).rules[rule]["findings"]]

    assert not sentences("splits") and not sentences("leakage")
    assert all(one.endswith("is of test; by the rules of hold_out it is not.") for one in sentences("splits", narrowed))
    assert all(one.endswith("; by the rules of hold_out it is of test.") for one in sentences("splits", widened))
    assert sentences("splits", narrowed) and sentences("splits", widened)
    (told,) = sentences("leakage", nearly_trained)
    assert "of test has the draws of" in told and told.endswith("of train to four digits.")


TEXTS = '[split.test]\n"bodies.stone.material" = {}\n'
VARIED = SWEEP.replace("[vary]", '[vary]\n"bodies.stone.material" = { choice = ["jelly", "rubber", "clay"] }\n'
                       '"bodies.stone.velocity" = { uniform = [[0, 0], [2, 1]] }\n"time.end" = 0.1')  # fmt: skip


def of_varied(rules: str) -> str:
    return VARIED[: VARIED.index("train")] + "train = 1\n" + rules


def splits(sweep: Sweep) -> list[str]:
    return [sweep.split_of(n) for n in range(100)]


def test_choices_and_components_are_held_out():
    sweep = sweep_of(of_varied(TEXTS.format('["rubber", "clay"]')))
    drawn = [sweep.values_of(n)["bodies.stone.material"] for n in range(100)]
    assert splits(sweep) == ["train" if one == "jelly" else "test" for one in drawn]
    sweep = sweep_of(of_varied('[split.valid]\n"bodies.stone.velocity.0" = [1.5, 2.0]\n[[split.test]]\n'
                               '"bodies.stone.velocity.0" = [1.0, 2.0]\n'))  # fmt: skip
    speeds = [sweep.values_of(n)["bodies.stone.velocity"][0] for n in range(100)]
    assert splits(sweep) == ["valid" if v >= 1.5 else "test" if v >= 1 else "train" for v in speeds]
    assert sweep.key != sweep_of(of_varied('[split.valid]\n"bodies.stone.velocity.0" = [1.5, 2.0]\n')).key


def test_the_rules_of_the_page_are_right():
    """In the sweep of the page, with the base scene of README.md."""
    page, readme = ((ROOT / name).read_text(encoding="utf-8") for name in ("docs/datasets.md", "README.md"))
    (scene,) = re.findall(r"^```toml\n(.*?)^```$", readme, re.MULTILINE | re.DOTALL)
    drops, rules, *_ = re.findall(r"^```toml\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    sweep = sweep_of(drops[: drops.index("[split]")].replace("drop.toml", "base.toml") + rules, scene)
    for n in range(100):
        viscosity, gravity, balls = (sweep.values_of(n)[key] for key in ("bodies.pool.material.viscosity", GRAVITY,
                                                                         "place.ball.count"))  # fmt: skip
        assert (sweep.split_of(n) == "test") == (viscosity >= 0.3 or (gravity == -3.7 and balls == 2))


BAD = {
    "[split.test]\n\"bodies.stone.velocity\" = [1.5, 2.0]\n":
        'split.test.bodies.stone.velocity: no key that varies; did you mean "bodies.stone.velocity.0"?',
    '[split.test]\n"time.end" = [0.1, 1.0]\n': "split.test.time.end: no key that varies; those are ",
    '[split.test]\n"place.sand.size.0" = [0.2, 1.0]\n': "split.test.place.sand.size.0: no key that varies; ",
    f'[split.test]\n"{ANGLE}" = [41, 50]\n': f"split.test.{ANGLE}: is from 25 to 40; [41, 50] is outside",
    f'[split.test]\n"{ANGLE}" = [39, 38]\n': f"split.test.{ANGLE}: must be a range, [lower, upper]; found [39, 38]",
    f'[split.test]\n"{ANGLE}" = [39, inf]\n': f"split.test.{ANGLE}: must be a range, [lower, upper]; found [39, inf]",
    f'[split.test]\n"{ANGLE}" = 39\n': f"split.test.{ANGLE}: must be a range, [lower, upper]; found 39",
    f'[split.test]\n"{ANGLE}" = ["high"]\n': f"split.test.{ANGLE}: must be a range, [lower, upper]; found ",
    '[split.test]\nparticles = "many"\n': 'split.test.particles: must be a range, [lower, upper]; found "many"',
    TEXTS.format('["snow"]'): "split.test.bodies.stone.material: must be a list of values that it draws, "
                              '"jelly", "rubber" and "clay"; found ["snow"]',
    TEXTS.format('"clay"'): 'split.test.bodies.stone.material: must be a list of values that it draws, "jelly", ',
    "[split.test]\n": "split.test: must be a fraction, or tables of keys and what of them is held out; found ",
    "test = [0.1]\n": "split.test: must be a fraction, or tables of keys and what of them is held out; found [0.1]",
    "test = 1.5\n": "split.test: must be at most 1; found 1.5",
    f'[[split.test]]\n"{ANGLE}" = [39, 40]\n[[split.test]]\n"{GRAVITY}" = [-5, -4]\n':
        "split.test[1]: holds out none of the 1000 trajectories: raise count, or widen it",
    "[split.test]\nparticles = [0, 20]\n": "split.test: holds out none of the 1000 trajectories: raise count, or widen",
    f'[split.valid]\n"{ANGLE}" = [25, 30]\n[split.test]\n"{ANGLE}" = [30, 40]\n':
        "split: the rules hold out all trajectories, and leave none for the fractions: narrow them",
}  # fmt: skip


@pytest.mark.parametrize("rules", BAD)
def test_a_wrong_rule_is_named(rules):
    (line,) = refusal(of_varied(rules))
    place, _, said = line.partition(": ")
    assert said.startswith(BAD[rules]) and int(place.removeprefix("sweep.toml:")) > 15


def test_a_fraction_to_train_with_is_no_rule():
    (line,) = refusal(SWEEP[: SWEEP.index("train")] + f'test = 1\n[split.train]\n"{ANGLE}" = [25, 30]\n')
    assert line.startswith("sweep.toml:16: split.train: must be a number")


def test_a_rehearsal_shows_splits_by_particles_and_a_refusal_writes_nothing():
    """A sixth of a unit square of sand at 32 cells and four particles each: half of the sweeps have more than 700."""
    sweep_of(holding("[split.test]\nparticles = [700, 5_000]\n"))
    outcome = run_here("sweep", "sweep.toml", "--count", "20", "--dry-run", "--json")
    assert outcome.status == 0, outcome.stderr
    found = json.loads(outcome.stdout)["trajectories"]
    assert {one["split"] == "test" for one in found} == {True, False}
    assert all((one["split"] == "test") == (one["particles"] >= 700) for one in found)
    Path("sweep.toml").write_text(holding("[split.test]\nparticles = [1, 5_000]\n"), encoding="utf-8")
    outcome = run_here("sweep", "sweep.toml", "--count", "20", "-o", "none")
    assert outcome.status == 2 and outcome.stdout == "" and "leave none for the fractions" in outcome.stderr
    assert len(outcome.stderr.splitlines()) == 1 and not Path("none").exists()
