"""The colours of the surface of a liquid: transmission, reflection and scattering."""

from dataclasses import dataclass

import numpy as np

from mpmcli.render.appearance import Appearance, Finish
from mpmcli.render.theme import Theme, rgb

# Reflectance of water at normal incidence: ((n - 1) / (n + 1))^2, n = 1.33.
HEAD_ON = 0.02
# A skin of this thickness, in lengths of the scene, is added to every liquid: a film of it is seen.
SKIN = 0.05
# Light that comes from behind is lost at the rim, where it would leave at a grazing angle.
RIM = 0.35


@dataclass(frozen=True)
class Optics:
    """Optical properties of a liquid.

    Attributes:
        depths: optical depths (natural logarithms) that the deepest colour loses over the length of the scene.
        milk: those that it scatters back, in all colours alike.
        body: share of the light that what is scattered gives back.
        deepening: power of the share let through by which what is scattered deepens, its own way being as coloured.
        gloss: how strong highlights are; sharpness: the exponent of the highlight.
        reflection: share of the mirror image that is kept; 0 is dull.
        bend: how far what lies behind is shifted, in parts of the thickness.
        glow: light of its own, in parts of full white.
    """

    depths: float
    milk: float
    body: float
    deepening: float
    gloss: float
    sharpness: float
    reflection: float
    bend: float
    glow: float = 0.0


FINISHES: dict[Finish, Optics] = {
    "water": Optics(
        depths=6.0, milk=0.4, body=0.6, deepening=0.12, gloss=1.6, sharpness=260.0, reflection=1.0, bend=0.06
    ),
    "syrup": Optics(
        depths=32.0, milk=1.0, body=0.88, deepening=0.2, gloss=1.0, sharpness=160.0, reflection=0.9, bend=0.06
    ),
    "matte": Optics(
        depths=200.0, milk=400.0, body=0.9, deepening=0.0, gloss=0.10, sharpness=18.0, reflection=0.15, bend=0.0
    ),
}
LAVA = Optics(
    depths=200.0, milk=400.0, body=0.35, deepening=0.0, gloss=0.15, sharpness=30.0, reflection=0.2, bend=0.0, glow=1.0
)


def optics_of(appearance: Appearance) -> Optics:
    """Return the optical properties of a material."""
    if appearance.name.startswith("lava"):
        return LAVA
    return FINISHES.get(appearance.finish, FINISHES["matte"])


def linear(color: np.ndarray) -> np.ndarray:
    """Return displayed values from 0 to 1 as amounts of light."""
    return np.asarray(color, np.float32) ** np.float32(2.2)


def displayed(light: np.ndarray) -> np.ndarray:
    """Return amounts of light as displayed values from 0 to 1."""
    return np.clip(light, 0, 1) ** np.float32(1 / 2.2)


@dataclass(frozen=True)
class Lights:
    """What lights a scene: a lamp, a sky and the floor, in amounts of light.

    Attributes:
        lamp: direction to it (3,), a unit vector, in camera axes, as all directions here.
        up: direction (3,).
        zenith, horizon, floor: colours (3,) around.
        strength: of the lamp; ambient: of what comes from all sides.
    """

    lamp: np.ndarray
    up: np.ndarray
    zenith: np.ndarray
    horizon: np.ndarray
    floor: np.ndarray
    strength: float
    ambient: float

    def around(self, direction: np.ndarray) -> np.ndarray:
        """Return what is seen in directions (..., 3): floor, horizon, sky, and the lamp as a large soft box."""
        rise = (direction @ self.up)[..., None]
        high = np.clip(rise, 0, 1) ** np.float32(0.6)
        low = _step(rise, -0.35, 0.02)
        sky = self.horizon + (self.zenith - self.horizon) * high
        box = _step((direction @ self.lamp)[..., None], 0.72, 0.97)
        return self.floor + (sky - self.floor) * low + np.float32(0.9 * self.strength) * box


def fluid_lights(theme: Theme, lamp: np.ndarray, up: np.ndarray) -> Lights:
    """Return the lights of a theme, for a lamp in a direction."""
    if theme.name == "dark":
        zenith, horizon = np.array([0.10, 0.15, 0.24]), np.array([0.30, 0.36, 0.46])
        return _lights(lamp, up, zenith, horizon, 0.6 * linear(np.array(rgb(theme.floor))), 0.95, 0.36)
    zenith, horizon = np.array([0.25, 0.47, 0.85]), np.array([0.93, 0.96, 1.0])
    return _lights(lamp, up, zenith, horizon, 0.8 * linear(np.array(rgb(theme.floor))), 0.75, 0.45)


