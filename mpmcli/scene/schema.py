"""What a scene may say: one frozen model per table, each key with its unit, range and default."""

from functools import lru_cache
from typing import Annotated, Any, Literal, Union, get_args

from pydantic import AfterValidator, Field, create_model

from mpmcli.scene.colliders import Collider
from mpmcli.scene.constants import Constants
from mpmcli.scene.domain import Domain
from mpmcli.scene.emitters import Emitter
from mpmcli.scene.entry import PlaceVector, StartDeformation, StartMatrix, StartVector
from mpmcli.scene.impulses import Impulse
from mpmcli.scene.lattice import ParticlesPerCell
from mpmcli.scene.material import MaterialParameters
from mpmcli.scene.quantity import NAME, Flag, Integer, Positive, Table, flaw
from mpmcli.scene.shapes import OneShape
from mpmcli.scene.solver_settings import SolverSettings

ParticleField = Literal[
    "velocity",
    "density",
    "pressure",
    "volume_ratio",
    "deformation_gradient",
    "affine",
    "stress",
    "mass",
    "initial_position",
]


class Time(Table):
    """How long the scene runs, how often it is stored, and how it is stepped."""

    end: Annotated[Positive, Field(description="Simulated time, s; the scene starts at 0.")]
    frames: Annotated[
        Integer,
        Field(
            ge=1,
            le=10**9,
            description="Number of equal intervals between stored frames; one frame more is stored.",
        ),
    ]
    step: Annotated[
        Positive | Literal["auto"],
        Field(description='Largest time step, s; "auto" leaves it to the stability limits alone.'),
    ] = "auto"
    safety: Annotated[
        float,
        Field(
            strict=True,
            gt=0,
            le=1,
            description="Fraction of the smallest stability limit that a step takes, 0 to 1.",
        ),
        # At 0.9 a lone droplet that bounces along a separating wall gains energy until the run ends; at 0.8 none did.
    ] = 0.8


class Body(Table):
    """One body: a shape filled with particles of one material."""

    name: Annotated[str, Field(pattern=NAME, description="Name of the body, used in messages and --set.")]
    material: Annotated[
        MaterialParameters,
        Field(description="A preset in quotes, or a table: a law or a preset, with parameters and knobs."),
    ]
    shape: Annotated[
        OneShape,
        Field(
            description="Exactly one of box, ball, capsule, cylinder or mesh (3D), polygon (2D), points; add, subtract."
        ),
    ]
    velocity: Annotated[
        StartVector,
        Field(
            validate_default=True,
            description="Initial velocity, m/s; numbers, or expressions of the place X, Y, Z (m), whose gradient is "
            "the initial affine velocity C. Default: at rest.",
        ),
    ] = None  # type: ignore[assignment]
    velocity_gradient: Annotated[
        StartMatrix | None,
        Field(
            description="Velocity gradient, 1/s, one row per axis. Numbers L add L (x - c) to the velocity, c the "
            "centre of the bounding box of the shape, and L to C. With an expression of X, Y, Z in it, it is C alone, "
            "in place of the gradient of the velocity. Default: none."
        ),
    ] = None
    deformation: Annotated[
        StartDeformation | None,
        Field(
            description="Initial deformation, numbers or expressions of X, Y, Z: the volume ratio J of a law that "
            "stores it, else F, one row per axis (its elastic part where the law has plastic flow). Default: none."
        ),
    ] = None
    initial_pressure: Annotated[
        Literal["hydrostatic"] | None,
        Field(
            description='"hydrostatic": a fluid starts with the J at which it carries its own weight, density g times '
            "the depth below the top of its bounding box. Default: none."
        ),
    ] = None
    sampling: Annotated[
        Literal["lattice", "jittered", "poisson"],
        Field(
            description="Particles on a lattice, one at random in each cell of that lattice, or a Poisson-disk sample: "
            "as many at random, none closer than 0.82 (2D) or 0.87 (3D) of its spacing to another."
        ),
    ] = "lattice"
    particles_per_cell: ParticlesPerCell = None  # type: ignore[assignment]
    seed: Annotated[
        Integer, Field(ge=0, le=2**63 - 1, description="Seed of the random positions; unused by a lattice.")
    ] = 0


class Force(Table):
    """An acceleration that acts on one body, or on all of them."""

    name: Annotated[str | None, Field(pattern=NAME, description="Name of the force, for --set.")] = None
    body: Annotated[str | None, Field(description="Name of the body that it acts on. Default: all of them.")] = None
    acceleration: Annotated[
        PlaceVector,
        Field(
            description="m/s^2, one entry per axis: numbers, or expressions of the time t (s), the position x, y, z "
            "and the initial position X, Y, Z of a particle (m)."
        ),
    ]


def _no_repeats(fields: tuple[str, ...]) -> tuple[str, ...]:
    repeated = sorted({name for name in fields if fields.count(name) > 1})
    if repeated:
        raise flaw(f'lists "{repeated[0]}" more than once; once is enough')
    return fields


