"""The header of a run: the facts about its scene, laws and backend that readers of the frames need."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, TypeAdapter, ValidationError

from mpmcli import __version__
from mpmcli.scene import Scene
from mpmcli.scene.colliders import Collider, ColliderShape
from mpmcli.scene.contact_table import ContactTable
from mpmcli.scene.domain import OPEN, PERIODIC, STICKING, Friction
from mpmcli.scene.entry import Entry, definitions, value_of, varies
from mpmcli.scene.mesh import ClosedSurface, Mesh
from mpmcli.scene.quantity import AXES
from mpmcli.scene.sampling import rest_volume
from mpmcli.scene.schema import usual_particles_per_cell
from mpmcli.scene.shapes import BodyShape
from mpmcli.scene.sheets import sheets_in
from mpmcli.stability.transfer_factors import FARTHEST, INTERVAL

# Times of a run at which gravity is evaluated for its mean.
MOMENTS = 1001


def nearest_image(way: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Return vectors between particles, (..., d), m, as those to the nearest images; see `RunHeader.period`."""
    if not np.isfinite(period).any():
        return way
    turns = np.round(way / period)
    return way - np.where(turns == 0, 0.0, period) * turns


class _Facts(BaseModel):
    """Entries of a file; other entries are ignored, and missing ones are unknown."""

    model_config = ConfigDict(frozen=True)


class _Contact(_Facts):
    friction: float | None = None
    pairs: tuple[dict[str, Any], ...] = ()


class _Body(_Facts):
    material: dict[str, Any] = {}
    shape: dict[str, Any] = {}
    deformation: Any = None
    particles_per_cell: float | None = None

    def volume(self, d: int) -> float | None:
        """Return the volume of the shape, None if unknown."""
        try:
            return BodyShape.model_validate(self.shape, context={"dimension": d}).form.volume
        except (ValidationError, StopIteration):
            return None


class _StoredScene(_Facts):
    """The tables of a complete scene, whose keys `entry` reads; the file of a shape may be gone."""

    domain: dict[str, Any] = {}
    time: dict[str, Any] = {}
    solver: dict[str, Any] = {}
    output: dict[str, Any] = {}
    contact: _Contact = _Contact()
    constants: dict[str, Any] = {}
    bodies: tuple[_Body, ...] = ()
    emitters: tuple[_Body, ...] = ()
    colliders: tuple[dict[str, Any], ...] = ()
    cameras: tuple[dict[str, Any], ...] = ()
    forces: tuple[Any, ...] = ()
    impulses: tuple[Any, ...] = ()

    def entry(self, table: str, key: str, missing: Any = None) -> Any:
        """Return a value as a scene reads it; ValidationError: its type is wrong."""
        if key not in getattr(self, table):
            return missing
        context = {"dimension": None, "constants": definitions(self.constants, None)[0]}
        return _type_of(table, key).validate_python(getattr(self, table)[key], context=context)


@cache
def _type_of(table: str, key: str) -> TypeAdapter:
    field = Scene.model_fields[table].annotation.model_fields[key]
    return TypeAdapter(Annotated[field.annotation, *field.metadata])


class LawHeader(_Facts):
    """A law: its name in a scene, "J" or "F", whether it coheres, and whether it may yield or flow."""

    model_config = ConfigDict(from_attributes=True)

    name: str = ""
    deformation: Literal["J", "F"]
    coherent: bool
    projects: bool = True


class _StoredHeader(_Facts):
    """A header as stored in files, with `scene` as TOML."""

    version: str | None = None
    title: str = ""
    dimension: Literal[0, 2, 3] = 0
    spacing: float | None = None
    origin: tuple[float, ...] = ()
    size: tuple[float, ...] = ()
    bodies: tuple[str, ...] = ()
    volumes: tuple[float | None, ...] = ()
    emitter_volumes: tuple[float | None, ...] = ()
    chosen: tuple[tuple[str, ...], ...] = ()
    contacts: tuple[tuple[str, str], ...] = ()
    materials: tuple[str, ...] = ()
    laws: tuple[LawHeader, ...] = ()
    precision: Literal["f32", "f64"] = "f32"
    backend: dict[str, Any] = {}
    scene: Annotated[_StoredScene, BeforeValidator(tomllib.loads)] = _StoredScene()


