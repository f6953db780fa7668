"""What bodies do to each other where they meet, as a scene says it."""

from typing import Literal

from pydantic import Field

from mpmcli.scene.material import MaterialParameters
from mpmcli.scene.quantity import NotNegative, Table


class ContactPair(Table):
    """What two bodies do to each other where they meet, whatever others do."""

    between: tuple[str, str] = Field(description="Names of the two bodies.")
    friction: NotNegative | Literal["stick"] = Field(
        description='Coefficient of Coulomb friction between them, so that they separate; "stick": they do not.'
    )


class Contact(Table):
    """What bodies do to each other where they meet."""

    default: Literal["stick", "separate"] = Field(
        "stick",
        description='"stick": bodies share one velocity field, meet up to two cells before they touch, and do not '
        'slide. "separate": each elastic body has a velocity field of its own; they meet each other, and walls and '
        "colliders that separate, where their surfaces are, slide with friction, and part. Liquids, grains and bodies "
        "that yield stick to all others.",
    )
    friction: NotNegative | None = Field(
        None, description="Coefficient of Coulomb friction. Default: the softer body's, `surface_friction`."
    )
    pairs: tuple[ContactPair, ...] = Field((), description="Pairs of bodies that do something else.")

    def friction_of(self, *materials: MaterialParameters) -> float:
        """Return the coefficient of friction of two elastic materials that separate."""
        if self.friction is not None:
            return self.friction
        # Of equal ones the lower; a law of a plugin may have none.
        return min((own.shear_modulus, getattr(own, "surface_friction", 0.0)) for own in materials)[1]
