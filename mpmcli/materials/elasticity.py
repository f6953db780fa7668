"""Elastic constants: the parameters shared by laws with an isotropic elastic part (docs/theory.md, 5.1)."""

from typing import Annotated

from pydantic import Field

from mpmcli.scene.knobs import Knob
from mpmcli.scene.material import MaterialParameters
from mpmcli.scene.quantity import Positive

PoissonsRatio = Annotated[
    float, Field(gt=-1, lt=0.5, description="Poisson's ratio, between -1 and 0.5, both excluded.")
]


def shear_modulus(youngs_modulus: float, poissons_ratio: float) -> float:
    """Return mu = E / (2 (1 + nu)), Pa."""
    return youngs_modulus / (2 * (1 + poissons_ratio))


def lame_lambda(youngs_modulus: float, poissons_ratio: float) -> float:
    """Return lambda = E nu / ((1 + nu)(1 - 2 nu)), Pa."""
    return youngs_modulus * poissons_ratio / ((1 + poissons_ratio) * (1 - 2 * poissons_ratio))


class ElasticParameters(MaterialParameters):
    """Parameters of a material with an isotropic elastic part."""

    youngs_modulus: Annotated[
        Positive,
        Field(description="Young's modulus E, Pa."),
        Knob("springiness", 1e3, 1e7, "0 is soft jelly, 0.3 firm jelly, 0.75 rubber, 1 hard rubber"),
    ]
    poissons_ratio: PoissonsRatio = 0.3

    @property
    def shear_modulus(self) -> float:
        """mu, Pa."""
        return shear_modulus(self.youngs_modulus, self.poissons_ratio)

    @property
    def lame_lambda(self) -> float:
        """lambda, Pa."""
        return lame_lambda(self.youngs_modulus, self.poissons_ratio)