class Output(Table):
    """What is stored of each particle, besides its position, body and material."""

    fields: Annotated[
        tuple[ParticleField, ...],
        AfterValidator(_no_repeats),
        Field(
            description="Fields of each stored frame: velocity (m/s), density (kg/m^3), pressure (Pa), "
            "volume_ratio J, deformation_gradient F, affine C (1/s), stress (Cauchy, Pa), mass (kg), "
            "initial_position (m)."
        ),
    ] = ("velocity", "density", "pressure")
    drop_retired: Annotated[
        Flag, Field(description="Store only the particles that are there, so that frames differ in their numbers.")
    ] = False
    compress: Annotated[
        Flag, Field(description="Compress the stored file with gzip: smaller, and slower to write.")
    ] = False


class Scene(Table):
    """A complete scene in SI units: every default filled in, every key checked.

    Built by `load_scene` or `parse_scene`. In 2D all extensive quantities are per metre of depth.
    """

    title: Annotated[str, Field(description="One line that says what the scene is.")] = ""
    constants: Annotated[
        Constants | None,
        Field(
            description="Names for numbers, or for expressions of t, x, y, z, X, Y, Z and of the names above them, "
            "which every expression of the scene may use. Default: none."
        ),
    ] = None
    domain: Annotated[Domain, Field(description="The box that the scene lives in, and its grid.")]
    time: Annotated[Time, Field(description="How long, how many frames, which steps.")]
    bodies: Annotated[tuple[Body, ...], Field(min_length=1, description="The bodies, at least one.")]
    emitters: Annotated[tuple[Emitter, ...], Field(description="Where material flows in. Default: none.")] = ()
    forces: Annotated[
        tuple[Force, ...], Field(description="Accelerations beside gravity; what acts on a particle adds up.")
    ] = ()
    colliders: Annotated[
        tuple[Collider, ...], Field(description="Rigid things that the material meets, at rest or moving.")
    ] = ()
    impulses: Annotated[
        tuple[Impulse, ...], Field(description="Pushes on what is near a place, at a time or over an interval.")
    ] = ()
    output: Annotated[Output, Field(description="What is stored.")] = Output()
    solver: Annotated[SolverSettings, Field(description="How it is computed.")] = SolverSettings()

    @property
    def dimension(self) -> int:
        """Return 2 or 3."""
        return len(self.domain.size)

    @property
    def sources(self) -> "tuple[Body | Emitter, ...]":
        """Everything that particles belong to, in the order of their labels: the bodies, then the emitters."""
        return (*self.bodies, *self.emitters)

    @property
    def pushes(self) -> tuple[Force, ...]:
        """All forces, those of the impulses included."""
        interval = self.time.end / self.time.frames
        made = [
            Force.model_construct(name=one.name, body=one.body, acceleration=one.acceleration(interval))
            for one in self.impulses
        ]
        return (*self.forces, *made)

    @property
    def comes_and_goes(self) -> bool:
        """Whether particles enter or leave during the run."""
        return bool(self.emitters) or self.domain.walls.any_open(self.dimension)


@lru_cache
def scene_model(laws: tuple[type[MaterialParameters], ...]) -> type[Scene]:
    """Return the scene whose materials are one of the given laws, distinguished by their key `law`.

    Its output fields are those of every scene and the internal variables of these laws. Cached, so that
    two scenes of the same laws have the same type and can be compared.
    """
    material: Any = laws[0] if len(laws) == 1 else Annotated[Union[laws], Field(discriminator="law")]  # noqa: UP007
    described = Annotated[material, Field(description=Body.model_fields["material"].description)]
    body = create_model("Body", __base__=Body, __doc__=Body.__doc__, material=(described, ...))
    bodies = Annotated[
        tuple[body, ...],  # type: ignore[valid-type]
        Field(min_length=1, description=Scene.model_fields["bodies"].description),
    ]
    emitter = create_model("Emitter", __base__=Emitter, __doc__=Emitter.__doc__, material=(described, ...))
    emitters = Annotated[
        tuple[emitter, ...],  # type: ignore[valid-type]
        Field(description=Scene.model_fields["emitters"].description),
    ]
    output = _output_model(laws)
    described_output = Annotated[output, Field(description=Scene.model_fields["output"].description)]
    return create_model(
        "Scene",
        __base__=Scene,
        __doc__=Scene.__doc__,
        bodies=(bodies, ...),
        emitters=(emitters, ()),
        output=(described_output, output()),
    )


def _output_model(laws: tuple[type[MaterialParameters], ...]) -> type[Output]:
    """Return the output table that accepts the internal variables of the given laws as fields, too."""
    variables = {variable.name: variable for law in laws for variable in law.internal}
    if not variables:
        return Output
    field = Output.model_fields["fields"]
    also = "; ".join(f"{name}: {variable.description.rstrip('.')}" for name, variable in variables.items())
    names = Literal[(*get_args(ParticleField), *variables)]  # type: ignore[valid-type]
    annotation = Annotated[
        tuple[names, ...],
        AfterValidator(_no_repeats),
        Field(description=f"{field.description} Where a body stores it, also {also}."),
    ]
    return create_model("Output", __base__=Output, __doc__=Output.__doc__, fields=(annotation, field.default))