@dataclass(frozen=True)
class BodyHeader:
    """A body of the scene: `material` is its table, `volume` in m^3 (m^2 in 2D); unknown entries are {} or None.

    `chosen` are the parameters of the material that the scene left "auto".
    """

    name: str
    material: Mapping[str, Any]
    volume: float | None
    particles_per_cell: float
    chosen: tuple[str, ...] = ()

    @property
    def density(self) -> float | None:
        """Density at rest, kg/m^3; None if unknown."""
        return self.material.get("density")


@dataclass(frozen=True)
class RunHeader:
    """Facts of a run; those that the header lacks are None or empty.

    Attributes:
        stored: the entries as stored in files; all of them are valid JSON.
        title: of the scene; version: of mpmcli.
        dimension: d, 2 or 3.
        spacing: h, m.
        origin, upper: corners of the domain, (d,), m; both are known, or neither.
        gravity: (d,), m/s^2; None if it depends on time.
        steady_gravity: (d,), m/s^2, with 0 for each entry that depends on time; None if unknown. mean_gravity: its mean
            over the run.
        driven: whether energy and momentum have a source: forces, moving walls, time-dependent gravity, gravity along a
            periodic axis, or particles that come and go.
        particle_count_varies: whether particles come and go; drops: whether frames contain only the particles present.
        open_axes: for each axis, whether a face normal to it is open.
        total: whether elastic bodies are computed on the grid of their state at rest.
        keeps_spin: whether the transfers conserve angular momentum, as APIC does on the updated grid.
        shifts: whether particles of liquids and grains are shifted.
        sticking: for each axis, whether a face normal to it sticks or has friction.
        periodic: (d,), whether the domain repeats along each axis.
        faces: the conditions of the lower and the upper wall of each axis; empty if unknown. friction: of walls.
        bodies: in the order of their labels in the frames.
        contacts: see `ContactTable.pairs`.
        laws: in the order of the labels in the frames.
        end: s; frames: expected, the initial one included.
        precision: "f32" or "f64"; backend: "arch" and "precision".
        scene: the entries read from the complete scene.
    """

    stored: dict[str, Any]
    title: str
    version: str | None
    dimension: int
    spacing: float | None
    origin: np.ndarray | None
    upper: np.ndarray | None
    gravity: np.ndarray | None
    steady_gravity: np.ndarray | None
    mean_gravity: np.ndarray | None
    driven: bool
    particle_count_varies: bool
    drops: bool
    open_axes: tuple[bool, ...]
    total: bool
    keeps_spin: bool
    shifts: bool
    sticking: tuple[bool, ...] | None
    periodic: np.ndarray
    faces: tuple[tuple[str, str], ...]
    friction: Friction
    bodies: tuple[BodyHeader, ...]
    contacts: tuple[tuple[str, str], ...]
    laws: tuple[LawHeader, ...]
    end: float | None
    frames: int | None
    precision: str
    backend: Mapping[str, Any]
    scene: _StoredScene

    @classmethod
    def of(cls, scene: Scene, text: str, laws: Sequence[Any], backend: Mapping[str, Any]) -> "RunHeader":
        """Return the header of a new run; `text` is the complete scene as TOML, laws as in `Frame.material`."""
        # The file of a shape may be gone later, and a deformed body has another volume at rest.
        known = not any(
            body.shape.files or body.deformation is not None or body.initial_pressure for body in scene.bodies
        )
        chosen = [
            sorted({*type(one).model_fields} - one.model_fields_set) for one in (b.material for b in scene.sources)
        ]
        emitted = sheets_in(scene)
        return cls.read(
            {
                "version": __version__,
                "title": scene.title,
                "dimension": scene.dimension,
                "spacing": scene.domain.spacing,
                "origin": list(scene.domain.origin),
                "size": list(scene.domain.size),
                "bodies": [body.name for body in scene.sources],
                **({} if known else {"volumes": [rest_volume(body, scene.domain) for body in scene.bodies]}),
                "materials": [law.name for law in laws],
                "laws": [LawHeader.model_validate(law).model_dump(exclude={"name"}) for law in laws],
                "precision": backend["precision"],
                # The bytes of a result do not depend on the number of threads; run.json has it.
                "backend": {name: value for name, value in backend.items() if name != "threads"},
                "scene": text,
            }
            | ({"emitter_volumes": [sheets.particles * sheets.volume for sheets in emitted]} if emitted else {})
            | ({"chosen": chosen} if any(chosen) else {})
            | ({"contacts": [list(pair) for pair in pairs]} if (pairs := ContactTable(scene).pairs) else {})
        )

    @classmethod
    def read(cls, stored: Mapping[str, Any]) -> "RunHeader":
        """Read a header, and the scene in it; ValidationError, a ValueError: an entry has a wrong type."""
        facts = _StoredHeader.model_validate(dict(stored))
        scene, d = facts.scene, facts.dimension
        gravity, walls = scene.entry("domain", "gravity", ()), scene.entry("domain", "walls")
        friction, frames = scene.entry("domain", "friction", Friction()), scene.entry("time", "frames")
        faces = () if walls is None else walls.faces(d)
        placed = len(facts.origin) == len(facts.size) == d > 0
        origin = np.array(facts.origin) if placed else None
        steady = np.array([0.0 if varies(entry) else entry for entry in gravity]) if len(gravity) == d > 0 else None
        periodic = np.array([PERIODIC in pair for pair in faces] or [False] * d, bool)
        runs_on = steady is not None and bool(steady[periodic].any())
        total = scene.solver.get("solids") == "total"
        opens = tuple(OPEN in pair for pair in faces)
        particle_count_varies = bool(scene.emitters) or any(opens)
        moved = bool(scene.domain.get("wall_velocity") or scene.forces or scene.impulses)
        rough = [any((getattr(friction, name) or 0) > 0 for name in ("default", f"{a}_min", f"{a}_max")) for a in AXES]
        sticking = tuple(own or not STICKING.isdisjoint(pair) for own, pair in zip(rough, faces, strict=False))
        end = scene.entry("time", "end")
        return cls(
            stored=dict(stored),
            title=facts.title,
            version=facts.version,
            dimension=d,
            spacing=facts.spacing,
            origin=origin,
            upper=origin + facts.size if placed else None,
            gravity=None if varies(*gravity) else steady,
            steady_gravity=steady,
            mean_gravity=None if steady is None else _mean(gravity, end or 0.0),
            driven=varies(*gravity) or runs_on or moved or particle_count_varies,
            particle_count_varies=particle_count_varies,
            drops=scene.entry("output", "drop_retired", False),
            open_axes=opens,
            total=total,
            keeps_spin=scene.solver.get("transfer", "apic") == "apic" and not total,
            shifts=scene.solver.get("redistribute") == "auto",
            sticking=sticking or None,
            periodic=periodic,
            faces=faces,
            friction=friction,
            bodies=_bodies(facts),
            contacts=facts.contacts,
            laws=tuple(
                law.model_copy(update={"name": name}) for name, law in zip(facts.materials, facts.laws, strict=True)
            ),
            end=end,
            frames=None if frames is None else frames + 1,
            precision=facts.precision,
            backend=facts.backend,
            scene=scene,
        )

    @property
    def collider_names(self) -> tuple[str, ...]:
        """Names of the colliders, in the order of the ledger's columns."""
        return tuple(str(table.get("name", "")) for table in self.scene.colliders)

    @cached_property
    def colliders(self) -> tuple[Collider, ...]:
        """The colliders of the scene; one whose mesh is not found is left out."""
        return tuple(collider for collider in self.read_colliders({}) if collider is not None)

    @cached_property
    def moved(self) -> bool:
        """Whether a collider has a prescribed motion, which does work; True if unknown."""
        return any(collider is None or collider.driven for collider in self.read_colliders({}))

    def read_colliders(self, surfaces: Mapping[int, ClosedSurface]) -> tuple[Collider | None, ...]:
        """Read the colliders, None for one that cannot be read; `surfaces`, by number, replace those in files."""
        constants, _ = definitions(self.scene.constants, self.dimension)
        context = {"dimension": self.dimension, "constants": constants}
        return tuple(_collider(table, context, surfaces.get(k)) for k, table in enumerate(self.scene.colliders))

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the bodies, in the order of their labels in the frames."""
        return tuple(body.name for body in self.bodies)

    @cached_property
    def densities(self) -> tuple[float, ...]:
        """Density of each body at rest, kg/m^3; empty if a density or a volume is unknown."""
        known = all(body.volume is not None and body.density is not None for body in self.bodies)
        return tuple(body.density for body in self.bodies) if known else ()

    @property
    def epsilon(self) -> float:
        """Relative rounding error of the solver's numbers."""
        return float(np.finfo(np.float64 if self.precision == "f64" else np.float32).eps)

    @property
    def on_gpu(self) -> bool:
        """Whether the Courant numbers of the ledger are estimates."""
        return self.backend.get("arch", "cpu") != "cpu"

    @cached_property
    def farthest(self) -> float:
        """Largest coordinate of the domain, m: the scale of the rounding of stored positions; 0 if unknown."""
        return 0.0 if self.origin is None else float(np.abs([self.origin, self.upper]).max())

    @cached_property
    def step_error(self) -> float:
        """Rounding error of a position in one step, m; the solver's origin is the lower corner of the domain."""
        return 0.0 if self.origin is None else self.epsilon * float((self.upper - self.origin).max())

    def place_error(self, stored: np.dtype) -> float:
        """Return the rounding error of a position stored in this type, m, including that of the solver."""
        return self.step_error + float(np.finfo(stored).eps) * self.farthest

    def shifted(self, steps: int, last: int) -> float:
        """Return the largest shift of a particle in the `steps` steps up to `last`, m, for one particle per cell."""
        shifts = (last - 1) // INTERVAL - (last - steps - 1) // INTERVAL
        return shifts * 2 * FARTHEST * self.spacing if self.shifts and self.spacing is not None else 0.0

    @property
    def period(self) -> np.ndarray:
        """Period of the domain along each axis, (d,), m; infinite if it is not periodic or unknown."""
        unknown = self.origin is None
        return np.where(self.periodic, np.inf if unknown else self.upper - self.origin, np.inf)

    def body_name(self, label: int) -> str:
        """Return the name of a body, or its number if it has none."""
        return self.bodies[label].name if 0 <= label < len(self.bodies) else f"number {label}"

    def masses(self, body: np.ndarray) -> np.ndarray | None:
        """Return the mass of each particle, (n,) float64, kg, from the labels (n,); None if unknown."""
        if self.drops or not self.densities or len(body) == 0 or body.min() < 0 or body.max() >= len(self.bodies):
            return None
        counts = np.bincount(body, minlength=len(self.bodies))
        volumes = np.array([body.volume for body in self.bodies]) / np.maximum(counts, 1)
        masses = np.array(self.densities) * volumes
        # In the solver's precision, so that sums agree to the last digits.
        kept = masses.astype(np.float64 if self.precision == "f64" else np.float32).astype(np.float64)
        return kept[body]


