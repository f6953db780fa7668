"""The tables of a scene: one frozen model per table, each key with its unit, range and default."""

from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal, Union, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    ValidationInfo,
    create_model,
    field_validator,
    model_validator,
)

from mpmcli.scene.cameras import Camera
from mpmcli.scene.colliders import Collider
from mpmcli.scene.domain import Domain
from mpmcli.scene.entry import ConstantTable, OfTime, StartDeformation, StartMatrix, StartVector
from mpmcli.scene.forces import Contact, Force, Impulse
from mpmcli.scene.material import MaterialParameters
from mpmcli.scene.quantity import NAME, Flag, Integer, NotNegative, Positive, Table, Vector, flaw, scene_dimension
from mpmcli.scene.shapes import OneShape


def usual_particles_per_cell(dimension: int) -> int:
    """Return the particles per cell of a body that does not give them: two per axis."""
    return 2**dimension


def _filled_lattice(value: object, info: ValidationInfo) -> object:
    return usual_particles_per_cell(scene_dimension(info) or 2) if value is None else value


def _whole_lattice(count: int, info: ValidationInfo) -> int:
    """Refuse a lattice whose number of particles per cell is not a square (2D) or cube (3D)."""
    dimension = scene_dimension(info)
    shape = info.data.get("shape")
    of_points = shape is not None and getattr(shape, "points", None)
    if dimension is None or info.data.get("sampling", "lattice") != "lattice" or of_points:
        return count
    root = round(count ** (1 / dimension))
    if root**dimension == count:
        return count
    below = root if root**dimension < count else root - 1
    nearest = f"{below**dimension} or {(below + 1) ** dimension}"
    raise flaw(
        f"must be a {'square' if dimension == 2 else 'cube'} number for a lattice in {dimension}D, "
        f'for example {nearest}; found {count}. With sampling = "jittered" any number will do'
    )


ParticlesPerCell = Annotated[
    Integer,
    Field(ge=1, le=10**4),
    BeforeValidator(_filled_lattice),
    AfterValidator(_whole_lattice),
    Field(
        validate_default=True,
        description="Particles per cell of the grid; a square (2D) or cube (3D) number for a lattice. "
        "Default: 4 in 2D, 8 in 3D; that of the points where the shape is points.",
    ),
]


Material = Annotated[
    MaterialParameters,
    Field(description="A preset in quotes, or a table: a law or a preset, with parameters and knobs."),
]


class Emitter(Table):
    """A mouth from which material flows along a constant direction.

    The mouth is the section of the shape through its centre, across the velocity. Particles move with the velocity, in
    sheets: a layer as thick as the particle distance enters as one sheet or as eight.
    """

    has_surface: ClassVar[bool] = False

    name: str = Field(pattern=NAME, description="Name of the emitter, used in messages and --set.")
    material: Material
    shape: OneShape = Field(description="Its section through the centre, across the velocity, is the mouth.")
    velocity: Vector = Field(description="Velocity of the inflow, m/s; not zero.")
    rate: OfTime | None = Field(
        None,
        description="Volume flow, m^3/s (m^2/s in 2D), a number or an expression of t; velocity is then the direction "
        "only. Default: the area of the mouth times the speed.",
    )
    start: NotNegative = Field(0.0, description="Time at which the first sheet enters, s.")
    end: Positive | None = Field(
        None, description="Time from which on no sheet enters, s. Default: the end of the scene."
    )
    particles: Integer | None = Field(
        None, ge=1, description="Particles in all, of a lattice whole sheets; or give volume. Default: until end."
    )
    volume: Positive | None = Field(
        None, description="Volume at rest in all, m^3 (m^2 in 2D); or give particles. Default: until end."
    )
    sampling: Literal["turned", "jittered", "lattice"] = Field(
        "turned",
        description="A lattice turned such that no stretch lines its particles up, one at random in each cell of a "
        "lattice that moves along, or the sheets of that lattice.",
    )
    particles_per_cell: ParticlesPerCell = None  # type: ignore[assignment]
    seed: Integer = Field(0, ge=0, le=2**63 - 1, description="Seed of the random positions of a jittered sample.")

    @field_validator("velocity")
    @classmethod
    def _moves(cls, velocity: tuple[float, ...]) -> tuple[float, ...]:
        if not any(velocity):
            raise flaw("must not be zero, as nothing would flow; give the velocity of the material in m/s")
        return velocity

    @model_validator(mode="after")
    def _one_total(self) -> "Emitter":
        if self.particles is not None and self.volume is not None:
            raise flaw("particles is given as well; leave one of them out", "volume")
        if self.end is not None and self.end <= self.start:
            raise flaw(f"must be after start, {self.start:g} s; found {self.end:g}", "end")
        return self


