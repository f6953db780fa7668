"""The header of a run: the facts about its scene, laws and backend that every reader of the frames needs."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from pydantic import ValidationError

from mpmcli import __version__
from mpmcli.output.stored_facts import require_kinds
from mpmcli.scene import Scene
from mpmcli.scene.colliders import Collider, ColliderShape
from mpmcli.scene.domain import PERIODIC, Walls
from mpmcli.scene.entry import definitions
from mpmcli.scene.mesh import Mesh
from mpmcli.scene.quantity import AXES
from mpmcli.scene.schema import SolverSettings, usual_particles_per_cell
from mpmcli.scene.shapes import BodyShape
from mpmcli.scene.sheets import emitted_volumes
from mpmcli.scene.triangles import ClosedSurface
from mpmcli.stability.transfer_factors import FARTHEST, INTERVAL

# Of a scene that does not say.
_TRANSFER, _SOLIDS = (SolverSettings.model_fields[name].default for name in ("transfer", "solids"))


def words_of(walls: Mapping[str, str] | str | None, d: int) -> tuple[tuple[str, str], ...] | None:
    """Return the words of the faces along each axis, None where they are not known."""
    if walls is None:
        return None
    table = {"default": walls} if isinstance(walls, str) else walls
    try:
        return Walls.model_validate(table, context={"dimension": d}).faces(d)
    except ValidationError:
        return None


def sticking_axes(
    words: tuple[tuple[str, str], ...] | None, friction: Mapping[str, float] | float
) -> tuple[bool, ...] | None:
    """Return per axis whether a face normal to it sticks or has friction, None where walls are not known."""
    if words is None:
        return None
    numbers = friction if isinstance(friction, Mapping) else {"default": friction}
    rough = [numbers.get("default", 0) > 0 or any(numbers.get(f"{a}_{s}", 0) > 0 for s in ("min", "max")) for a in AXES]
    return tuple("stick" in pair or rubs for pair, rubs in zip(words, rough, strict=False))


@dataclass(frozen=True)
class BodyHeader:
    """A body of the scene; what is not known is {} or None: `material` is its table, `volume` in m^3 (m^2 in 2D)."""

    name: str
    material: Mapping[str, Any]
    volume: float | None
    particles_per_cell: float

    @property
    def density(self) -> float | None:
        """At rest, kg/m^3; None where not known."""
        return self.material.get("density")


def body_headers(
    names: Sequence[str], tables: Sequence[Mapping[str, Any]], volumes: Sequence[float | None], d: int
) -> tuple[BodyHeader, ...]:
    """Return the bodies; of other ones than the scene's the names alone; `volumes` where shapes do not tell them."""
    tables = tables if len(tables) == len(names) else [{} for _ in names]
    volumes = volumes if len(volumes) == len(names) else [None] * len(names)
    return tuple(
        BodyHeader(
            name,
            table.get("material", {}),
            _volume(table.get("shape", {}), d) if volume is None else volume,
            table.get("particles_per_cell", usual_particles_per_cell(d)),
        )
        for name, table, volume in zip(names, tables, volumes, strict=True)
    )


def _volume(shape: Mapping[str, Any], d: int) -> float | None:
    try:
        return BodyShape.model_validate(shape, context={"dimension": d}).form.volume
    except (ValidationError, StopIteration):
        return None


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


class LawFacts(Protocol):
    """What a header keeps of a constitutive law; see `LawHeader`."""

    name: str
    deformation: str
    coherent: bool
    projects: bool


@dataclass(frozen=True)
class LawHeader:
    """A law: its word in a scene, "J" or "F", whether it coheres, and may yield or flow (older files: not known)."""

    name: str
    deformation: str
    coherent: bool
    projects: bool = True


