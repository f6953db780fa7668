"""The column in which the cost of a law is measured: it lands, shears and collapses."""

from collections.abc import Sequence

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.ours import Ours
from mpmcli.errors import RunError
from mpmcli.materials.registry import laws
from mpmcli.scene.knobs import Knob
from mpmcli.scene.material import MaterialParameters

# Parameters by the names that laws share, so that a new law needs no entry: one density, one stiffness, and strengths
# well below the stress of the weight (up to 7 kPa) and of the impact (about 20 kPa), so that plastic laws flow.
# Other parameters are those at the middle of their knobs.
VALUES = {
    "density": 1000.0,
    "youngs_modulus": 4e5,
    "poissons_ratio": 0.3,
    "bulk_modulus": 4e5,
    "yield_stress": 1e3,
    "consistency": 10.0,
    "friction_angle": 35.0,
}
GRAVITY = 9.81
# At the start: downward, m/s, so that the column lands within 30 ms, and dv_x/dy, 1/s.
SPEED = 1.0
SHEAR = 10.0
# Edges of the column and its height above the floor, in a unit box.
EDGES = {2: (0.75, 0.75), 3: (0.25, 0.5, 0.25)}
CLEARANCE = 1 / 32

# A fifth or less of the step that the stiffness at rest allows leaves room for hardening and impact. The particles are
# 4 (2D) and 8 (3D) per cell, as scenes have by default.
MATERIAL_CASES = (
    BenchCase(dimension=2, cells=128, particles=36_864, step=4e-5),
    BenchCase(dimension=3, cells=64, particles=65_536, step=1e-4),
)
# The cheapest pair, for which the overhead of a second law is largest, and two typical ones.
MIXES = (("fluid", "neo_hookean"), ("fluid", "sand"), ("neo_hookean", "snow"))
# Start and duration of the measured interval, s. The wave of the impact, at about 25 m/s, is then inside the column,
# which leans and spreads; nothing is at rest.
SETTLING = 0.05
STRETCH = 0.01


def steps_of(case: BenchCase) -> tuple[int, int]:
    """Return the number of steps before the measured interval, and in it."""
    return round(SETTLING / case.step), round(STRETCH / case.step)


def material_of(model: type[MaterialParameters]) -> dict[str, object]:
    """Return the material of a law, as a table of a scene: VALUES, then knobs, then defaults.

    Raises:
        RunError: the law needs a parameter that has neither a value here nor a knob.
    """
    law = model.model_fields["law"].default
    material: dict[str, object] = {"law": law}
    for name, field in model.model_fields.items():
        if name in VALUES:
            material[name] = VALUES[name]
        elif field.is_required() and name != "law":
            knob = next((entry for entry in field.metadata if isinstance(entry, Knob)), None)
            if knob is None:
                raise RunError(f'The law "{law}" needs {name}, which has no knob and no value in the benchmark.')
            material[name] = knob.value(0.5)
    return material


def scene_of(names: Sequence[str], case: BenchCase, precision: str) -> dict:
    """Return the column as the dictionary of a scene file.

    Slices of equal size stand side by side, one for each law; the place of an empty name stays empty.
    """
    d, edges = case.dimension, EDGES[case.dimension]
    lower = [CLEARANCE if axis == 1 else (1 - edge) / 2 for axis, edge in enumerate(edges)]
    shear = [[SHEAR if (row, column) == (0, 1) else 0.0 for column in range(d)] for row in range(d)]
    slices = []
    for index, name in enumerate(names):
        if not name:
            continue
        first = lower[0] + edges[0] * index / len(names)
        size = (edges[0] / len(names), *edges[1:])
        corner = [first, *lower[1:]]
        slices.append(
            {
                "name": name,
                "material": material_of(laws()[name].parameters),
                "shape": {"box": {"min": corner, "max": [c + s for c, s in zip(corner, size, strict=True)]}},
                "velocity": [0.0, -SPEED, 0.0][:d],
                "velocity_gradient": shear,
                "particles_per_cell": 2**d,
            }
        )
    return {
        "title": f"Column of {' and '.join(filter(None, names))}, {case.name}",
        "domain": {
            "size": [1.0] * d,
            "cells": [case.cells] * d,
            "gravity": [0.0, -GRAVITY, 0.0][:d],
            "walls": "separate",
        },
        "time": {"end": 1.0, "frames": 1, "step": case.step},
        "bodies": slices,
        "solver": {"precision": precision},
    }


class Column(Ours):
    """The solver on the column of one or more laws.

    The column starts with a shear just above the floor, lands, leans and spreads; SETTLING later most particles of
    a plastic law flow (`flowing` returns their share). Every block takes the same steps from the same state: `keep`
    saves the state, `rewind` restores it.
    """

    def __init__(self, names: Sequence[str], case: BenchCase, *, threads: int, precision: str, arch: str) -> None:
        if unknown := set(names) - {"", *laws()}:
            raise RunError(f"There is no law {min(unknown)}.")
        data = scene_of(names, case, precision)
        super().__init__(data, case.step, threads=threads, precision=precision, arch=arch)
        self._kept = self.engine.state.save()

    def keep(self) -> None:
        """Save the state of the run."""
        self._kept = self.engine.state.save()

    def rewind(self) -> None:
        """Restore the saved state, and take one step that is not measured."""
        self.engine.state.load(self._kept)
        self.advance(1)
        self.sync()

    def flowing(self) -> float:
        """Return the share of particles that the next step projects: those in plastic flow, or torn."""
        from mpmcli.solver.observe import build_observation
        from mpmcli.solver.snapshot import read_group

        count = 0
        for group in self.engine.groups:
            found = read_group(group)
            stored = found.deformation, found.internal
            seen = build_observation(group)(self.engine.last_step, 0, group.count, stress=False, stored=stored)
            count += int((seen.deformation != found.deformation).reshape(group.count, -1).any(axis=1).sum())
        return count / self.particles