# Poisson's ratio above which bodies lock without `f_bar`: a beam of four cells is 5 % too stiff at 0.45, 13 % at 0.49.
NEARLY_INCOMPRESSIBLE = 0.45
# Default share of AFLIP: half of the loss of APIC.
USUAL_FLIP = 0.5


def _only_with_aflip(flip: float | None, info: ValidationInfo) -> float | None:
    """Fill in the share of FLIP for transfer = "aflip", and refuse it for any other transfer."""
    # An invalid transfer is absent from the data and has its own message.
    transfer = info.data.get("transfer", "aflip")
    if flip is not None and transfer != "aflip":
        raise flaw(f'is the share of FLIP in transfer = "aflip"; with transfer = "{transfer}" leave it out')
    return USUAL_FLIP if flip is None and transfer == "aflip" else flip


class SolverSettings(Table):
    """How the scene is computed. Options that are not chosen are absent from the compiled step."""

    precision: Literal["f32", "f64"] = Field("f32", description="Floating-point numbers of the solver: 32 or 64 bits.")
    kernel: Literal["quadratic", "cubic"] = Field(
        "quadratic",
        description='B-spline between particles and nodes. "quadratic" reaches 3 nodes per axis. "cubic" reaches '
        "4: smoother, and stable at steps 1.15 times as long, but waves are 1.4 times further off and lose twice "
        "as much in a step, for 16/9 of the work on nodes in 2D, 64/27 in 3D.",
    )
    transfer: Literal["apic", "aflip"] = Field(
        "apic",
        description='Quantities transferred to the nodes and back. "apic": velocity and its gradient, which '
        'keeps angular momentum exactly. "aflip": APIC that damps only a share of the motion not on the grid: waves, '
        "splashes and spin lose far less; twice the memory of the grid, and some noise.",
    )
    flip: Annotated[
        float | None,
        Field(
            strict=True,
            ge=0,
            le=1,
            description='With transfer = "aflip": share of the part of a particle\'s motion that is not on the grid '
            f"and that a step keeps. 0 is APIC, 1 damps nothing. Default: {USUAL_FLIP:g}.",
        ),
        AfterValidator(_only_with_aflip),
        Field(validate_default=True),
    ] = None
    solids: Literal["updated", "total"] = Field(
        "updated",
        description='Grid of elastic solids. "updated": that of all materials. "total": of their state at rest '
        "(total Lagrangian): more accurate, without tears; for scenes of one elastic law, whose bodies begin apart.",
    )
    f_bar: Flag | Literal["auto"] = Field(
        "auto",
        description="Whether particles of a cell share their change of volume (F-bar), so that material that "
        'hardly changes its volume does not lock. "auto": those of laws of which a body has a Poisson\'s ratio of '
        f"more than {NEARLY_INCOMPRESSIBLE:g}, and does not flow; those of viscoplastic fluids take their mean volume "
        "in one step of fifty.",
    )
    grid: Literal["auto", "dense", "sparse"] = Field(
        "auto",
        description='Nodes of the background grid. "dense": all of the domain. "sparse": those near particles, in '
        'blocks, on the CPU; for large domains that are nearly empty. "auto": sparse where a domain has at least '
        "8 million cells and material fills at most a twentieth of them.",
    )
    redistribute: Literal["auto", False] = Field(
        "auto",
        description="Whether particles of liquids and grains are shifted out of crowds that the flow creates. "
        '"auto": those of fluid and sand, every 30 steps, by two fifths of their distance at most.',
    )
    deterministic: Flag = Field(
        False,
        description="Whether a GPU adds in fixed point, so that two runs have the same bytes. On the CPU they have "
        "them in any case.",
    )


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
    """The simulated time, the stored frames, and the time step."""

    end: Positive = Field(description="Simulated time, s; the scene starts at 0.")
    frames: Integer = Field(
        ge=1, le=10**9, description="Number of equal intervals between stored frames; one frame more is stored."
    )
    step: Positive | Literal["auto"] = Field(
        "auto", description='Largest time step, s; "auto" leaves it to the stability limits alone.'
    )
    # At 0.9 a lone droplet that bounces along a separating wall gains energy until the run ends; at 0.8 none did.
    safety: float = Field(
        0.8, strict=True, gt=0, le=1, description="Fraction of the smallest stability limit that a step takes, 0 to 1."
    )


def _usual_sampling(value: object, info: ValidationInfo) -> object:
    return _usual(info) if value is None else value


def _usually_relaxed(value: object, info: ValidationInfo) -> object:
    return info.data.get("sampling") == _usual(info) != "lattice" if value is None else value


