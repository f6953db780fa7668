"""The column of a law, which lands, shears and collapses: every law takes the same steps from the same start."""

from mpmcli.bench.cases import BenchCase
from mpmcli.errors import RunError
from mpmcli.materials.registry import laws
from mpmcli.scene.material import Knob, MaterialParameters

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
COLUMN_CASES = (
    BenchCase(dimension=2, cells=128, particles=36_864, step=4e-5),
    BenchCase(dimension=3, cells=64, particles=65_536, step=1e-4),
)
# Start of the measured interval, s. The wave of the impact, at about 25 m/s, is then inside the column, which leans and
# spreads; nothing is at rest.
SETTLING = 0.05


def material_of(model: type[MaterialParameters]) -> dict[str, object]:
    """Return the material of a law: VALUES, then knobs, then defaults; RunError: a parameter has none of them."""
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


def column_of(law: str, case: BenchCase, precision: str) -> dict:
    """Return the column as a scene; RunError: there is no such law."""
    if law not in laws():
        raise RunError(f"There is no law {law}.")
    d, edges = case.dimension, EDGES[case.dimension]
    lower = [CLEARANCE if axis == 1 else (1 - edge) / 2 for axis, edge in enumerate(edges)]
    body = {
        "name": law,
        "material": material_of(laws()[law].parameters),
        "shape": {"box": {"min": lower, "max": [c + s for c, s in zip(lower, edges, strict=True)]}},
        "velocity": [0.0, -SPEED, 0.0][:d],
        "velocity_gradient": [[SHEAR if (row, column) == (0, 1) else 0.0 for column in range(d)] for row in range(d)],
        "particles_per_cell": 2**d,
    }
    return case.scene(f"Column of {law}", [body], GRAVITY, precision=precision)