def _mean(entries: Sequence[Entry], end: float) -> np.ndarray:
    """Return the means of functions of time until `end`, s."""
    times = np.linspace(0.0, end, MOMENTS)
    return np.array([np.nan_to_num(value_of(entry, t=times)).mean() for entry in entries])


def _bodies(facts: _StoredHeader) -> tuple[BodyHeader, ...]:
    """Return the bodies and emitters; those that the scene lacks have a name only."""
    names, scene, d = facts.bodies, facts.scene, facts.dimension
    tables = [*scene.bodies, *scene.emitters]
    # The volume of an emitter is that of all its particles, which does not follow from its shape.
    volumes = [*(facts.volumes or [None] * len(scene.bodies)), *facts.emitter_volumes]
    chosen = facts.chosen if len(facts.chosen) == len(names) else [()] * len(names)
    tables = tables if len(tables) == len(names) else [_Body()] * len(names)
    volumes = volumes if len(volumes) == len(names) else [None] * len(names)
    return tuple(
        BodyHeader(
            name,
            table.material,
            table.volume(d) if volume is None else volume,
            table.particles_per_cell or usual_particles_per_cell(d),
            own,
        )
        for name, table, volume, own in zip(names, tables, volumes, chosen, strict=True)
    )


def _collider(table: Mapping[str, Any], context: dict[str, Any], surface: ClosedSurface | None) -> Collider | None:
    try:
        if surface is None:
            return Collider.model_validate(table, context=context)
        box = {"box": {name: corner.tolist() for name, corner in zip(("min", "max"), surface.bounds(), strict=True)}}
        found = Collider.model_validate({**table, "shape": box}, context=context)
    except ValidationError:
        return None
    mesh = Mesh.model_construct(file="", scale=1.0, rotate=None, translate=(0.0,) * len(surface.vertices[0]))
    mesh._surface = surface
    return found.model_copy(update={"shape": ColliderShape.model_construct(mesh=mesh)})