def _usual(info: ValidationInfo) -> str:
    """Return the default sampling of the material of a body; points are used as given."""
    material, shape = info.data.get("material"), info.data.get("shape")
    return "lattice" if material is None or getattr(shape, "points", None) else material.usual_sampling


def _not_for_points(relaxed: bool, info: ValidationInfo) -> bool:
    # An invalid shape is absent from the data and has its own message.
    if relaxed and getattr(info.data.get("shape"), "points", None):
        raise flaw("moves particles, and points are particles as they are; leave it out")
    return relaxed


class Body(Table):
    """One body: a shape filled with particles of one material."""

    name: str = Field(pattern=NAME, description="Name of the body, used in messages and --set.")
    material: Material
    shape: OneShape = Field(
        description="Exactly one of box, ball, capsule, cylinder or mesh (3D), polygon (2D), points; add, subtract."
    )
    velocity: StartVector = Field(
        None,
        validate_default=True,
        description="Initial velocity, m/s; numbers, or expressions of the place X, Y, Z (m), whose gradient is "
        "the initial affine velocity C. Default: at rest.",
    )
    velocity_gradient: StartMatrix | None = Field(
        None,
        description="Velocity gradient, 1/s, one row per axis. Numbers L add L (x - c) to the velocity, c the "
        "centre of the bounding box of the shape, and L to C. With an expression of X, Y, Z in it, it is C alone, "
        "in place of the gradient of the velocity. Default: none.",
    )
    deformation: StartDeformation | None = Field(
        None,
        description="Initial deformation, numbers or expressions of X, Y, Z: the volume ratio J of a law that "
        "stores it, else F, one row per axis (its elastic part where the law has plastic flow). Default: none.",
    )
    initial_pressure: Literal["hydrostatic"] | None = Field(
        None,
        description='"hydrostatic": a fluid starts with the J at which it carries its own weight, density g times '
        "the depth below the top of its bounding box. Default: none.",
    )
    sampling: Annotated[Literal["lattice", "turned", "jittered", "poisson"], BeforeValidator(_usual_sampling)] = Field(
        None,
        validate_default=True,
        description="Particles on a lattice, on one rotated so that no flow along the axes lines them up, one at "
        "random in each cell of the lattice, or a Poisson-disk sample: as many at random, none closer than 0.82 (2D) "
        'or 0.87 (3D) of its spacing to another. Default: "lattice"; "turned" for viscoplastic material.',
    )  # type: ignore[assignment]
    relaxed: Annotated[Flag, AfterValidator(_not_for_points), BeforeValidator(_usually_relaxed)] = Field(
        None,
        validate_default=True,
        description="Whether particles are moved a little, until each node of the grid whose spline the body fills, "
        "with its images behind walls, has the volume and the centre of a full cell. Not for points. Default: false; "
        "true for viscoplastic material on a turned lattice.",
    )  # type: ignore[assignment]
    particles_per_cell: ParticlesPerCell = None  # type: ignore[assignment]
    seed: Integer = Field(0, ge=0, le=2**63 - 1, description="Seed of the random positions; unused by lattices.")

    @property
    def has_surface(self) -> bool:
        """Whether particles can represent its surface: its material keeps one, and its shape is known."""
        return self.material.has_surface and (self.shape.points is None or self.shape.at_rest is not None)


def _no_repeats(fields: tuple[str, ...]) -> tuple[str, ...]:
    repeated = sorted({name for name in fields if fields.count(name) > 1})
    if repeated:
        raise flaw(f'lists "{repeated[0]}" more than once; once is enough')
    return fields


class Output(Table):
    """Fields that are stored for each particle besides its position, body and material."""

    fields: Annotated[tuple[ParticleField, ...], AfterValidator(_no_repeats)] = Field(
        ("velocity", "density", "pressure"),
        description="Fields of each stored frame: velocity (m/s), density (kg/m^3), pressure (Pa), volume_ratio J, "
        "deformation_gradient F, affine C (1/s), stress (Cauchy, Pa), mass (kg), initial_position (m).",
    )
    drop_retired: Flag = Field(
        False, description="Store only the particles present, so that the number of particles varies between frames."
    )
    compress: Flag = Field(False, description="Compress the stored file with gzip: smaller, and slower to write.")


class ErrorBars(Table):
    """Error bars of `mpmcli simulate`, which it computes after the run if the scene has this table."""

    level: Literal["grids", "step", "all"] = Field(
        "grids", description="Siblings: two coarser grids; also half a step; also other placements and samples."
    )
    confidence: Literal[90, 95] = Field(90, description="Share of true errors that the bars are to contain, percent.")
    observe: dict[str, str] = Field(
        {}, description="Further observables: means over the particles of expressions of x, y, z, vx, vy, vz and t."
    )


