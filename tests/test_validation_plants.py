"""Errors planted on purpose, each of which a validation case must catch at its coarse level."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from mpmcli.validation.cases import all_cases

ROOT = Path(__file__).resolve().parent.parent
FEWEST = 10


@dataclass(frozen=True)
class Plant:
    """An error: in one source file one text in place of another; and the cases that should see it."""

    name: str
    file: str
    right: str
    wrong: str
    cases: tuple[str, ...]

    def __str__(self) -> str:
        return self.name


PLANTS = (
    Plant(
        "stress with the wrong sign",
        "solver/transfer/particle_step.py",
        "(mass * grid.spacing) * C[c, a] - stress_scale * stress[c, a]",
        "(mass * grid.spacing) * C[c, a] + stress_scale * stress[c, a]",
        ("bar_fixed_fixed",),
    ),
    Plant(
        "stress without 4/h^2",
        "solver/transfer/particle_step.py",
        "stress_scale = kick * volume * grid.gradient_scale",
        "stress_scale = kick * volume * grid.spacing",
        ("bar_fixed_fixed",),
    ),
    Plant(
        "stress with the cubic kernel's 3/h^2",
        "solver/transfer/particle_step.py",
        "stress_scale = kick * volume * grid.gradient_scale",
        "stress_scale = kick * volume * (3 * grid.inverse_spacing)",
        ("bar_fixed_fixed",),
    ),
    Plant(
        "gradient with 3/h^2",
        "solver/transfer/particle_step.py",
        "(distance[a] - 1.0)) * grid.gradient_scale",
        "(distance[a] - 1.0)) * (3 * grid.inverse_spacing)",
        ("bar_fixed_fixed",),
    ),
    Plant(
        "middle weight of the kernel",
        "solver/transfer/splines.py",
        "0.75 - (distance - 1.0) ** 2",
        "0.7 - (distance - 1.0) ** 2",
        ("bar_fixed_fixed",),
    ),
    Plant(
        "gradient transposed",
        "solver/transfer/particle_step.py",
        "sums.velocity, sums.moment).transpose()",
        "sums.velocity, sums.moment)",
        ("homogeneous",),
    ),
    Plant(
        "affine velocity transposed",
        "solver/transfer/particle_step.py",
        "(mass * grid.spacing) * C[c, a] -",
        "(mass * grid.spacing) * C[a, c] -",
        ("conservation", "taylor_green"),
    ),
    Plant(
        "affine velocity halved",
        "solver/transfer/particle_step.py",
        "(mass * grid.spacing) * C[c, a] -",
        "(0.5 * mass * grid.spacing) * C[c, a] -",
        ("dam_break",),
    ),
    Plant(
        "walls that zero their nodes",
        "boundaries/mirror_images.py",
        "result[c] *= signs[c]",
        "result[c] *= ti.max(signs[c], 0.0)",
        ("bar_fixed_fixed",),
    ),
    Plant(
        "mirror images that are not mirrored",
        "boundaries/mirror_images.py",
        "result[c] *= signs[c]",
        "result[c] *= 1.0",
        ("bar_fixed_fixed",),
    ),
    Plant(
        "gravity upwards",
        "solver/engine/device.py",
        "step.kick * ti.cast",
        "-step.kick * ti.cast",
        ("dam_break",),
    ),
    Plant(
        "half of gravity",
        "solver/engine/device.py",
        "step.kick * ti.cast",
        "0.5 * step.kick * ti.cast",
        ("dam_break",),
    ),
    Plant(
        "deformation by half a step",
        "solver/transfer/particle_step.py",
        "rate = dt * C[i, k]",
        "rate = 0.5 * dt * C[i, k]",
        ("bar_fixed_fixed",),
    ),
    Plant(
        "motion by half a step",
        "solver/transfer/particle_update.py",
        "way = dt * v[c] + remainder[c]",
        "way = 0.5 * dt * v[c] + remainder[c]",
        ("dam_break",),
    ),
    Plant(
        "J without the whole trace",
        "solver/particles/state_bounds.py",
        "growth = dt * (C.trace() + dt * second_invariant(C))",
        "growth = dt * (C[0, 0] + dt * second_invariant(C))",
        ("dam_break",),
    ),
    Plant(
        "J without the second invariant",
        "solver/particles/state_bounds.py",
        "growth = dt * (C.trace() + dt * second_invariant(C))",
        "growth = dt * C.trace()",
        ("elliptical_drop",),
    ),
    Plant(
        "a first kick of a whole step",
        "solver/engine/step_size.py",
        "due = run.kick_carry + 0.5 * (run.last_step + dt)",
        "due = dt",
        ("column_dynamic", "mms_2d_neo_hookean"),
    ),
    Plant(
        "pressure halved",
        "materials/fluid.py",
        "spherical = constants[BULK_MODULUS] * (J - 1.0)",
        "spherical = 0.5 * constants[BULK_MODULUS] * (J - 1.0)",
        ("hydrostatic",),
    ),
    Plant(
        "viscosity halved",
        "materials/fluid.py",
        "tau += constants[VISCOSITY] * (C + C.transpose())",
        "tau += 0.5 * constants[VISCOSITY] * (C + C.transpose())",
        ("homogeneous",),
    ),
    Plant(
        "bulk part of the viscosity with the wrong sign",
        "materials/fluid.py",
        "parameters.bulk_viscosity - 2 / 3 * parameters.viscosity",
        "parameters.bulk_viscosity + 2 / 3 * parameters.viscosity",
        ("homogeneous",),
    ),
    Plant(
        "exponent of the equation of state",
        "materials/fluid.py",
        "-exp_minus_1(-constants[EXPONENT] * log(crushed))",
        "-exp_minus_1((-constants[EXPONENT] - 1.0) * log(crushed))",
        ("homogeneous",),
    ),
    Plant(
        "radius of the von Mises cylinder",
        "materials/von_mises.py",
        "stress = ti.static(math.sqrt(6.0)) * mu",
        "stress = ti.static(math.sqrt(4.0)) * mu",
        ("homogeneous",),
    ),
    Plant(
        "lambda of the neo-Hookean solid doubled",
        "materials/neo_hookean.py",
        "constants[LAMBDA] * log(deformation.determinant())",
        "2.0 * constants[LAMBDA] * log(deformation.determinant())",
        ("homogeneous",),
    ),
    Plant(
        "lambda of the corotated solid with J squared",
        "materials/fixed_corotated.py",
        "pressure_part = constants[LAMBDA] * (J - 1.0) * J",
        "pressure_part = constants[LAMBDA] * (J - 1.0) * J * J",
        ("homogeneous",),
    ),
    Plant(
        "mu of the corotated solid halved",
        "materials/fixed_corotated.py",
        "tau += constants[MU] * (stretched + stretched.transpose())",
        "tau += constants[MU] * stretched",
        ("homogeneous",),
    ),
    Plant(
        "friction angle in degrees",
        "materials/sand.py",
        "phi = math.radians(parameters.friction_angle)",
        "phi = parameters.friction_angle",
        ("sand_shear",),
    ),
    Plant(
        "friction angle of triaxial compression",
        "materials/sand.py",
        "math.sqrt(2) * math.sin(phi)",
        "math.sqrt(2 / 3) * 4 * math.sin(phi) / (3 - math.sin(phi))",
        ("sand_shear",),
    ),
    Plant(
        "sand that slides without friction on itself",
        "materials/sand.py",
        "deviator *= strength / shear",
        "deviator *= 0.5 * strength / shear",
        ("sand_shear",),
    ),
    Plant(
        "snow that softens as it packs",
        "materials/snow.py",
        "hardness = exp(constants[HARDENING] * (1.0 - variables[0]))",
        "hardness = exp(constants[HARDENING] * (variables[0] - 1.0))",
        ("snow_oedometer",),
    ),
    Plant(
        "snow that forgets what it lost",
        "materials/snow.py",
        "lost *= before / s[i]",
        "lost *= 1.0",
        ("snow_oedometer",),
    ),
    Plant(
        "rigid bodies get no torque",
        "boundaries/rigid_bodies.py",
        "self.momentum[b, a] = self.momentum[b, a] + self.colliders.loads.taken[row][a]",
        "self.momentum[b, a] = self.momentum[b, a] + (1.0 if a < 2 else 0.0) * self.colliders.loads.taken[row][a]",
        ("floating_box",),
    ),
    Plant(
        "a torque with the wrong sign",
        "boundaries/loads.py",
        "load[2] = arm[0] * impulse[1] - arm[1] * impulse[0]",
        "load[2] = arm[1] * impulse[0] - arm[0] * impulse[1]",
        ("floating_box",),
    ),
    Plant(
        "rigid bodies meet nodes as fast as they were",
        "boundaries/rigid_bodies.py",
        "self.rate[b, a] = self.rate[b, a] + self.ways[b, a, k] * found",
        "self.rate[b, a] = self.rate[b, a] + 0.0 * self.ways[b, a, k] * found",
        ("floating_box",),
    ),
)


def judge(package: Path, case: str) -> str:
    """Validate a case at its coarse level with the package in a directory; return what is off, "" if nothing is."""
    done = subprocess.run(
        [sys.executable, "-m", "mpmcli", "validate", case, "--levels", "coarse", "--workers", "1", "--json"],
        capture_output=True,
        text=True,
        timeout=600,
        cwd=package,
        env={**os.environ, "PYTHONPATH": str(package)},
    )
    assert done.returncode in (0, 1), done.stderr
    (verdict,) = json.loads(done.stdout)["cases"]
    # A run may become unstable or give no number; any other failure would be a plant that does not even compile.
    for run in verdict["runs"]:
        assert run["status"] in ("finished", "unstable") or "came to its end" in run["message"], run["message"]
    assert (verdict["verdict"] == "pass") == (done.returncode == 0)
    return "; ".join(verdict["reasons"])


def planted(plant: Plant, directory: Path) -> Path:
    """Copy the package to a directory, and plant an error in the copy."""
    shutil.copytree(ROOT / "mpmcli", directory / "mpmcli", ignore=shutil.ignore_patterns("__pycache__"))
    file = directory / "mpmcli" / plant.file
    file.write_text(file.read_text(encoding="utf-8").replace(plant.right, plant.wrong), encoding="utf-8")
    return directory


@pytest.fixture(scope="module")
def unplanted() -> Callable[[str], str]:
    """Return `judge` of this package as it is, once for each case."""
    return cache(lambda case: judge(ROOT, case))


@pytest.mark.parametrize("plant", PLANTS, ids=str)
def test_a_plant_finds_its_place(plant: Plant) -> None:
    """Where the source has changed, nothing would be planted, and nothing caught; nor by a case that is gone."""
    text = (ROOT / "mpmcli" / plant.file).read_text(encoding="utf-8")
    assert text.count(plant.right) == 1
    assert plant.wrong != plant.right
    assert plant.cases and set(plant.cases) <= set(all_cases())


def test_there_are_enough_plants() -> None:
    assert len(PLANTS) >= FEWEST


@pytest.mark.slow
@pytest.mark.parametrize("plant", PLANTS, ids=str)
def test_a_planted_error_is_caught(
    plant: Plant, tmp_path: Path, unplanted: Callable[[str], str], record_property: Callable
) -> None:
    """The first of its cases, which passes as the package is, fails with the error in it, or another one does."""
    package = planted(plant, tmp_path)
    for name in plant.cases:
        assert unplanted(name) == "", name
        said = judge(package, name)
        record_property(name, said)
        if said:
            return
    pytest.fail(f"{plant.name}: not caught by {', '.join(plant.cases)}")
