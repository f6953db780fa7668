"""Materials by the name of the thing: a law and its parameters in SI units, each with its source."""

from dataclasses import dataclass
from typing import Literal, NamedTuple


class Value(NamedTuple):
    """A parameter of a preset, and where its value comes from."""

    value: float | bool | Literal["auto"]
    source: str


@dataclass(frozen=True)
class Preset:
    """One material.

    Attributes:
        law: name of the law that it follows.
        shows: what it looks like when it moves, in one line.
        values: its parameters; what is not here has the law's default.
    """

    law: str
    shows: str
    values: dict[str, Value]

    @property
    def parameters(self) -> dict[str, float | bool | Literal["auto"]]:
        """Return the parameters without their sources."""
        return {name: value for name, (value, _) in self.values.items()}


_SOFT_FLUID = Value(
    "auto", "softened: the real fluid, of 2e9 Pa and more, flows alike at these speeds and takes far more steps"
)
_SOFT_SOLID = "softened: nearly incompressible in truth (0.4995 or more), which takes more steps and looks alike"
_STOMAKHIN = "Stomakhin et al. 2013, A material point method for snow simulation: their basic snow"
_OBRIEN = (
    "O'Brien and Julien 1988, Laboratory analysis of mudflow properties: rounded from their Bingham fits for "
    "natural mud with about 35 % of sediment by volume"
)
_ALUMINIUM = "aluminium 1100-O: ASM Handbook, vol. 2, and the Aluminum Association's typical values"

PRESETS: dict[str, Preset] = {
    "water": Preset(
        "fluid",
        "splashes, runs out thin, and takes the shape of its vessel at once",
        {
            "density": Value(1000.0, "CRC Handbook of Chemistry and Physics, at 4 degrees C (998 at 20 degrees C)"),
            "viscosity": Value(1.0e-3, "CRC Handbook of Chemistry and Physics, at 20 degrees C"),
            "bulk_modulus": _SOFT_FLUID,
        },
    ),
    "honey": Preset(
        "fluid",
        "pours in a rope that coils and folds where it lands, and levels in seconds",
        {
            "density": Value(1420.0, "White 1975, in Crane (ed.), Honey: a comprehensive survey; 17 % of water"),
            "viscosity": Value(
                10.0, "White 1975, in Crane (ed.), Honey: a comprehensive survey; 17 % of water, 20 to 25 degrees C"
            ),
            "bulk_modulus": _SOFT_FLUID,
        },
    ),
    "lava": Preset(
        "viscoplastic",
        "creeps downhill, slower as it thins, and stops with a steep front on a slope that water would run off",
        {
            "density": Value(
                2600.0, "basalt with few bubbles: Murase and McBirney 1973, Properties of some igneous rocks"
            ),
            "yield_stress": Value(
                1.0e3, "Hulme 1974, The interpretation of lava flow morphology: the fluid end of basalt flows"
            ),
            "consistency": Value(
                700.0, "Shaw et al. 1968, The viscosity of basaltic magma: Makaopuhi lava lake, near 1130 degrees C"
            ),
            "bulk_modulus": _SOFT_FLUID,
            "shear_modulus": Value("auto", "softened: below yield it only has to stand still"),
        },
    ),
    "mud": Preset(
        "viscoplastic",
        "slumps and spreads quickly, and comes to rest as a low heap",
        {
            "density": Value(1600.0, "35 % by volume of sediment of 2650 kg/m^3 in water"),
            "yield_stress": Value(100.0, _OBRIEN),
            "consistency": Value(10.0, _OBRIEN),
            "bulk_modulus": _SOFT_FLUID,
            "shear_modulus": Value("auto", "softened: below yield it only has to stand still"),
        },
    ),
    "jelly": Preset(
        "fixed_corotated",
        "wobbles and quivers, flattens deeply where it lands, and springs back",
        {
            "density": Value(1020.0, "one part of gelatine (1350 kg/m^3) to ten of water, by mass"),
            "youngs_modulus": Value(
                1.5e4,
                "Bonavia 2025, Viscoelastic material properties of gelatin with varying water to collagen mass "
                "ratios: their power law at one part to ten",
            ),
            "poissons_ratio": Value(0.45, _SOFT_SOLID),
        },
    ),
    "rubber": Preset(
        "neo_hookean",
        "bounces high, hardly dented, and rings on",
        {
            "density": Value(950.0, "vulcanised natural rubber: Brandrup and Immergut, Polymer handbook"),
            "youngs_modulus": Value(
                1.2e6, "Treloar 1975, The physics of rubber elasticity: 3 times a shear modulus of 0.39 MPa"
            ),
            "poissons_ratio": Value(0.47, _SOFT_SOLID),
        },
    ),
    "snow": Preset(
        "snow",
        "packs where it is pressed, cracks where it is pulled, and bursts into clods on a wall",
        {
            "density": Value(400.0, _STOMAKHIN),
            "youngs_modulus": Value(1.4e5, _STOMAKHIN),
            "poissons_ratio": Value(0.2, _STOMAKHIN),
            "critical_compression": Value(2.5e-2, _STOMAKHIN),
            "critical_stretch": Value(7.5e-3, _STOMAKHIN),
            "hardening": Value(10.0, _STOMAKHIN),
        },
    ),
    "sand": Preset(
        "sand",
        "runs like a fluid while it moves, and rests as a heap with sloping sides",
        {
            "density": Value(1600.0, "Lambe and Whitman 1969, Soil mechanics: dry sand, medium dense"),
            "friction_angle": Value(
                35.0, "Lambe and Whitman 1969, Soil mechanics: well-graded sand, medium dense (34 to 40)"
            ),
            "youngs_modulus": Value(
                "auto", "softened: real sand, of about 1e7 Pa and more, flows alike, as friction alone resists"
            ),
            "poissons_ratio": Value(
                0.3, "Bowles 1996, Foundation analysis and design: usual values for sand are 0.3 to 0.4"
            ),
        },
    ),
    "clay": Preset(
        "von_mises",
        "keeps the dent of every blow, and sags where it is loaded too much",
        {
            "density": Value(
                1800.0, "Terzaghi and Peck 1967, Soil mechanics in engineering practice: soft clay, saturated"
            ),
            "yield_stress": Value(
                5.0e4,
                "Terzaghi and Peck 1967, Soil mechanics in engineering practice: sqrt(3) times a shear strength of "
                "29 kPa, clay of medium consistency (25 to 50 kPa)",
            ),
            "youngs_modulus": Value("auto", "softened where the scene allows it; 200 times the yield stress at least"),
            "poissons_ratio": Value(0.4, "softened: undrained clay keeps its volume (0.5)"),
        },
    ),
    "metal": Preset(
        "von_mises",
        "stands like rock below its yield stress, and is forged above it: soft aluminium",
        {
            "density": Value(2710.0, _ALUMINIUM),
            "yield_stress": Value(3.4e7, _ALUMINIUM),
            "hardening_modulus": Value(
                3.5e8, f"{_ALUMINIUM}: from yield to the tensile strength, 90 MPa at 25 %, in true stress and strain"
            ),
            "youngs_modulus": Value("auto", "softened from 6.9e10 Pa; 200 times the yield stress at least"),
            "poissons_ratio": Value(0.33, _ALUMINIUM),
        },
    ),
}
