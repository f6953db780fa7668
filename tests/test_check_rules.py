"""Each rule of a scene's check fires on a scene made for it, and is quiet just beyond its threshold."""

import math
import shutil
from types import SimpleNamespace

import psutil
import pytest
from check_scenes import FLUID, SOLID, box, check, found, loaded
from solver_state import scene_of

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import SEVERITIES
from mpmcli.check.scene_check import check_scene
from mpmcli.check.step_rules import HALF_ULP, LOST_MOTION, STRESS_NOISE
from mpmcli.check.unit_rules import unit_findings
from mpmcli.errors import InputError
from mpmcli.materials.fluid import Fluid
from mpmcli.materials.registry import laws, parameter_models
from mpmcli.scene import LoadedScene, load_scene
from mpmcli.scene.examples import examples
from mpmcli.scene.problem import listed, quoted

H = 1 / 64
SAND = {"law": "sand", "density": 1600.0, "youngs_modulus": 1e7}
GRAINS = SAND | {"friction_angle": 30.0}
REST_LIMIT = Fluid.eases[0] * H / math.sqrt(2 * 1e3)
WALL_3D = {"size": [1.0, 1.0, 1.0], "cells": [32, 32, 32], "gravity": [0.0, 0.0, -10.0]}


def block(name: str, low: list[float], high: list[float], **more: object) -> dict:
    """Return a body that is a box of fluid."""
    return {"name": name, "material": FLUID, "shape": box(low, high), **more}


def test_a_plain_scene_is_quiet() -> None:
    """A block of fluid on the floor, and one of rubber: nothing to say."""
    assert check().findings == ()
    assert check(material=SOLID).findings == ()


@pytest.mark.parametrize(
    ("share", "rule", "severity"),
    [
        (1.001, "step-above-limit", "error"),
        (0.999, "step-above-safety", "warning"),
        (0.801, "step-above-safety", "warning"),
        (0.799, None, None),
        (0.201, None, None),
        (0.199, "small-step", "warning"),
    ],
)
def test_the_step_that_is_asked_for(share: float, rule: str | None, severity: str | None) -> None:
    """The limit at rest is h / (c sqrt(2)); safety is 0.8, and a quarter of what it leaves is small."""
    step = share * REST_LIMIT
    findings = [one for one in check(time={"step": step}).findings if one.rule != "dissipation"]
    assert [(one.rule, one.severity) for one in findings] == ([(rule, severity)] if rule else [])
    if rule and rule != "small-step":
        assert findings[0].value == pytest.approx(share)


def test_a_step_that_only_rest_allows() -> None:
    """Between what is safe at the start and what is safe throughout, the run will take smaller ones."""
    material = FLUID | {"tension_cutoff": False}
    checked = check(material=material)
    assert checked.facts.step < checked.facts.step_at_start
    (finding,) = found(
        "step-above-safety", material=material, time={"step": 0.5 * (checked.facts.step + checked.facts.step_at_start)}
    )
    assert "J = " in finding.what
    assert found("step-above-safety", material=material, time={"step": 0.999 * checked.facts.step}) == []


@pytest.mark.parametrize(("cells", "fires"), [(0.9, True), (2.9, True), (3.0, False)])
def test_a_thin_body(cells: float, fires: bool) -> None:
    """Fewer than three cells across."""
    findings = found("thin-body", shape=box([0.25, 0.0], [0.75, cells * H]))
    assert [finding.severity for finding in findings] == ["warning"] * fires
    if fires:
        assert findings[0].value == pytest.approx(cells)


def test_a_slice_of_endless_matter_is_not_thin() -> None:
    """A box from wall to wall in a domain of five cells is thin only where the walls hold it."""
    domain = {"size": [1.0, 5 * H / 2], "cells": [128, 5 * 1], "gravity": [0.0, 0.0]}
    domain["size"][1] = 5 / 128
    shape = box([0.25, 0.0], [0.5, 5 / 128])
    thin = {**domain, "size": [1.0, 5 / 128]}
    facts = SceneFacts(loaded(domain={**thin, "walls": "slip"}, shape=shape).scene)
    held = SceneFacts(loaded(domain={**thin, "walls": {"default": "slip", "y_min": "stick"}}, shape=shape).scene)
    assert facts.bodies[0].thickness == 0.25
    assert held.bodies[0].thickness == pytest.approx(5 / 128)


@pytest.mark.parametrize(("cells", "fires"), [(0.0, False), (0.09, False), (0.11, True), (1.9, True), (2.01, False)])
def test_a_gap(cells: float, fires: bool) -> None:
    """Bodies between a tenth of a cell and two cells apart act on each other unseen; touching ones are meant to."""
    bodies = [block("low", [0.25, 0.0], [0.5, 0.25]), block("high", [0.25, 0.25 + cells * H], [0.5, 0.75])]
    findings = found("gap", bodies)
    assert [finding.severity for finding in findings] == ["note"] * fires
    bodies[1]["velocity"] = [1.0, 0.0]
    assert [finding.severity for finding in found("gap", bodies)] == ["warning"] * fires


@pytest.mark.parametrize(("cells", "fires"), [(0.0, False), (0.5, True), (1.0, False)])
def test_a_wall_that_is_nearly_touched(cells: float, fires: bool) -> None:
    """Less than a cell from a wall, but not on it."""
    findings = found("wall-margin", shape=box([0.25, cells * H], [0.5, 0.5]))
    assert [(one.severity, "y_min" in one.what) for one in findings] == [("note", True)] * fires


