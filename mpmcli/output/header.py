"""The header of a run: the facts about its scene, laws and backend that every reader of the frames needs."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from mpmcli import __version__
from mpmcli.output.header_walls import sticking_axes, words_of
from mpmcli.output.scene_header import BodyHeader, body_headers, volumes_from_files
from mpmcli.output.stored_colliders import ColliderFacts
from mpmcli.output.stored_facts import require_header, require_scene
from mpmcli.scene import Scene
from mpmcli.scene.schema import SolverSettings
from mpmcli.scene.sheets import emitted_volumes
from mpmcli.scene.wall_rules import PERIODIC

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
class RunHeader(ColliderFacts):
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
                "bodies": [body.name for body in scene.sources],
                **volumes_from_files(scene),
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
        """Read the header that a file holds; what it does not say itself is taken from the scene's text in it.

        Raises:
            ValueError: an entry has another type than a run writes.
        """
        require_header(stored)
        scene = _parsed(stored.get("scene", ""))
        require_scene(scene)
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
            sticking=sticking_axes(words, domain.get("friction", 0.0)),
            periodic=periodic,
            bodies=body_headers([str(name) for name in stored.get("bodies", ())], tables, volumes, d),
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

    def way(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return the shortest ways from some places to others, (..., d), m: across a periodic face where that is less.

        That is what a particle moved between two frames, if it is less than half of the domain.
        """
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
