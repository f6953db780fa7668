"""Moduli that are "auto" follow what can reach a body, and nothing that only stands in its scene."""

import pytest
from scenes import block, box, scene_of

METAL = {"law": "neo_hookean", "density": 8000.0, "youngs_modulus": 1e9}
WATER = {"law": "fluid", "density": 1000.0}


def modulus(*others: dict, gravity: tuple[float, float] = (0.0, -9.81), law: str = "sand", **scene: object) -> float:
    """Return the modulus of a column beside others, of metal unless they say of what."""
    own = {"law": "sand", "density": 1500.0, "friction_angle": 30.0} if law == "sand" else WATER
    bodies = [block("column", own, [0.0, 0.0], [0.4, 0.4])]
    bodies += [{"name": f"other{i}", "material": METAL} | other for i, other in enumerate(others)]
    domain = {"size": [2.0, 2.0], "spacing": 0.05, "gravity": list(gravity)}
    material = scene_of(*bodies, domain=domain, frames=2, **scene).bodies[0].material
    return material.youngs_modulus if law == "sand" else material.bulk_modulus


STANDING = {"shape": box([1.0, 0.0], [1.2, 1.0])}


@pytest.mark.parametrize("law", ["sand", "fluid"])
def test_what_stands_at_rest_changes_no_modulus(law: str) -> None:
    """However tall, dense and stiff it is, whether it stands apart, touches or lies within, and without gravity."""
    for gravity in ((0.0, -9.81), (3.0, 0.0), (0.0, 0.0)):
        low = [1.8, 0.5] if gravity[0] else [1.0, 0.0]
        standing = {"shape": box(low, [2.0, 1.5])}
        assert modulus(standing, gravity=gravity, law=law) == modulus(gravity=gravity, law=law)
    assert modulus({"shape": box([0.4, 0.0], [0.6, 1.9])}, law=law) == modulus(law=law)
    # What lies under it by less than a cell is not a drop.
    assert modulus({"shape": box([1.0, 0.04], [1.2, 1.0])}, law=law) == modulus(law=law)


@pytest.mark.parametrize(
    "other",
    [
        {"shape": box([1.0, 0.5], [1.2, 1.0])},
        {"shape": box([0.1, 0.5], [0.3, 0.7])},
        STANDING | {"velocity": [-1.0, 0.0]},
        STANDING | {"material": WATER},
    ],
    ids=["falls", "rests on it", "moves", "flows"],
)
def test_what_can_reach_a_body_counts(other: dict) -> None:
    assert modulus(other) > modulus()


def test_what_is_pushed_can_reach_a_body() -> None:
    force = {"acceleration": [-3.0, 0.0]}
    assert modulus(STANDING, forces=[force | {"body": "other0"}]) > modulus(STANDING)
    # A force on the column alone does not make the metal move.
    assert modulus(STANDING, forces=[force | {"body": "column"}]) == modulus(forces=[force])
    # On a slope, and where gravity turns, what stands does not stay.
    assert modulus(STANDING, gravity=(-3.0, -9.0)) > modulus(gravity=(-3.0, -9.0))
    assert modulus(STANDING, gravity=("5 * sin(t)", -9.81)) > modulus(gravity=("5 * sin(t)", -9.81))