def test_bodies_that_separate_begin_where_they_like() -> None:
    """They act on each other, and on walls that separate, where they touch; fluid acts on walls from afar."""
    separate = {"contact": {"default": "separate"}, "domain": {"walls": "separate"}}
    for material, gaps, margins in ((SOLID, 0, 0), (FLUID, 0, 2)):
        bodies = [
            block("low", [0.25, 0.5 * H], [0.5, 0.25]) | {"material": SOLID},
            block("high", [0.25, 0.25 + H], [0.5, 0.75]) | {"material": material},
            block("far", [0.75, 0.5 * H], [0.9, 0.25]) | {"material": material},
            block("farther", [0.95, 0.5 * H], [1.0, 0.25]) | {"material": material},
        ]
        assert len(found("gap", bodies, **separate)) == gaps
        assert len(found("wall-margin", bodies, **separate)) == margins
    sticks = {"walls": {"default": "separate", "y_min": "stick"}}
    assert len(found("wall-margin", bodies[:1], **(separate | {"domain": sticks}))) == 1


@pytest.mark.parametrize(
    ("more", "fires"),
    [
        ({}, False),
        ({"contact": {"default": "stick"}, "solver": {"grid": "sparse"}}, False),
        ({"solver": {"solids": "total"}}, True),
        ({"solver": {"grid": "sparse"}}, True),
    ],
)
def test_a_scene_that_does_not_set_contact(more: dict, fires: bool) -> None:
    """Elastic bodies get a note where they cannot separate; one body if it has something to meet."""
    low, high = block("low", [0.25, 0.0], [0.5, 0.25]), block("high", [0.25, 0.5], [0.5, 0.75])
    elastic = [one | {"material": SOLID} for one in (low, high)]
    assert [finding.severity for finding in found("contact", elastic, **more)] == ["note"] * fires
    if more.get("solver", {}).get("solids") != "total":
        assert not found("contact", [elastic[0], high | {"material": FLUID}], **more)
    for word in ("separate", "slip"):
        notes = found("contact", elastic[:1], domain={"walls": word}, **more)
        assert [one.body for one in notes] == ["low"] * (fires and word == "separate")


def test_solids_that_yield_weld() -> None:
    metal = {"law": "von_mises", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3, "yield_stress": 1e3}
    low, high = block("low", [0.25, 0.0], [0.5, 0.25]), block("high", [0.25, 0.5], [0.5, 0.75])
    slides = metal | {"surface_friction": 0.1}
    for one, material, welds in (
        (metal, metal, True),
        (metal, SOLID, False),
        (metal, FLUID, False),
        (slides, slides, False),
        (slides, metal, False),
    ):
        findings = found("weld", [low | {"material": one}, high | {"material": material}])
        assert [finding.severity for finding in findings] == ["note"] * welds


@pytest.mark.parametrize(("count", "severity"), [(1, "warning"), (3, "warning"), (4, None), (16, None), (17, "note")])
def test_particles_per_cell(count: int, severity: str | None) -> None:
    """From 2^d to 4^d."""
    findings = found("particles-per-cell", particles_per_cell=count, sampling="jittered")
    assert [finding.severity for finding in findings] == ([severity] if severity else [])
    assert ("one particle" in findings[0].what) == (count == 1) if findings else True


def test_small_motions_far_from_the_corner() -> None:
    """Half an ulp of the farthest coordinate of a body over its way in the run, 0.1; never in double precision."""
    end = 1.0
    quiet = {"size": [16.0, 1.0], "cells": [128, 8], "gravity": [0.0, 0.0]}
    for factor, fires in ((0.98, True), (1.02, False)):
        speed = factor * HALF_ULP * 12.5 / LOST_MOTION / end
        slow = block("slow", [12.0, 0.25], [12.5, 0.75], velocity=[speed, 0.0])
        scene = {
            "domain": quiet,
            "time": {"end": end},
            "bodies": [slow, block("fast", [1.0, 0.25], [1.5, 0.75], velocity=[1.0, 0.0])],
        }
        told = [(finding.body, finding.value) for finding in found("rounding-positions", **scene)]
        assert told == ([("slow", pytest.approx(LOST_MOTION / factor))] if fires else [])
        assert found("rounding-positions", **scene, solver={"precision": "f64"}) == []


@pytest.mark.parametrize(("youngs_modulus", "fires"), [(2e9, True), (1e9, False)])
def test_strains_of_a_stiff_cube(youngs_modulus: float, fires: bool) -> None:
    """H9: a cube of 1 m under gravity; rounding makes 2^-24 (d lambda + 2 mu) beside density g H = 10 kPa."""
    material = SOLID | {"youngs_modulus": youngs_modulus, "poissons_ratio": 0.0}
    domain = {"size": [2.0, 2.0], "cells": [64, 64]}
    findings = found("rounding-strains", material=material, domain=domain, shape=box([0.5, 0.0], [1.5, 1.0]))
    noise = HALF_ULP * youngs_modulus / 1e4
    assert [finding.value for finding in findings] == ([pytest.approx(noise)] if fires else [])
    assert (noise > STRESS_NOISE) == fires


@pytest.mark.parametrize("solids", ["updated", "total"])
def test_strains_of_a_stiff_bar_that_is_pulled(solids: str) -> None:
    """Rounding is 2^-24 of the stiffness: little of the stress of a stretch of 1.0025, much of that of 1.0000025."""
    parts = {"left": ([0.2, 0.2], [0.3, 0.6]), "right": ([0.7, 0.2], [0.8, 0.6])}
    grips = [{"name": name, "wall": "hold", "shape": box(*ends)} for name, ends in parts.items()]
    bar = {"shape": box([0.2, 0.2], [0.8, 0.6]), "material": SOLID | {"youngs_modulus": 1e7}}
    bar |= {"domain": {"gravity": [0.0, 0.0]}, "solver": {"solids": solids}, "time": {"end": 1.0}}
    for slow, told in (([1e-3, 0.0], 0), ([1e-6, 0.0], 1)):
        moved = [grips[0], grips[1] | {"velocity": slow}]
        assert len(found("rounding-strains", **bar, colliders=moved)) == told


