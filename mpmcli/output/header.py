"""The header of a run: the facts about its scene, laws and backend that every reader of the frames needs."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from pydantic import ValidationError

from mpmcli import __version__
from mpmcli.scene import Scene
from mpmcli.scene.domain import Walls
from mpmcli.scene.quantity import AXES
from mpmcli.scene.schema import SolverSettings, usual_particles_per_cell
from mpmcli.scene.shapes import Shape

# Of a scene that does not say.
_TRANSFER, _SOLIDS = (SolverSettings.model_fields[name].default for name in ("transfer", "solids"))


class LawFacts(Protocol):
    """What a header keeps of a constitutive law.

    Attributes:
        name: the word for it in a scene.
        deformation: what a particle stores, "J" or "F".
        coherent: whether the material resists being pulled apart.
        projects: whether it may yield or flow.
    """

    name: str
    deformation: str
    coherent: bool
    projects: bool


@dataclass(frozen=True)
class LawHeader:
    """A constitutive law of the run; see `LawFacts`."""

    name: str
    deformation: str
    coherent: bool
    # Of laws in older files it is not known.
    projects: bool = True


@dataclass(frozen=True)
class BodyHeader:
    """A body of the scene.

    Attributes:
        name: of the body.
        material: its table in the scene: "law", "density", and the parameters of the law; {} where not known.
        volume: of its shape, m^3 (m^2 in 2D); None where not known.
        particles_per_cell: at the start.
    """

    name: str
    material: Mapping[str, Any]
    volume: float | None
    particles_per_cell: float

    @property
    def density(self) -> float | None:
        """At rest, kg/m^3; None where not known."""
        return self.material.get("density")


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
        driven: whether forces act, or gravity depends on time: energy and momentum have a source then.
        total: whether elastic bodies are on the grid of their state at rest.
        keeps_spin: whether the transfers conserve angular momentum, as those of APIC do where bodies move on the grid.
        sticking: per axis, whether a face normal to it sticks or has friction.
        bodies: in the order of their labels in the frames.
        laws: in the order of the labels in the frames.
        end: s; frames: expected, the initial one included.
        precision: "f32" or "f64"; backend: "arch", "threads" and "precision".
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
    total: bool
    keeps_spin: bool
    sticking: tuple[bool, ...] | None
    bodies: tuple[BodyHeader, ...]
    laws: tuple[LawHeader, ...]
    end: float | None
    frames: int | None
    precision: str
    backend: Mapping[str, Any]

    @classmethod
    def of(cls, scene: Scene, text: str, laws: Sequence[LawFacts], backend: Mapping[str, Any]) -> "RunHeader":
        """Return the header of a run that begins.

        Args:
            text: the scene as TOML, with every default filled in.
            laws: in the order of `Frame.material`.
            backend: "arch", "threads" and "precision".
        """
        return cls.read(
            {
                "version": __version__,
                "title": scene.title,
                "dimension": scene.dimension,
                "spacing": scene.domain.spacing,
                "origin": list(scene.domain.origin),
                "size": list(scene.domain.size),
                "bodies": [body.name for body in scene.bodies],
                "materials": [law.name for law in laws],
                "laws": [
                    {"deformation": law.deformation, "coherent": law.coherent, "projects": law.projects} for law in laws
                ],
                "precision": backend["precision"],
                "backend": dict(backend),
                "scene": text,
            }
        )

    @classmethod
    def read(cls, stored: Mapping[str, Any]) -> "RunHeader":
        """Read the header that a file holds; what it does not say itself is taken from the scene's text in it."""
        scene = _parsed(stored.get("scene", ""))
        domain, time, solver = (scene.get(name, {}) for name in ("domain", "time", "solver"))
        d = int(stored.get("dimension", 0)) or len(domain.get("size", (0, 0)))
        origin = _vector(stored.get("origin", domain.get("origin")), d)
        size = _vector(stored.get("size", domain.get("size")), d)
        placed = origin is not None and size is not None
        gravity = domain.get("gravity", ())
        timed = any(isinstance(entry, str) for entry in gravity)
        steady = _vector([0.0 if isinstance(entry, str) else entry for entry in gravity], d)
        total = solver.get("solids", _SOLIDS) == "total"
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
            driven=timed or bool(scene.get("forces")),
            total=total,
            keeps_spin=solver.get("transfer", _TRANSFER) == "apic" and not total,
            sticking=_sticking(domain.get("walls"), domain.get("friction", 0.0), d),
            bodies=_bodies([str(name) for name in stored.get("bodies", ())], scene.get("bodies", []), d),
            laws=_laws(stored),
            end=time.get("end"),
            frames=time["frames"] + 1 if isinstance(time.get("frames"), int) else None,
            precision=stored.get("precision", "f32"),
            backend=stored.get("backend") or {},
        )

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

    def body_name(self, label: int) -> str:
        """Return the name of a body, or its number where it has none."""
        return self.bodies[label].name if 0 <= label < len(self.bodies) else f"number {label}"

    def masses(self, body: np.ndarray) -> np.ndarray | None:
        """Return the mass of each particle, (n,) float64, kg, from the labels (n,); None where it is not known."""
        if not self.densities or len(body) == 0 or body.min() < 0 or body.max() >= len(self.bodies):
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
    except tomllib.TOMLDecodeError:
        return {}


def _vector(values: object, d: int) -> np.ndarray | None:
    return np.array(values, dtype=np.float64) if isinstance(values, list | tuple) and len(values) == d else None


def _laws(stored: Mapping[str, Any]) -> tuple[LawHeader, ...]:
    """Return the laws; an older file has their names only, and nothing is known of a law that mpmcli does not have."""
    names = [str(name) for name in stored.get("materials", ())]
    facts = stored.get("laws", ())
    if len(facts) == len(names):
        return tuple(LawHeader(name, **entry) for name, entry in zip(names, facts, strict=True))
    from mpmcli.materials.registry import laws

    known = {name: LawHeader(name, law.deformation, law.coherent) for name, law in laws().items()}
    return tuple(known.get(name, LawHeader(name, "F", False)) for name in names)


def _bodies(names: Sequence[str], tables: Sequence[Mapping[str, Any]], d: int) -> tuple[BodyHeader, ...]:
    """Return the bodies with these names; where the scene has other ones, their names are all that is known."""
    tables = tables if len(tables) == len(names) else [{} for _ in names]
    return tuple(
        BodyHeader(
            name,
            table.get("material", {}),
            _volume(table.get("shape", {}), d),
            table.get("particles_per_cell", usual_particles_per_cell(d)),
        )
        for name, table in zip(names, tables, strict=True)
    )


def _volume(shape: Mapping[str, Any], d: int) -> float | None:
    try:
        return Shape.model_validate(shape, context={"dimension": d}).form.volume
    except (ValidationError, StopIteration):
        return None


def _sticking(
    walls: Mapping[str, str] | str | None, friction: Mapping[str, float] | float, d: int
) -> tuple[bool, ...] | None:
    if walls is None:
        return None
    numbers = friction if isinstance(friction, Mapping) else {"default": friction}
    table = {"default": walls} if isinstance(walls, str) else walls
    try:
        faces = Walls.model_validate(table, context={"dimension": d}).faces(d)
    except ValidationError:
        return None
    rough = [numbers.get("default", 0) > 0 or any(numbers.get(f"{a}_{s}", 0) > 0 for s in ("min", "max")) for a in AXES]
    return tuple("stick" in pair or rubs for pair, rubs in zip(faces, rough, strict=False))