@dataclass(frozen=True)
class RunHeader:
    """Facts of a run; those that a file does not hold are None, or empty.

    Attributes:
        stored: the entries as files hold them; JSON can hold all of them.
        title: of the scene; version: of mpmcli.
        dimension: d, 2 or 3.
        spacing: h, m.
        origin, upper: corners of the domain, (d,), m; both are known, or neither.
        gravity: (d,), m/s^2; None where it depends on time.
        steady_gravity: (d,), m/s^2, with 0 for each entry that depends on time; None where not known.
        driven: whether forces act, walls move, gravity depends on time or acts along an axis that repeats, or particles
            come and go: energy and momentum have a source then.
        comes_and_goes: whether the last is so; drops: whether frames hold only those that are there.
        open_axes: per axis, whether a face normal to it is open.
        total: whether elastic bodies are on the grid of their state at rest.
        keeps_spin: whether the transfers conserve angular momentum, as those of APIC do where bodies move on the grid.
        shifts: whether particles of liquids and grains are shifted.
        sticking: per axis, whether a face normal to it sticks or has friction.
        periodic: (d,), whether the domain repeats along each axis.
        bodies: in the order of their labels in the frames.
        laws: in the order of the labels in the frames.
        end: s; frames: expected, the initial one included.
        precision: "f32" or "f64"; backend: "arch" and "precision", in older files "threads" too.
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
    driven: bool
    comes_and_goes: bool
    drops: bool
    open_axes: tuple[bool, ...]
    total: bool
    keeps_spin: bool
    shifts: bool
    sticking: tuple[bool, ...] | None
    periodic: np.ndarray
    bodies: tuple[BodyHeader, ...]
    laws: tuple[LawHeader, ...]
    end: float | None
    frames: int | None
    precision: str
    backend: Mapping[str, Any]

    @classmethod
    def of(cls, scene: Scene, text: str, laws: Sequence[LawFacts], backend: Mapping[str, Any]) -> "RunHeader":
        """Return the header of a run that begins; `text` is the complete scene as TOML, laws as in `Frame.material`."""
        # A shape that is read from a file may be gone later.
        from_files = any(body.shape.files for body in scene.bodies)
        return cls.read(
            {
                "version": __version__,
                "title": scene.title,
                "dimension": scene.dimension,
                "spacing": scene.domain.spacing,
                "origin": list(scene.domain.origin),
                "size": list(scene.domain.size),
                "bodies": [body.name for body in scene.sources],
                **({"volumes": [body.shape.form.volume for body in scene.bodies]} if from_files else {}),
                "materials": [law.name for law in laws],
                "laws": [
                    {"deformation": law.deformation, "coherent": law.coherent, "projects": law.projects} for law in laws
                ],
                "precision": backend["precision"],
                # The bytes of a result do not depend on threads; run.json has their number.
                "backend": {name: value for name, value in backend.items() if name != "threads"},
                "scene": text,
            }
            | ({"emitter_volumes": emitted_volumes(scene)} if scene.emitters else {})
        )

    @classmethod
    def read(cls, stored: Mapping[str, Any]) -> "RunHeader":
        """Read a header, and from the scene's text what it lacks; ValueError: an entry has another type than ours."""
        require_kinds("header", stored)
        scene = _parsed(stored.get("scene", ""))
        require_kinds("scene", scene)
        domain, time, solver = (scene.get(name, {}) for name in ("domain", "time", "solver"))
        d = int(stored.get("dimension", 0)) or len(domain.get("size", (0, 0)))
        origin = _vector(stored.get("origin", domain.get("origin")), d)
        size = _vector(stored.get("size", domain.get("size")), d)
        placed = origin is not None and size is not None
        gravity = domain.get("gravity", ())
        timed = any(isinstance(entry, str) for entry in gravity)
        steady = _vector([0.0 if isinstance(entry, str) else entry for entry in gravity], d)
        words = words_of(domain.get("walls"), d)
        periodic = np.array([PERIODIC in pair for pair in words] if words else [False] * d)
        runs_on = steady is not None and bool(steady[periodic].any())
        total = solver.get("solids", _SOLIDS) == "total"
        opens = tuple("open" in pair for pair in words or ())
        # The volume of an emitter is that of all its particles, which its shape alone does not say.
        tables = [*scene.get("bodies", []), *scene.get("emitters", [])]
        own = stored.get("volumes") or [None] * len(scene.get("bodies", []))
        volumes = [*own, *stored.get("emitter_volumes", ())]
        return cls(
            stored=dict(stored),
            title=str(stored.get("title") or ""),
            version=stored.get("version"),
            dimension=d,
            spacing=stored.get("spacing", domain.get("spacing")),
            origin=origin if placed else None,
            upper=origin + size if placed else None,
            gravity=None if timed else steady,
            steady_gravity=steady,
            driven=timed
            or runs_on
            or bool(domain.get("wall_velocity"))
            or any(map(scene.get, ("forces", "impulses", "emitters")))
            or any(opens),
            comes_and_goes=bool(scene.get("emitters")) or any(opens),
            drops=bool(scene.get("output", {}).get("drop_retired")),
            open_axes=opens,
            total=total,
            keeps_spin=solver.get("transfer", _TRANSFER) == "apic" and not total,
            # A scene is stored with all of its keys: what lacks this one is older.
            shifts=solver.get("redistribute") == "auto",
            sticking=sticking_axes(words, domain.get("friction", 0.0)),
            periodic=periodic,
            bodies=body_headers([str(name) for name in stored.get("bodies", ())], tables, volumes, d),
            laws=_laws(stored),
            end=time.get("end"),
            frames=time["frames"] + 1 if isinstance(time.get("frames"), int) else None,
            precision=stored.get("precision", "f32"),
            backend=stored.get("backend") or {},
        )

    @cached_property
    def _scene(self) -> Mapping[str, Any]:
        return _parsed(self.stored.get("scene", ""))

    @property
    def collider_names(self) -> tuple[str, ...]:
        """Names of the colliders, in the order of the ledger's columns."""
        return tuple(str(table.get("name", "")) for table in self._scene.get("colliders", ()))

    @cached_property
    def colliders(self) -> tuple[Collider, ...]:
        """The colliders that the scene tells all of; one whose mesh is not found is left out."""
        return tuple(collider for collider in self.read_colliders({}) if collider is not None)

    @cached_property
    def moved(self) -> bool:
        """Whether a collider moves, which does work; also where it is not known."""
        return any(collider is None or collider.motion.moves for collider in self.read_colliders({}))

    def read_colliders(self, surfaces: Mapping[int, ClosedSurface]) -> tuple[Collider | None, ...]:
        """Read the colliders, None where that fails; `surfaces`, by number, take the place of those in files."""
        constants, _ = definitions(self._scene.get("constants"), self.dimension)
        context = {"dimension": self.dimension, "constants": constants}
        tables = self._scene.get("colliders", ())
        return tuple(_collider(table, context, surfaces.get(k)) for k, table in enumerate(tables))

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the bodies, in the order of their labels in the frames."""
        return tuple(body.name for body in self.bodies)

    @cached_property
    def densities(self) -> tuple[float, ...]:
        """Density of each body at rest, kg/m^3; empty where one is not known, or the volume of one."""
        known = all(body.volume is not None and body.density is not None for body in self.bodies)
        return tuple(body.density for body in self.bodies) if known else ()

    @property
    def epsilon(self) -> float:
        """Relative rounding of the solver's numbers."""
        return float(np.finfo(np.float64 if self.precision == "f64" else np.float32).eps)

    @property
    def on_gpu(self) -> bool:
        """Whether the Courant numbers of the ledger are estimates."""
        return self.backend.get("arch", "cpu") != "cpu"

    @cached_property
    def farthest(self) -> float:
        """Largest coordinate of the domain, m: what the rounding of stored positions is relative to; 0 if not known."""
        return 0.0 if self.origin is None else float(np.abs([self.origin, self.upper]).max())

    @cached_property
    def step_error(self) -> float:
        """Rounding of a position in one step, m: the solver counts from the corner of the domain."""
        return 0.0 if self.origin is None else self.epsilon * float((self.upper - self.origin).max())

    def place_error(self, stored: np.dtype) -> float:
        """Return the rounding of a position in a file of this type, m, that of the solver included."""
        return self.step_error + float(np.finfo(stored).eps) * self.farthest

    def shifted(self, steps: int, last: int) -> float:
        """Return the farthest that shifts move a particle in so many steps up to the last one, m, of one per cell."""
        shifts = last // INTERVAL - (last - steps) // INTERVAL
        return shifts * 2 * FARTHEST * self.spacing if self.shifts and self.spacing is not None else 0.0

    def way(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return the ways between places, (..., d), m, less than half of the domain along axes that repeat."""
        found = end - start
        for a in np.flatnonzero(self.periodic):
            size = (self.upper - self.origin)[a].astype(found.dtype)
            found[..., a] -= size * np.round(found[..., a] / size)
        return found

    def body_name(self, label: int) -> str:
        """Return the name of a body, or its number where it has none."""
        return self.bodies[label].name if 0 <= label < len(self.bodies) else f"number {label}"

    def masses(self, body: np.ndarray) -> np.ndarray | None:
        """Return the mass of each particle, (n,) float64, kg, from the labels (n,); None where it is not known."""
        if self.drops or not self.densities or len(body) == 0 or body.min() < 0 or body.max() >= len(self.bodies):
            return None
        counts = np.bincount(body, minlength=len(self.bodies))
        volumes = np.array([body.volume for body in self.bodies]) / np.maximum(counts, 1)
        masses = np.array(self.densities) * volumes
        # As the solver holds them, so that sums agree to the last digits.
        kept = masses.astype(np.float64 if self.precision == "f64" else np.float32).astype(np.float64)
        return kept[body]


def _parsed(text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    # Also of numbers that are too long, and of lists that are too deep.
    except (ValueError, RecursionError):
        return {}


def _vector(values: object, d: int) -> np.ndarray | None:
    return np.array(values, dtype=np.float64) if isinstance(values, list | tuple) and len(values) == d else None


def _laws(stored: Mapping[str, Any]) -> tuple[LawHeader, ...]:
    """Return the laws; an older file has their names only, and nothing is known of a law that mpmcli does not have."""
    names = [str(name) for name in stored.get("materials", ())]
    facts = stored.get("laws", ())
    if len(facts) == len(names) and all(isinstance(entry, dict) for entry in facts):
        return tuple(LawHeader(name, **entry) for name, entry in zip(names, facts, strict=True))
    from mpmcli.materials.registry import laws

    known = {name: LawHeader(name, law.deformation, law.coherent) for name, law in laws().items()}
    return tuple(known.get(name, LawHeader(name, "F", False)) for name in names)