@pytest.mark.parametrize(("ratio", "fires"), [(0.49, False), (0.495, True)])
def test_locking(ratio: float, fires: bool) -> None:
    """Poisson's ratio above 0.49: it locks without F-bar, and with it steps are small and take more of a wave."""
    material = SOLID | {"poissons_ratio": ratio}
    for f_bar in ("auto", True, False):
        findings = found("locking", material=material, solver={"f_bar": f_bar})
        assert [finding.severity for finding in findings] == ["warning"] * (fires and f_bar is False)
    (loss,) = found("dissipation", material=material)
    assert ("poissons_ratio = 0.49 or less" in loss.fix) == fires


@pytest.mark.parametrize(("light", "fires"), [(10.0, False), (9.9, True)])
def test_density_ratio(light: float, fires: bool) -> None:
    """More than 100 to 1."""
    bodies = [block("heavy", [0.0, 0.0], [0.5, 0.25]), block("light", [0.0, 0.25], [0.5, 0.5])]
    bodies[1]["material"] = FLUID | {"density": light}
    findings = found("density-ratio", bodies)
    assert [finding.body for finding in findings] == ["light"] * fires


def test_the_friction_angle_that_acts() -> None:
    """In 3D asin(3 s / (2 sqrt(3) + s)) in compression and - s in extension, s = sin(phi); in 2D the one given."""
    low = box([0.25, 0.25, 0.0], [0.5, 0.5, 0.25])
    assert found("friction", material=SAND | {"friction_angle": 45.0}) == []
    (one,) = found("friction", material=SAND | {"friction_angle": 45.0}, domain=WALL_3D, shape=low)
    assert (one.severity, "30.6 degrees" in one.what, "50.3 degrees" in one.what) == ("note", True, True)
    (one,) = found("friction", material=SAND | {"friction_angle": 55.0}, domain=WALL_3D, shape=low)
    assert one.severity == "warning"
    # At 60 degrees the cone has no strength in extension left to lose.
    (one,) = found("friction", material=SAND | {"friction_angle": 60.0}, domain=WALL_3D, shape=low)
    assert "90.0 degrees in extension" in one.what


@pytest.mark.parametrize(("share", "said"), [(0.32, None), (0.35, "varies"), (1.1, "shocks")])
def test_a_fluid_that_is_too_soft_for_its_speed(share: float, said: str | None) -> None:
    """v / c above 1/3, where the density varies by more than the tenth that "auto" allows, and above 1."""
    speed = math.sqrt(2 * 10 * 0.25)
    material = FLUID | {"bulk_modulus": 1000.0 * (speed / share) ** 2}
    findings = found("impact-speed", material=material, time={"step": "auto"})
    # c is that of the compressed fluid, a little lower than at rest.
    assert [said in finding.what for finding in findings] == ([True] if said else [])
    if said:
        assert findings[0].value == pytest.approx(share, rel=0.5)
    assert found("impact-speed", material={"law": "fluid", "density": 1000.0, "compressibility": 0.1}) == []


def test_a_solid_is_hit_as_fast_as_it_falls() -> None:
    """A block that stands is not hit at all, and one that falls 0.5 m arrives at sqrt(2 g 0.5)."""
    soft = SOLID | {"youngs_modulus": 2e4, "poissons_ratio": 0.0}
    assert found("impact-speed", material=soft) == []
    (one,) = found("impact-speed", material=soft, shape=box([0.25, 0.5], [0.5, 0.75]))
    assert f"at {math.sqrt(10.0):.3g} m/s" in one.what


@pytest.mark.parametrize(
    ("collider", "speed"),
    [
        ({"velocity": [8.0, 0.0], "density": 7800.0}, 8.0),
        ({"velocity": [8.0, 0.0]}, 8.0),
        ({"keyframes": [{"time": 0.0}, {"time": 0.1, "offset": [0.8, 0.0]}]}, 8.0),
        # It misses, recedes, or is slow.
        ({"velocity": [0.0, 8.0], "density": 7800.0}, None),
        ({"velocity": [-8.0, 0.0]}, None),
        ({"velocity": [1.0, 0.0]}, None),
    ],
    ids=["rigid", "velocity", "keyframes", "misses", "recedes", "slow"],
)
@pytest.mark.parametrize("law", ["solid", "fluid"])
def test_what_is_hit_by_a_collider_faster_than_its_waves(collider: dict, speed: float | None, law: str) -> None:
    """c is sqrt(K / density) of a fluid, and of a solid that at rest: sqrt(E / (2 density)) for nu = 0."""
    soft = SOLID | {"youngs_modulus": 4e4, "poissons_ratio": 0.0}
    material = soft if law == "solid" else FLUID | {"bulk_modulus": 2e4}
    ball = {"name": "ball", "shape": {"ball": {"center": [0.2, 0.5], "radius": 0.1}}, **collider}
    findings = found(
        "impact-speed",
        material=material,
        shape=box([0.5, 0.25], [0.75, 0.75]),
        domain={"size": [1.0, 1.0], "cells": [32, 32], "gravity": [0.0, 0.0]},
        time={"end": 0.2, "frames": 1},
        colliders=[ball],
    )
    if law == "fluid" and speed is None:
        # Any part of a liquid may meet any collider.
        return
    assert [one.body for one in findings] == ["block"] * (speed is not None)
    if speed:
        assert f"at {speed:.3g} m/s" in findings[0].what and "faster than its waves" in findings[0].what
        if law == "solid":
            c = math.sqrt(4e4 / 2 / 1000.0)
            assert findings[0].value == pytest.approx(speed / c)