class Scene(Table):
    """A complete scene in SI units: every default filled in, every key checked.

    Built by `load_scene` or `parse_scene`. In 2D all extensive quantities are per metre of depth.
    """

    title: str = Field("", description="One line that describes the scene.")
    constants: ConstantTable | None = Field(
        None,
        description="Names for numbers, or for expressions of t, x, y, z, X, Y, Z and of the names above them, "
        "which every expression of the scene may use. Default: none.",
    )
    domain: Domain = Field(description="The box of the scene, and its grid.")
    time: Time = Field(description="Simulated time, frames and time step.")
    bodies: tuple[Body, ...] = Field((), description="The bodies; none if emitters bring all material.")
    emitters: tuple[Emitter, ...] = Field((), description="Sources of inflow. Default: none.")
    forces: tuple[Force, ...] = Field(
        (), description="Accelerations besides gravity; those that act on a particle add up."
    )
    colliders: tuple[Collider, ...] = Field((), description="Rigid obstacles, at rest or moving.")
    impulses: tuple[Impulse, ...] = Field(
        (), description="Pushes on particles near a place, at a time or over an interval."
    )
    contact: Contact = Field(Contact(), description='Contact between bodies. Default: "auto".')
    output: Output = Field(Output(), description="Stored fields and format.")
    error_bars: ErrorBars | None = Field(None, description="Error bars after the run. Default: none.")
    cameras: tuple[Camera, ...] = Field((), description="Cameras of `mpmcli render --cameras`. Default: none.")
    solver: SolverSettings = Field(SolverSettings(), description="Numerical method.")

    @model_validator(mode="after")
    def _has_material(self) -> "Scene":
        if not (self.sources or any(collider.free for collider in self.colliders)):
            raise flaw("needs at least one entry, or emitters or rigid bodies (colliders with a density)", "bodies")
        return self

    @property
    def dimension(self) -> int:
        """Return 2 or 3."""
        return len(self.domain.size)

    @property
    def sources(self) -> "tuple[Body | Emitter, ...]":
        """All sources of particles, in the order of their labels: the bodies, then the emitters."""
        return (*self.bodies, *self.emitters)

    @property
    def laws(self) -> tuple[str, ...]:
        """The names of the laws of its materials, sorted; rigid bodies alone have one that compiles fast."""
        return tuple(sorted({source.material.law for source in self.sources})) or ("fixed_corotated",)

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
    def particle_count_varies(self) -> bool:
        """Whether particles enter or leave during the run."""
        return bool(self.emitters) or self.domain.walls.any_open(self.dimension)


@lru_cache
def scene_model(laws: tuple[type[MaterialParameters], ...]) -> type[Scene]:
    """Return the scene whose materials are one of the given laws, distinguished by their key `law`.

    Its output fields are those of every scene and the internal variables of these laws. The model is cached, so that
    two scenes of the same laws have the same type and can be compared.
    """
    material: Any = laws[0] if len(laws) == 1 else Annotated[Union[laws], Field(discriminator="law")]  # noqa: UP007
    described = Annotated[material, Field(description=Body.model_fields["material"].description)]
    body, emitter = (
        create_model(base.__name__, __base__=base, __doc__=base.__doc__, material=(described, ...))
        for base in (Body, Emitter)
    )
    output = _output_model(laws)
    texts = {name: field.description for name, field in Scene.model_fields.items()}
    return create_model(
        "Scene",
        __base__=Scene,
        __doc__=Scene.__doc__,
        bodies=(tuple[body, ...], Field((), description=texts["bodies"])),
        emitters=(tuple[emitter, ...], Field((), description=texts["emitters"])),
        output=(output, Field(output(), description=texts["output"])),
    )


def _output_model(laws: tuple[type[MaterialParameters], ...]) -> type[Output]:
    """Return the output table that also accepts the internal variables of the given laws as fields."""
    variables = {variable.name: variable for law in laws for variable in law.internal}
    if not variables:
        return Output
    field = Output.model_fields["fields"]
    also = "; ".join(f"{name}: {variable.description.rstrip('.')}" for name, variable in variables.items())
    names = Literal[(*get_args(ParticleField), *variables)]  # type: ignore[valid-type]
    annotation = Annotated[tuple[names, ...], AfterValidator(_no_repeats)]
    described = Field(field.default, description=f"{field.description} Where a body stores it, also {also}.")
    return create_model("Output", __base__=Output, __doc__=Output.__doc__, fields=(annotation, described))