def _lights(
    lamp: np.ndarray,
    up: np.ndarray,
    zenith: np.ndarray,
    horizon: np.ndarray,
    floor: np.ndarray,
    strength: float,
    ambient: float,
) -> Lights:
    vectors = [np.asarray(vector, np.float32) for vector in (lamp, up, zenith, horizon, floor)]
    return Lights(*vectors, strength, ambient)


def transmitted(appearance: Appearance, thickness: np.ndarray, length: float) -> np.ndarray:
    """Return the share of light (..., 3) that is left behind a thickness (...), by the law of Beer and Lambert.

    Args:
        thickness: m.
        length: over which the liquid takes what its optics say, m: that of the scene, so that a beaker and a
            reservoir look alike.
    """
    optics = optics_of(appearance)
    loss = -np.log(np.clip(linear(np.array(rgb(appearance.color))), 1e-3, 0.98))
    loss = loss / loss.max() * optics.depths + optics.milk
    return np.exp(-(thickness[..., None] + np.float32(SKIN * length)) * (loss / length).astype(np.float32))


def shaded(
    appearance: Appearance,
    normal: np.ndarray,
    towards: np.ndarray,
    through: np.ndarray,
    behind: np.ndarray,
    hollow: np.ndarray,
    lights: Lights,
) -> np.ndarray:
    """Return the light (n, 3) that comes from n points of a surface.

    Args:
        normal: (n, 3), outwards.
        towards: (n, 3), to the eye; both of length one.
        through: (n, 3) share of light that is let through, of `transmitted`.
        behind: (n, 3) light from what lies behind.
        hollow: (n,) how much the surface is a hollow, from -1 of a ridge to 1 of a crease.
    """
    optics = optics_of(appearance)
    color = linear(np.array(rgb(appearance.color)))
    facing = np.clip(np.einsum("ij,ij->i", normal, towards), 0, 1)[:, None]
    lit = normal @ lights.lamp
    # Light that has been scattered inside wraps around the edges of its shadow.
    wrap = np.float32(0.45 if optics.milk < 100 else 0.1)
    diffuse = lights.strength * np.clip((lit + wrap) / (1 + wrap), 0, 1)
    ambient = lights.ambient * (0.62 + 0.38 * (normal @ lights.up)) * (1 - 0.35 * np.clip(hollow, -1, 1))
    body = np.float32(optics.body) * color * (diffuse + ambient)[:, None]
    if optics.deepening:
        body = body * through ** np.float32(optics.deepening)
    scattered = 1 - through.mean(axis=1, keepdims=True)
    rim = 1 - np.float32(RIM) * (1 - facing) ** 3
    rim *= np.float32(0.92) + np.float32(0.10) * (normal @ lights.up)[:, None]
    inside = behind * through * rim + body * scattered
    if optics.glow:
        inside = inside + np.float32(optics.glow) * glow(facing[:, 0], hollow)
    mirrored = 2 * facing * normal - towards
    fresnel = HEAD_ON + (1 - HEAD_ON) * (1 - facing) ** 5
    fresnel = np.float32(optics.reflection) * np.minimum(fresnel, np.float32(0.5))
    half = lights.lamp + towards
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    highlight = np.clip(np.einsum("ij,ij->i", normal, half), 0, 1) ** np.float32(optics.sharpness)
    spark = np.float32(optics.gloss * lights.strength) * highlight[:, None]
    return inside * (1 - fresnel) + lights.around(mirrored) * fresnel + spark


def glow(facing: np.ndarray, hollow: np.ndarray) -> np.ndarray:
    """Return the light (n, 3) of molten rock: yellow in its creases, red where it faces away and has cooled."""
    heat = np.clip(0.24 + 0.30 * facing**2 + 0.9 * hollow, 0, 1)[:, None]
    return np.concatenate([1.1 * heat, 0.62 * heat**2.4, 0.16 * heat**5], axis=1).astype(np.float32)


def _step(value: np.ndarray, low: float, high: float) -> np.ndarray:
    share = np.clip((value - np.float32(low)) / np.float32(high - low), 0, 1)
    return share * share * (3 - 2 * share)