def test_what_falls_onto_a_rigid_body_or_a_plane() -> None:
    """At sqrt(2 g H), both ways; a rigid body that lies on it does not hit it."""
    soft = SOLID | {"youngs_modulus": 2e4, "poissons_ratio": 0.0}
    plane = {"name": "ground", "shape": {"plane": {"point": [0.0, 0.1], "normal": [0.0, 1.0]}}}
    (one,) = found("impact-speed", material=soft, shape=box([0.25, 0.6], [0.5, 0.75]), colliders=[plane])
    assert one.value == pytest.approx(math.sqrt(2 * 10 * 0.6) / math.sqrt(2e4 / 2 / 1000.0), rel=0.1)
    for low, fires in ((0.7, True), (0.25, False)):
        stone = {"name": "stone", "density": 3000.0, "shape": box([0.3, low], [0.5, low + 0.2])}
        hits = found("impact-speed", material=soft, shape=box([0.25, 0.0], [0.5, 0.25]), colliders=[stone])
        assert bool(hits) == fires
        if fires:
            speed = math.sqrt(2 * 10 * (0.7 - 0.25))
            assert '"stone"' in hits[0].what and hits[0].value == pytest.approx(speed / math.sqrt(1e1), rel=0.1)


@pytest.mark.parametrize(("factor", "fires"), [(0.98, False), (1.02, True)])
def test_a_solid_that_cannot_carry_itself(factor: float, fires: bool) -> None:
    """density g H over E above 0.3, for what has a shape to lose."""
    weight = 1000.0 * 10 * 0.25
    material = SOLID | {"youngs_modulus": weight / 0.3 / factor}
    assert [one.value for one in found("soft", material=material)] == ([pytest.approx(0.3 * factor)] if fires else [])
    assert found("soft", material=FLUID | {"bulk_modulus": 5e3}) == []


def test_the_energy_that_the_transfers_take() -> None:
    """0.024 (pi h / thickness)^4 per step; told where it makes a tenth in the run, not where viscosity takes more."""
    thin = box([0.25, 0.25], [0.75, 0.25 + 4 * H])
    brief = {"shape": thin, "time": {"end": 0.05}}
    (one,) = found("dissipation", **brief)
    assert one.value == pytest.approx(0.024 * (math.pi / 4) ** 4 / (0.8 * REST_LIMIT))
    assert found("dissipation", **brief, material=FLUID | {"viscosity": 200.0}) == []
    rate = 0.024 * (math.pi / 16) ** 4 / (0.8 * REST_LIMIT)
    critical = -math.log(0.9) / rate
    assert found("dissipation", time={"end": 0.98 * critical}) == []
    assert len(found("dissipation", time={"end": 1.02 * critical})) == 1


def test_frames_closer_than_steps_and_too_many() -> None:
    """An interval below the stable step is a note, more than 100,000 frames a warning."""
    step = 0.8 * REST_LIMIT
    assert found("frames", time={"end": 10.1 * step, "frames": 10}) == []
    (one,) = found("frames", time={"end": 9.9 * step, "frames": 10})
    assert (one.severity, "time.frames to 9" in one.fix) == ("note", True)
    # Of a pendulum at rest at first, whose steps are smaller later.
    joint = {"type": "hinge", "point": [1.0, 1.6]}
    ball = {"name": "ball", "shape": {"ball": {"center": [0.4, 1.0], "radius": 0.2}}, "density": 1e3, "joint": joint}
    swing = check(bodies=[], colliders=[ball], time={"end": 2.0, "frames": 80})
    assert swing.forecast.steps > 160 and "frames" not in [finding.rule for finding in swing.findings]
    assert " 0 particles" not in swing.text(), "it has no material"
    assert found("frames", time={"end": 1e3, "frames": 100_000}) == []
    (one,) = found("frames", time={"end": 1e3, "frames": 100_001})
    assert one.severity == "warning"


def test_a_full_disk_and_too_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the file has to fit on the disk, and the plan into 0.8 of the free memory."""
    checked = check()
    need = checked.forecast.file_bytes
    for free, fires in ((2 * need - 1, True), (2 * need, False)):
        monkeypatch.setattr(
            shutil, "disk_usage", lambda _path, free=free, need=need: SimpleNamespace(free=free, total=10 * need)
        )
        assert [one.severity for one in found("disk")] == ["warning"] * fires
    total = checked.plan.device_bytes + checked.plan.host_bytes
    for available, fires in ((1.24 * total, True), (1.26 * total, False)):
        monkeypatch.setattr(psutil, "virtual_memory", lambda available=available: SimpleNamespace(available=available))
        assert [one.severity for one in found("memory")] == ["error"] * fires


def test_a_scene_in_which_nothing_moves() -> None:
    """Neither gravity nor a velocity (H22)."""
    still = {"gravity": [0.0, 0.0]}
    (one,) = found("at-rest", domain=still)
    assert one.severity == "note"
    assert found("at-rest", domain=still, velocity=[0.1, 0.0]) == []


def test_findings_are_sentences_and_sorted() -> None:
    """The gravest first; what and fix are sentences with a capital and a full stop."""
    material = SOLID | {"youngs_modulus": 2e3, "poissons_ratio": 0.495}
    findings = check(
        material=material,
        shape=box([0.25, 0.5 * H], [0.5, 2 * H]),
        time={"step": 1.0},
        particles_per_cell=1,
        velocity=[0.0, -9.0],
    ).findings
    assert len({finding.rule for finding in findings}) >= 5
    ranks = [SEVERITIES.index(finding.severity) for finding in findings]
    assert ranks == sorted(ranks) and ranks[0] == 0
    for finding in findings:
        for sentence in (finding.what, finding.fix):
            assert sentence[0].isupper() and sentence.endswith(".") and ".." not in sentence


def test_a_law_declares_the_parameters_that_set_its_stiffness(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fix of the wave limit names the first of `Law.stiffness_parameters`, with its value."""
    monkeypatch.setattr(laws()["fluid"], "stiffness_parameters", ("unknown", "density"))
    (limit,) = (one for one in check().facts.limits if (one.name, one.state) == ("wave", "rest"))
    assert limit.fix.startswith("A quarter of density = 1000 or ")


