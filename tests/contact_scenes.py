"""Scenes of elastic bodies that separate, for the tests of contact."""

from scenes import block, scene_of, solid

from mpmcli.scene import Scene

E, NU, DENSITY, H = 1e5, 0.3, 1000.0, 0.05
MU, LAMBDA = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
G = 9.81
SEPARATE = {"default": "separate", "friction": 0.3}


def jelly(**more: object) -> dict:
    """Return a material."""
    return solid(E, density=DENSITY, poissons_ratio=NU) | more


def body(name: str, low: list[float], high: list[float], **more: object) -> dict:
    """Return a box of jelly; coordinates in cells."""
    return block(name, jelly(), [H * x for x in low], [H * x for x in high]) | more


def scene(bodies: list[dict], friction: float = 0.0, end: float = 1.0, frames: int = 1, **tables: object) -> Scene:
    """Return bodies that separate, away from the faces of a domain of up to 64 x 32 cells whose floor sticks."""
    domain = {"size": [64 * H, 32 * H], "spacing": H, "walls": {"default": "separate", "y_min": "stick"}}
    return scene_of(
        *bodies,
        domain=domain | {"gravity": ["0*t", "0*t"]} | tables.pop("domain", {}),
        contact=tables.pop("contact", {"default": "separate", "friction": friction}),
        **{"end": end, "frames": frames, "precision": "f64"} | tables,
    )
