"""What a result's header says of its scene, as far as checks and pictures of the frames need it."""

import tomllib
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError

from mpmcli.scene.domain import Walls
from mpmcli.scene.shapes import Shape


@dataclass(frozen=True)
class SceneFacts:
    """Facts of a run, each None, or empty, where the header does not tell.

    Attributes:
        dimension: d, 2 or 3.
        spacing: h, m.
        origin, upper: corners of the domain, (d,), m.
        gravity: (d,), m/s^2; None where it depends on time.
        driven: whether forces act, or gravity depends on time: energy and momentum have a source then.
        spin_kept: whether the transfers keep angular momentum, as those of APIC do.
        sticking: per axis, whether a face normal to it sticks.
        bodies, laws: names, in the order of the labels in the frames.
        densities: at rest, of each body, kg/m^3.
        volumes: of each body's shape, m^3 (m^2 in 2D).
        end: s; frames: expected, the initial one included.
        epsilon: relative rounding of the solver's numbers.
        on_gpu: whether the Courant numbers of the ledger are estimates.
    """

    dimension: int
    spacing: float | None
    origin: np.ndarray | None
    upper: np.ndarray | None
    gravity: np.ndarray | None
    driven: bool
    spin_kept: bool
    sticking: tuple[bool, ...] | None
    bodies: tuple[str, ...]
    laws: tuple[str, ...]
    densities: tuple[float, ...]
    volumes: tuple[float, ...]
    end: float | None
    frames: int | None
    epsilon: float
    on_gpu: bool

    @property
    def farthest(self) -> float:
        """Largest coordinate of the domain, m: what the rounding of stored positions is relative to; 0 if not known."""
        return 0.0 if self.origin is None else float(np.abs([self.origin, self.upper]).max())

    @property
    def step_error(self) -> float:
        """Rounding of a position in one step, m: the solver counts from the corner of the domain."""
        return 0.0 if self.origin is None else self.epsilon * float((self.upper - self.origin).max())

    def place_error(self, stored: np.dtype) -> float:
        """Return the rounding of a position in a file of this type, m, that of the solver included."""
        return self.step_error + float(np.finfo(stored).eps) * self.farthest

    def body_name(self, label: int) -> str:
        """Return the name of a body, or its number where it has none."""
        return self.bodies[label] if 0 <= label < len(self.bodies) else f"number {label}"

    def masses(self, body: np.ndarray) -> np.ndarray | None:
        """Return the mass of each particle, (n,) float64, kg, from the labels (n,); None where it is not known."""
        if not self.volumes or len(body) == 0 or body.min() < 0 or body.max() >= len(self.volumes):
            return None
        counts = np.bincount(body, minlength=len(self.volumes))
        volumes = np.array(self.volumes) / np.maximum(counts, 1)
        masses = np.array(self.densities) * volumes
        # As the solver holds them, so that sums agree to the last digits.
        kept = masses.astype(np.float32 if self.epsilon > 1e-10 else np.float64).astype(np.float64)
        return kept[body]


def scene_facts(header: dict[str, Any]) -> SceneFacts:
    """Read the facts off a header, and off the TOML text of the scene in it."""
    scene = _parsed(header.get("scene", ""))
    domain, bodies = scene.get("domain", {}), scene.get("bodies", [])
    d = int(header.get("dimension", 0)) or len(domain.get("size", (0, 0)))
    origin = _vector(header.get("origin", domain.get("origin")), d)
    size = _vector(header.get("size", domain.get("size")), d)
    volumes = [_volume(body.get("shape", {}), d) for body in bodies]
    densities = [body.get("material", {}).get("density") for body in bodies]
    known = None not in volumes and None not in densities
    gravity = domain.get("gravity")
    timed = isinstance(gravity, list) and any(isinstance(entry, str) for entry in gravity)
    time = scene.get("time", {})
    precision = header.get("precision", "f32")
    return SceneFacts(
        dimension=d,
        spacing=header.get("spacing", domain.get("spacing")),
        origin=origin if size is not None else None,
        upper=None if origin is None or size is None else origin + size,
        gravity=None if timed else _vector(gravity, d),
        driven=timed or bool(scene.get("forces")),
        spin_kept=scene.get("solver", {}).get("transfer", "apic") == "apic",
        sticking=_sticking(domain.get("walls"), d),
        bodies=tuple(header.get("bodies", ())),
        laws=tuple(header.get("materials", ())),
        densities=tuple(densities) if known else (),
        volumes=tuple(volumes) if known else (),
        end=time.get("end"),
        frames=time["frames"] + 1 if isinstance(time.get("frames"), int) else None,
        epsilon=float(np.finfo(np.float64 if precision == "f64" else np.float32).eps),
        on_gpu=(header.get("backend") or {}).get("arch", "cpu") != "cpu",
    )


def _parsed(text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return {}


def _vector(values: object, d: int) -> np.ndarray | None:
    return np.array(values, dtype=np.float64) if isinstance(values, list | tuple) and len(values) == d else None


def _volume(shape: dict, d: int) -> float | None:
    try:
        return Shape.model_validate(shape, context={"dimension": d}).form.volume
    except (ValidationError, StopIteration):
        return None


def _sticking(walls: dict | str | None, d: int) -> tuple[bool, ...] | None:
    if walls is None:
        return None
    try:
        table = {"default": walls} if isinstance(walls, str) else walls
        faces = Walls.model_validate(table, context={"dimension": d}).faces(d)
    except ValidationError:
        return None
    return tuple("stick" in pair for pair in faces)