@pytest.mark.parametrize(("ratio", "severity"), [(0.3, None), (0.5, "warning"), (1.7, "error")])
def test_a_solid_that_spins_too_fast(ratio: float, severity: str | None) -> None:
    """3/8 rho v^2 of the rim over Young's modulus, 0.05 and 1; a fluid may fly apart, and moving along is no spin."""
    disc = {"ball": {"center": [0.5, 0.5], "radius": 0.2}}
    material = SOLID | {"poissons_ratio": 0.0}
    rate = ratio * math.sqrt(1e6 / 1000.0) / 0.2
    spin = [[0.0, -rate], [rate, 0.0]]
    findings = found("rotation", material=material, shape=disc, velocity_gradient=spin)
    assert [finding.severity for finding in findings] == ([severity] if severity else [])
    for finding in findings:
        assert finding.value == pytest.approx(3 / 8 * ratio**2, rel=0.05)
    written = [f"-{rate} * (Y - 0.5)", f"{rate} * (X - 0.5)"]
    assert len(found("rotation", material=material, shape=disc, velocity=written)) == len(findings)
    assert found("rotation", material=FLUID, shape=disc, velocity_gradient=spin) == []
    assert found("rotation", material=material, shape=disc, velocity=[40.0, 0.0]) == []
    assert found("rotation", material=material, shape=disc, velocity_gradient=[[0.0, rate], [rate, 0.0]]) == []


@pytest.mark.parametrize(
    ("size", "speed", "severity"),
    [
        # Across the tank, from 0.4 m down: the block of 0.0625 m^2 has 0.3, 0.05 and 0.01 m^2 in the end.
        ([1.0, 0.2], -0.2, None),
        ([1.0, 0.2], -0.7, "warning"),
        ([1.0, 0.2], -0.78, "error"),
        # There is a way out on one side, and the way up is no trap.
        ([0.9, 0.2], -0.78, None),
        ([1.0, 0.2], 0.7, None),
    ],
)
def test_colliders_that_close_a_room(size: list[float], speed: float, severity: str | None) -> None:
    piston = {"name": "piston", "shape": box([0.0, 0.4], [size[0], 0.4 + size[1]]), "velocity": [0.0, speed]}
    scene = scene_of(
        domain={"size": [1.0, 1.0], "cells": [64, 64], "gravity": [0.0, -10.0], "walls": "slip"},
        time={"end": 0.5, "frames": 10},
        bodies=[{"name": "block", "material": SOLID, "shape": box([0.25, 0.0], [0.5, 0.25])}],
        colliders=[piston],
    )
    findings = [one for one in check_scene(LoadedScene(scene, (), "scene.toml")).findings if one.rule == "room"]
    assert [finding.severity for finding in findings] == ([severity] if severity else [])
    for finding in findings:
        assert finding.value == pytest.approx((0.4 + 0.5 * speed) / 0.0625, abs=0.2)


@pytest.mark.parametrize(
    ("gravity", "fine"),
    [
        ("-9.81 * sqrt(t - 0.1)", False),
        ("-9.81 * sqrt(0.45 - t)", False),
        ("-9.81 * sqrt(0.5 - t)", True),
        ("-9.81 * sin(t) / t", True),
        ("log(t - 0.1) if t > 0.2 else 0", True),
    ],
)
def test_gravity_that_is_no_number_at_some_time(gravity: str, fine: bool) -> None:
    if fine:
        check(domain={"gravity": [0.0, gravity]})
        return
    with pytest.raises(InputError, match=r"domain\.gravity\[1\]: must be finite from time 0 to time\.end"):
        check(domain={"gravity": [0.0, gravity]})


@pytest.mark.parametrize(
    ("material", "walls", "fires"),
    [
        (GRAINS, {"walls": "separate"}, True),
        (GRAINS, {"walls": "slip"}, True),
        (GRAINS, {"walls": {"y_min": "stick"}}, False),
        (GRAINS, {"friction": {"y_min": 0.3}}, False),
        (GRAINS, {"friction": {"x_min": 0.3}}, True),
        (GRAINS, {"gravity": [0.0, 0.0]}, False),
        ("mud", {}, True),
        (FLUID | {"viscosity": 0.1}, {}, True),
        (FLUID | {"viscosity": 0.09}, {}, False),
        (SOLID, {}, False),
    ],
)
def test_what_slides_on_the_floor_is_said(material: object, walls: dict, fires: bool) -> None:
    """Grains, mud and viscous liquids on a floor without friction; walls at the sides do not count."""
    domain = {"gravity": [0.0, -10.0]} | walls
    assert len(found("slippery", domain=domain, material=material)) == fires


