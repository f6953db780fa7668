"""The scenes of a soak, small ones of every kind, and the laws that each must obey."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from mpmcli.materials.registry import parameter_models
from mpmcli.scene import LoadedScene, parse_scene

SOFT = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 2e5, "viscosity": 0.001}
SAND = {"law": "sand", "density": 1600.0, "youngs_modulus": 1e6, "poissons_ratio": 0.3, "friction_angle": 30.0}
# rad/s; the stirrer turns at this rate.
TURNING = 3.0
STIRRER = {"min": [0.45, 0.1], "max": [0.55, 0.4]}


@dataclass(frozen=True)
class SoakScene:
    """A scene of the soak.

    Attributes:
        name: of a few words.
        loaded: the scene.
        energy: "passive" where energy only falls, "driven" where a turning collider does work, "" where it enters and
            leaves with particles.
        rest: largest speed of a particle in the last quarter, m/s; None where the scene moves.
        stored: whether it is computed by `simulate`, which stores it; by a `Runner` otherwise.
    """

    name: str
    loaded: LoadedScene
    energy: Literal["passive", "driven", ""]
    rest: float | None = None
    stored: bool = False


def soak_scenes(times: float = 1.0) -> list[SoakScene]:
    """Return the scenes; each ends at `times` its usual end."""
    return [
        _scene(
            "water at rest 2D",
            times,
            [1.0, 0.6],
            0.05,
            [_water([0.0, 0.0], [1.0, 0.4], initial_pressure="hydrostatic")],
            60.0,
            rest=1e-3,
        ),
        _scene("sand at rest 2D", times, [1.0, 0.6], 0.05, [_resting_sand()], 40.0, rest=1e-3),
        _scene(
            "water at rest 3D",
            times,
            [0.6, 0.6, 0.6],
            0.1,
            [_water([0.0] * 3, [0.6, 0.6, 0.4], initial_pressure="hydrostatic")],
            30.0,
            rest=1e-3,
        ),
        _scene("ball bounces 2D", times, [1.0, 1.5], 0.05, [_ball([0.5, 0.8], 0.2)], 6.0, stored=True),
        _scene("balls meet 3D", times, [1.2, 0.8, 0.8], 0.1, _meeting(), 2.0, gravity=False),
        _scene(
            "stirred water 2D",
            times,
            [1.0, 0.8],
            0.05,
            [_water([0.0, 0.0], [1.0, 0.5], subtract=[{"box": STIRRER}])],
            4.0,
            "driven",
            stored=True,
            colliders=[
                {
                    "name": "stirrer",
                    "shape": {"box": STIRRER},
                    "angular_velocity": TURNING,
                    "pivot": [0.5, 0.25],
                }
            ],
        ),
        _scene("fountain 2D", times, [2.0, 1.4], 0.05, [_water([0.5, 0.0], [1.7, 0.1])], 1.5, "", emits=True),
        _scene(
            "shear wave in a periodic box 2D",
            times,
            [1.0, 1.0],
            0.05,
            [_water([0.0, 0.0], [1.0, 1.0]) | {"velocity": ["0.3*sin(2*pi*Y)", "0.3*sin(2*pi*X)"]}],
            2.0,
            gravity=False,
            walls="periodic",
            precision="f64",
            stored=True,
        ),
    ]


def _scene(
    name: str,
    times: float,
    size: list[float],
    spacing: float,
    bodies: list[dict],
    end: float,
    energy: Literal["passive", "driven", ""] = "passive",
    *,
    rest: float | None = None,
    stored: bool = False,
    gravity: bool = True,
    walls: object = "slip",
    precision: str = "f32",
    colliders: list[dict] | None = None,
    emits: bool = False,
) -> SoakScene:
    d = len(size)
    data = {
        "domain": {"size": size, "spacing": spacing, "walls": walls},
        "time": {"end": end * times, "frames": max(4, round(20 * times))},
        "solver": {"precision": precision},
        "bodies": bodies,
    }
    if gravity:
        data["domain"]["gravity"] = [0.0] * (d - 1) + [-9.81] if d == 3 else [0.0, -9.81]
    if colliders:
        data["colliders"] = colliders
    if emits:
        data["domain"]["walls"] = {"default": "open", "y_min": "slip"}
        jet = {"center": [0.4, 0.25], "radius": 0.1}
        data["emitters"] = [{"name": "jet", "material": WATER, "shape": {"ball": jet}, "velocity": [1.0, 3.0]}]
    return SoakScene(name, parse_scene(data, laws=parameter_models(), source=name), energy, rest, stored)


def _box(
    name: str, material: dict, low: list[float], high: list[float], subtract: Sequence[dict] = (), **more: object
) -> dict:
    shape = {"box": {"min": low, "max": high}}
    if subtract:
        shape["subtract"] = list(subtract)
    return {"name": name, "material": material, "shape": shape, **more}


def _water(low: list[float], high: list[float], **more: object) -> dict:
    return _box("water", WATER, low, high, **more)


def _resting_sand() -> dict:
    # Held by its walls, it carries its weight by the modulus of compression without lateral strain.
    E, nu = SAND["youngs_modulus"], SAND["poissons_ratio"]
    modulus = E * (1 - nu) / (1 + nu) / (1 - 2 * nu)
    stretch = f"exp(-{SAND['density'] * 9.81 / modulus!r} * (0.4 - Y))"
    return _box("sand", SAND, [0.0, 0.0], [1.0, 0.4], deformation=[[1.0, 0.0], [0.0, stretch]])


def _ball(center: list[float], radius: float) -> dict:
    return {"name": "ball", "material": SOFT, "shape": {"ball": {"center": center, "radius": radius}}}


def _meeting() -> list[dict]:
    left, right = _ball([0.35, 0.4, 0.4], 0.2), _ball([0.85, 0.45, 0.4], 0.2)
    return [left | {"velocity": [1.0, 0.0, 0.0]}, right | {"name": "other", "velocity": [-1.0, 0.0, 0.0]}]
