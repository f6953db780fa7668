"""The appearance of materials: distinguishable colours, and a finish that selects the shading."""

import math
from dataclasses import dataclass
from typing import Any, Literal

from mpmcli.scene.presets import PRESETS

# Kinds of shading: clear and thin, clear and thick, scattering inside, white crumbs, loose grains, bare metal, dull.
Finish = Literal["water", "syrup", "translucent", "crumbly", "grains", "metal", "matte"]


@dataclass(frozen=True)
class Appearance:
    """The appearance of one material.

    Attributes:
        name: of the preset that it is nearest to, or of its law.
        color: "#rrggbb" of the lit surface.
        ink: "#rrggbb" of dots and legends: distinguishable from every other on a light and on a dark background.
        finish: kind of shading.
        liquid: whether it flows as one body, so that dots hide what it is.
    """

    name: str
    color: str
    ink: str
    finish: Finish
    liquid: bool = False


APPEARANCES = {
    "water": Appearance("water", "#3b8fd4", "#2f7fd0", "water", liquid=True),
    "honey": Appearance("honey", "#e8960c", "#e88a00", "syrup", liquid=True),
    "lava": Appearance("lava", "#c8321a", "#d62f1f", "syrup", liquid=True),
    "mud": Appearance("mud", "#74543a", "#8a5a33", "matte", liquid=True),
    "jelly": Appearance("jelly", "#58b84c", "#3fa34d", "translucent"),
    "rubber": Appearance("rubber", "#5a4a8a", "#7a5fc0", "matte"),
    "snow": Appearance("snow", "#f2f6fb", "#8fb8dc", "crumbly"),
    "sand": Appearance("sand", "#d9b56d", "#c9a040", "grains"),
    "clay": Appearance("clay", "#b8694a", "#c4704e", "matte"),
    "metal": Appearance("metal", "#a4acb6", "#8a95a3", "metal"),
}
# Laws without a preset, in the order in which they come.
OTHERS = ("#0f9d8a", "#c2569b", "#7d8a2e", "#4e6fb8", "#b0563c")
# Upper bound of the ratio of two values of a parameter in the distance between materials.
FAR = 1e6


def appearance_of(law: str, parameters: dict[str, Any], others: int = 0) -> Appearance:
    """Return the appearance of the nearest preset: among those of the law and of laws with the same parameters.

    Args:
        parameters: those of the effective scene.
        others: how many laws without a preset came before.
    """
    names = parameters.keys() - {"law"}
    known = {
        name: preset
        for name, preset in PRESETS.items()
        if name in APPEARANCES and (preset.law == law or preset.parameters.keys() == names)
    }
    if not known:
        color = OTHERS[others % len(OTHERS)]
        return Appearance(law, color, color, "matte")
    nearest = min(known, key=lambda name: _distance(known[name].parameters, parameters))
    return APPEARANCES[nearest]


def _distance(preset: dict[str, Any], parameters: dict[str, Any]) -> float:
    """Return how far apart two sets of parameters are: the sum of the squared logarithms of their ratios."""
    total = 0.0
    for name, wanted in preset.items():
        given = parameters.get(name)
        if any(isinstance(value, bool) or not isinstance(value, int | float) for value in (wanted, given)):
            continue
        if wanted <= 0.0:
            continue
        total += min(abs(math.log(max(given, wanted / FAR) / wanted)), math.log(FAR)) ** 2
    return total