def test_the_text_says_once_what_concerns_several_bodies() -> None:
    """Findings that differ in the body alone are one; of losses the largest; JSON has them all."""
    sizes = {"a": 0.1, "b": 0.2, "c": 0.15, "d": 0.1}
    bodies = [
        block(name, [0.25 * k + 0.02, 0.5], [0.25 * k + 0.02 + size, 0.5 + size]) | {"material": SOLID}
        for k, (name, size) in enumerate(sizes.items())
    ]
    for body in bodies[2:]:
        body["particles_per_cell"] = 1
    checked = check(bodies)
    losses = {f.body: f for f in checked.findings if f.rule == "dissipation"}
    assert set(losses) == set("abcd")
    lines = checked.text().splitlines()
    (loss,) = (line for line in lines if "of the energy of a wave" in line)
    worst = max(losses.values(), key=lambda f: f.value)
    assert loss == f"{worst.line} As much or less for {listed(quoted(sorted(set('abcd') - {worst.body})), 'and')}."
    (few,) = (line for line in lines if "one particle per cell" in line)
    assert few.endswith('Set particles_per_cell = 4 or more. The same for "d".') and 'Body "c"' in few
    assert lines[-1] == f"ok: 1 warning, {sum(line.startswith('note: ') for line in lines)} notes"


@pytest.mark.parametrize(
    ("body", "fires"),
    [
        ({}, True),
        ({"initial_pressure": "hydrostatic"}, False),
        ({"velocity": [0.1, 0.0]}, False),
        ({"material": SOLID}, False),
        ({"shape": box([0.0, 0.0], [0.9, 0.5])}, False),
        ({"shape": box([0.0, 0.1], [1.0, 0.5])}, False),
    ],
)
def test_a_pool_without_pressure_is_said(body: dict, fires: bool) -> None:
    """Fluid from wall to wall on the floor; the pressure at the floor is density times g times depth."""
    pool = block("pool", [0.0, 0.0], [1.0, 0.5]) | body
    findings = found("no-pressure", [pool], domain={"gravity": [0.0, -10.0]})
    assert [finding.value for finding in findings] == [pytest.approx(1000 * 10 * 0.5)] * fires


@pytest.mark.parametrize(("cells", "fires"), [(0.0, True), (0.9, True), (1.0, False)])
def test_a_rigid_body_that_liquid_cannot_lift_is_said(cells: float, fires: bool) -> None:
    """Less than a cell above the floor of a pool, which has nodes only of both or of neither there."""
    shape = box([0.25, cells * H], [0.5, 0.25 + cells * H])
    pool = block("pool", [0.0, 0.0], [1.0, 0.5]) | {"shape": box([0.0, 0.0], [1.0, 0.5]) | {"subtract": [shape]}}
    raft = {"name": "raft", "shape": shape, "density": 500.0}
    assert len(found("no-liquid-between", [pool], colliders=[raft])) == fires
    dry = block("drop", [0.75, 0.5], [0.9, 0.75])
    assert found("no-liquid-between", [dry], colliders=[raft]) == []


@pytest.mark.parametrize("kind", ["rigid body", "collider", "wall"])
@pytest.mark.parametrize(("cells", "fires"), [(1.5, True), (3.9, True), (4.1, False)])
def test_a_gap_that_liquid_hardly_passes_is_said(kind: str, cells: float, fires: bool) -> None:
    """Of fewer than four cells, between a disc in a pool and a disc, a fixed post or a wall; once for each pair."""
    radius, x = 6 * H, (0.5 if kind != "wall" else 1.0 - (6 + cells) * H)
    discs = [{"name": "disc", "density": 2500.0, "shape": {"ball": {"center": [x, 0.3], "radius": radius}}}]
    if kind != "wall":
        second = {"ball": {"center": [x - 2 * radius - cells * H, 0.3], "radius": radius}}
        discs.append({"name": "other", "shape": second} | ({"density": 2500.0} if kind == "rigid body" else {}))
    pool = block("pool", [0.0, 0.0], [1.0, 0.5])
    pool["shape"] = box([0.0, 0.0], [1.0, 0.5]) | {"subtract": [disc["shape"] for disc in discs]}
    gaps = found("narrow-gap", [pool], colliders=discs)
    assert [(one.severity, one.body) for one in gaps] == [("warning", "disc")] * fires
    assert [one.value for one in gaps] == [pytest.approx(cells, abs=0.1)] * fires
    # Without liquid, and with liquid that is elsewhere.
    assert found("narrow-gap", [block("drop", [0.0, 0.7], [0.2, 0.9])], colliders=discs) == []
    assert found("narrow-gap", [pool | {"material": SOLID}], colliders=discs) == []


METAL = {"law": "von_mises", "density": 1000.0, "youngs_modulus": 1e6, "yield_stress": 1e4}
LEFT, RIGHT, HEAP = box([0.1, 0.0], [0.3, 0.25]), box([0.6, 0.0], [0.8, 0.25]), box([0.2, 0.0], [0.8, 8 / 64])


def stacked(upper: float, lower: float, **more: object) -> dict:
    """Return two liquids of these densities, one on the other."""
    halves = (("lower", lower, box([0.0, 0.0], [1.0, 0.5])), ("upper", upper, box([0.0, 0.5], [1.0, 1.0])))
    return {
        "bodies": [
            {"name": name, "material": FLUID | {"density": density}, "shape": shape} | more
            for name, density, shape in halves
        ]
    }


@pytest.mark.parametrize(
    ("rule", "said", "other"),
    [
        ("units", {"domain": {"gravity": [0.0, -981.0]}}, {"domain": {"gravity": [0.0, -98.1]}}),
        ("units", {"domain": {"gravity": [0.0, -9810.0]}}, {"domain": {"gravity": [0.0, -5000.0]}}),
        ("gravity-up", {"domain": {"gravity": [0.0, 9.81]}}, {"domain": {"gravity": [9.81, 4.0]}}),
        ("gravity-up", {"domain": {"gravity": [1.0, 9.81]}}, {"domain": {"gravity": ["1", "sin(60 * t)"]}}),
        ("friction-coefficient", {"domain": {"friction": 30.0}}, {"domain": {"friction": 1.9}}),
        (
            "friction-coefficient",
            {"colliders": [{"name": "ramp", "shape": RIGHT, "friction": 25.0}]},
            {"colliders": [{"name": "ramp", "shape": RIGHT, "friction": 0.5}]},
        ),
        ("friction-angle", {"material": SAND | {"friction_angle": 0.6}}, {"material": GRAINS}),
        ("low-heap", {"material": GRAINS, "shape": box([0.2, 0.0], [0.8, 0.1])}, {"material": GRAINS, "shape": HEAP}),
        ("large-domain", {"domain": {"size": [10.0, 10.0], "cells": [640, 640]}}, {"domain": {"size": [2.0, 2.0]}}),
        (
            "submerged",
            {
                "bodies": [
                    {"name": "a", "material": GRAINS, "shape": LEFT},
                    {"name": "b", "material": FLUID, "shape": RIGHT},
                ]
            },
            {
                "bodies": [
                    {"name": "a", "material": GRAINS, "shape": LEFT},
                    {"name": "b", "material": SOLID, "shape": RIGHT},
                ]
            },
        ),
        ("overturning", stacked(1200.0, 800.0), stacked(800.0, 1200.0)),
        ("overturning", stacked(1200.0, 800.0), stacked(1200.0, 800.0, sampling="turned")),
    ],
)
def test_numbers_in_other_units_or_of_another_kind(rule: str, said: dict, other: dict) -> None:
    """What newcomers write in cm, in degrees for a coefficient, in radians for degrees; the rest is left alone."""
    (finding,) = found(rule, **said)
    notes = ("low-heap", "large-domain", "submerged", "overturning")
    assert finding.severity == ("note" if rule in notes else "warning")
    assert found(rule, **other) == []


PART = {"name": "part", "shape": box([0.6, 0.1], [0.8, 0.3])}
TURNED = {"keyframes": [{"time": 0.0}, {"time": 5.0, "angle": 90.0}]}
WEAK = SOLID | {"youngs_modulus": 200.0}
RIGID = PART | {"density": 500.0}
TILTED = box([0.25, 0.2], [0.5, 0.45])


@pytest.mark.parametrize(
    ("said", "right", "other"),
    [
        ({"material": SOLID | {"density": 7.8}}, "7.8 g/cm^3 are 7800", {"material": SOLID | {"density": 30.0}}),
        ({"material": FLUID | {"density": 0.5}}, "0.5 g/cm^3 are 500", {}),
        ({"colliders": [PART | {"density": 0.8}]}, "0.8 g/cm^3 are 800", {"colliders": [RIGID]}),
        # The other one is a gel that nothing loads.
        ({"material": WEAK}, "200 GPa 2e+11", {"material": WEAK, "domain": {"gravity": [0.0, -0.1]}}),
        ({"material": SOLID | {"youngs_modulus": 0.015}}, "0.015 MPa are 1.5e+04", {"material": SOLID}),
        ({"material": FLUID | {"bulk_modulus": 2.2}}, "2.2 GPa 2.2e+09", {}),
        (
            {"colliders": [PART | {"angular_velocity": 90.0}]},
            "1.571",
            {"colliders": [PART | {"angular_velocity": 6.0}]},
        ),
        ({"colliders": [PART | {"angle": "90*t"}]}, "1.571", {"colliders": [PART | {"angle": "0.05*sin(1000*t)"}]}),
        ({"colliders": [PART | {"angular_velocity": 90.0}], "time": {"end": 0.03}}, "1.57", {}),
        ({"colliders": [PART | {"angle": 45.0}]}, "45 degrees are 0.7854", {"colliders": [PART | {"angle": 0.7854}]}),
        ({"colliders": [PART | TURNED]}, "90 degrees are 1.571", {}),
        (
            {"colliders": [RIGID | {"joint": {"type": "hinge", "motor": 90.0}}]},
            "1.571",
            {"colliders": [RIGID | {"joint": {"type": "hinge", "motor": 9.0}}]},
        ),
        # The other one rolls.
        (
            {"colliders": [RIGID | {"angular_velocity": 40.0}]},
            "40 degrees",
            {"colliders": [RIGID | {"angular_velocity": 40.0, "velocity": [4.0, 0.0]}]},
        ),
        *(
            ({"shape": TILTED | {"rotation": angle}}, f"{angle:.4g} rad are {degrees}", {})
            for angle, degrees in ((0.5, "28.65"), (1.57, "89.95"), (-1.0472, "-60"))
        ),
        (
            {"colliders": [PART | {"shape": PART["shape"] | {"rotation": 0.785}}]},
            "0.785 rad are 44.98",
            {"colliders": [PART | {"shape": PART["shape"] | {"rotation": 2.5}}]},
        ),
    ],
)
def test_numbers_that_may_be_in_other_units_are_asked_about(said: dict, right: str, other: dict) -> None:
    """Densities in g/cm^3, moduli in MPa, angles of a motion in degrees, rotations of a shape in radians."""
    (finding,) = found("units", **said)
    assert finding.severity == "note" and right in finding.fix
    assert found("units", **other) == []


def test_no_example_is_asked_about_its_units() -> None:
    scenes = (load_scene(path, laws=parameter_models()) for path in examples().values())
    assert [one for loaded in scenes for one in unit_findings(SceneFacts(loaded.scene)) if one.rule == "units"] == []


def test_cohesion_alone_is_another_law() -> None:
    """Below 5 degrees: von Mises, whose strength in simple shear is its yield stress over sqrt(3)."""
    (finding,) = found("friction-angle", material=SAND | {"friction_angle": 1.0, "cohesion": 5000.0})
    assert "yield_stress = 8660" in finding.fix


def test_hydrostatic_pressure_is_not_advised_where_it_is_refused() -> None:
    """In a pool from wall to wall, with constant gravity and with gravity of time."""
    pool = {"shape": box([0.0, 0.0], [1.0, 0.25])}
    assert len(found("no-pressure", **pool)) == 1
    assert found("no-pressure", **pool, domain={"gravity": ["sin(t)", "-10"]}) == []


@pytest.mark.parametrize(
    ("speed", "count", "needed"), [(0.6, 4, 9), (0.6, 9, None), (1.4, 4, 16), (0.2, 4, None), (-0.2, 4, None)]
)
def test_grips_that_pull_a_body_apart(speed: float, count: int, needed: int | None) -> None:
    """Of 0.3 m between two grips: to twice and 3.3 times that in 0.5 s, and less; what has more particles holds."""
    grips = [
        {"name": "fixed", "wall": "hold", "shape": box([0.0, 0.0], [0.2, 0.5])},
        {"name": "grip", "wall": "hold", "shape": box([0.5, 0.0], [0.7, 0.5]), "velocity": [speed, 0.0]},
    ]
    bar = {"material": SOLID, "shape": box([0.1, 0.2], [0.6, 0.4]), "particles_per_cell": count}
    findings = found("pulled", **bar, domain={"gravity": [0.0, 0.0]}, colliders=grips)
    assert len(findings) == (needed is not None)
    if needed:
        assert f"Set particles_per_cell = {needed}, " in findings[0].fix


GRIP = {"name": "grip", "wall": "hold", "shape": box([0.0, 0.4], [0.15, 0.8])}
BOUNCY = {"name": "ball", "density": 500.0, "shape": {"ball": {"center": [0.8, 0.5], "radius": 0.1}}}
DRUM = {"name": "drum", "side": "inside", "shape": {"ball": {"center": [0.5, 0.5], "radius": 0.4}}}


@pytest.mark.parametrize(
    ("rule", "said", "other"),
    [
        # A beam that falls, and one that is held.
        ("impact-loss", {}, {"colliders": [GRIP]}),
        # Sand above a slippery floor, and in a drum.
        ("slippery", {"material": GRAINS}, {"material": GRAINS, "colliders": [DRUM]}),
        # Beside a ramp, and above one that covers the floor; through a gap, and above a thin plate.
        (
            "slippery",
            {"material": GRAINS, "colliders": [{"name": "ramp", "shape": box([0.4, 0.0], [1.0, 0.1])}]},
            {"material": GRAINS, "colliders": [{"name": "ramp", "shape": box([0.0, 0.0], [1.0, 0.1])}]},
        ),
        (
            "slippery",
            {"material": GRAINS, "colliders": [{"name": "grip", "wall": "hold", "shape": box([0.0, 0.0], [1.0, 0.1])}]},
            {"material": GRAINS, "colliders": [{"name": "plate", "shape": box([0.2, 0.1], [0.6, 0.101])}]},
        ),
        (
            "slip",
            {"colliders": [{"name": "cone", "wall": "slip", "shape": box([0.7, 0.0], [0.8, 0.1])}]},
            {"colliders": [{"name": "cone", "shape": box([0.7, 0.0], [0.8, 0.1])}]},
        ),
        ("restitution", {"colliders": [BOUNCY | {"restitution": 0.5}]}, {"colliders": [BOUNCY]}),
    ],
)
def test_what_concerns_a_body_is_said_and_nothing_else(rule: str, said: dict, other: dict) -> None:
    block = {"material": SOLID, "shape": box([0.3, 0.4], [0.6, 0.5]), "time": {"end": 1.0}}
    beam = block | ({"shape": box([0.1, 0.5], [0.6, 0.6])} if rule == "impact-loss" else {})
    assert len(found(rule, **(beam | said))) == 1
    assert found(rule, **(beam | other)) == []


def test_a_loss_is_told_only_with_a_remedy() -> None:
    """Half the spacing leaves an eighth of the rate: in a long run nothing; of an impact half, told from a tenth on."""
    assert found("dissipation", material=SOLID, time={"end": 500.0, "frames": 10}) == []
    (locked,) = found("dissipation", material=SOLID | {"poissons_ratio": 0.495}, time={"end": 500.0, "frames": 10})
    assert "spacing" not in locked.fix
    falling = {"material": SOLID, "time": {"end": 1.0}}
    (finding,) = found("impact-loss", **falling, shape=box([0.25, 0.5], [0.35, 0.6]))
    assert finding.value >= 0.1 and finding.fix.startswith("Half the spacing leaves ")
    assert found("impact-loss", **falling, shape=box([0.1, 0.3], [0.9, 0.9])) == []
