"""The scene of a picture: the domain of a run or of a scene, its materials, and groups of particles."""

import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, TypeVar

import numpy as np

from mpmcli.errors import InputError
from mpmcli.frames.frame import STATUS, Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output.header import BodyHeader, RunHeader
from mpmcli.output.result import Result, open_result
from mpmcli.output.store import SegmentStore
from mpmcli.plain_text import one_line
from mpmcli.render.particle_grid import drawable
from mpmcli.render.settings import Arrow, lighter
from mpmcli.scene import BodyParticles, Scene, sample_bodies, scene_to_toml
from mpmcli.scene.colliders import Collider, Plane
from mpmcli.scene.entry import value_of
from mpmcli.scene.expand import PRESETS
from mpmcli.scene.expression import INITIAL, POSITION, VELOCITY, evaluate
from mpmcli.scene.schema import usual_particles_per_cell

T = TypeVar("T")
# Kinds of shading: clear and thin, clear and thick, scattering inside, white crumbs, loose grains, bare metal, dull.
Finish = Literal["water", "syrup", "translucent", "crumbly", "grains", "metal", "matte"]


@dataclass(frozen=True)
class Appearance:
    """The appearance of one material; colours are "#rrggbb"."""

    name: str  # name of the nearest preset, or of its law
    color: str  # of the lit surface
    ink: str  # of dots and legends: distinguishable from all others on a light and on a dark background
    finish: Finish
    liquid: bool = False  # flows as one body, which dots do not show
    label: str = ""  # in legends, in place of the name

    @property
    def title(self) -> str:
        """Its name in legends and file names."""
        return self.label or self.name


APPEARANCES = {
    "water": Appearance("water", "#3b8fd4", "#2f7fd0", "water", liquid=True),
    "honey": Appearance("honey", "#e8960c", "#e88a00", "syrup", liquid=True),
    "lava": Appearance("lava", "#c8321a", "#d62f1f", "syrup", liquid=True),
    "mud": Appearance("mud", "#74543a", "#8a5a33", "matte", liquid=True),
    "jelly": Appearance("jelly", "#58b84c", "#3fa34d", "translucent"),
    "rubber": Appearance("rubber", "#5a4a8a", "#7a5fc0", "matte"),
    "snow": Appearance("snow", "#f2f6fb", "#8fb8dc", "crumbly"),
    "sand": Appearance("sand", "#d9b56d", "#c9a040", "grains"),
    "clay": Appearance("clay", "#b8694a", "#c4704e", "matte"),
    "metal": Appearance("metal", "#a4acb6", "#8a95a3", "metal"),
}
# Colours of laws without a preset, in the order of appearance.
OTHERS = ("#0f9d8a", "#c2569b", "#7d8a2e", "#4e6fb8", "#b0563c")
UNSEEN = {"law", "surface_friction"}  # parameters that do not affect the look of a material
ALIKE = 1e-12  # distance of materials below which they are the same
PARALLEL = 0.9  # cosine above which an axis is too close to that of a rotation to serve as an arm
NOTHING_YET = dict.fromkeys(("kinetic", "elastic", "potential", "mass", "speed_max", "courant_max"), 0.0)
LOAD_TIMES = 32  # times of a run at which loads are evaluated
COHERENT = 0.5  # least ratio of a resultant to the sum of the magnitudes of forces: a vortex has no arrow
FAR = 1e6  # upper bound of the ratio of two values of a parameter in the distance between materials


def appearance_of(law: str, parameters: dict[str, Any], others: int = 0) -> Appearance:
    """Return the appearance of the nearest preset: among those of the law and of laws with the same parameters.

    Parameters are those of the effective scene; `others` is how many laws without a preset came before.
    """
    names = parameters.keys() - UNSEEN
    known = {
        name: preset.parameters
        for name, preset in PRESETS.items()
        if name in APPEARANCES and (preset.law == law or preset.parameters.keys() - UNSEEN == names)
    }
    if not known:
        color = OTHERS[others % len(OTHERS)]
        return Appearance(law, color, color, "matte")
    return APPEARANCES[min(known, key=lambda name: _distance(known[name], parameters))]


def _distance(preset: dict[str, Any], parameters: dict[str, Any]) -> float:
    """Return the distance of two sets of parameters: the sum of the squared logarithms of their ratios."""
    total = 0.0
    for name, wanted in preset.items():
        given = parameters.get(name)
        if name in UNSEEN or any(
            isinstance(value, bool) or not isinstance(value, int | float) for value in (wanted, given)
        ):
            continue
        if wanted > 0.0:
            total += min(abs(math.log(max(given, wanted / FAR) / wanted)), math.log(FAR)) ** 2
    return total


@dataclass(frozen=True)
class RenderScene:
    """Facts of a run; b bodies, m materials. Everything is in three dimensions: z = 0 in 2D."""

    title: str
    dimension: int
    lower: tuple[float, ...]  # corners of the domain, (3,), m
    upper: tuple[float, ...]
    up: tuple[float, ...]  # direction against gravity, along an axis, (3,)
    bodies: tuple[str, ...]  # b names
    appearances: tuple[Appearance, ...]  # m, of materials that differ; two of one kind differ in their names
    material_of: tuple[int, ...]  # (b,) index into `appearances`
    distances: tuple[float, ...]  # (b,) between neighbouring particles at the start, m
    densities: tuple[float, ...]  # (b,) at rest, kg/m^3
    colliders: tuple[Collider, ...] = ()  # that are drawn
    held: tuple[Collider, ...] = ()  # colliders that hold a part, which are marked in the start of a scene
    collider_frames: tuple[int, ...] | None = None  # the frame that each collider is in; None where all are in all
    hollow: tuple[int, ...] = ()  # numbers of the colliders in 3D that are cut open, so that what is inside is seen
    towards: tuple[float, ...] = (0.0, 0.0, 0.0)  # the direction (3,) from which they are cut
    faces: tuple[tuple[str, str], ...] = ()  # conditions of the walls of each axis; empty if unknown
    clear: bool = False  # colliders in 3D show only their far sides, as containers do, so that they hide nothing

    def shows(self, number: int, frame: Frame) -> bool:
        """Return whether a collider is in a frame."""
        return self.collider_frames is None or self.collider_frames[number] == frame.index


def render_scene_of(result: Result) -> RenderScene:
    """Read the scene of a result from its header; InputError: it lacks the domain."""
    header, d = result.header, result.dimension
    if header.origin is None or not header.spacing:
        raise InputError(f"{result.path} has no domain in its header, so that no picture can be framed.")
    bodies = header.bodies or (BodyHeader("all", {}, None, usual_particles_per_cell(d)),)
    names = tuple(one_line(body.name) for body in bodies)
    appearances, material_of = _materials(names, [body.material for body in bodies])
    flat, up, gravity = [0.0] * (3 - d), np.zeros(3), header.mean_gravity
    # In 2D, and without gravity, the last axis is upwards.
    up[d - 1] = 1.0
    if d == 3 and gravity is not None and gravity.any():
        axis = int(np.argmax(np.abs(gravity)))
        up = np.where(np.arange(3) == axis, -np.sign(gravity[axis]), 0.0)
    shown = [k for k, collider in enumerate(result.colliders) if not collider.holds]
    return RenderScene(
        title=one_line(header.title),
        dimension=d,
        lower=(*header.origin.tolist(), *flat),
        upper=(*header.upper.tolist(), *flat),
        up=tuple(up.tolist()),
        bodies=names,
        appearances=appearances,
        material_of=material_of,
        distances=tuple(header.spacing / body.particles_per_cell ** (1 / d) for body in bodies),
        densities=tuple(body.density or 1000.0 for body in bodies),
        faces=header.faces,
        # A collider that holds material is not visible.
        colliders=tuple(result.colliders[k] for k in shown),
        held=tuple(collider for collider in result.colliders if collider.holds),
        collider_frames=result.collider_frames and tuple(result.collider_frames[k] for k in shown),
    )


def _materials(
    bodies: Sequence[str], tables: Sequence[Mapping[str, Any]]
) -> tuple[tuple[Appearance, ...], tuple[int, ...]]:
    """Return the appearances of the distinct materials, and the index of that of each body."""
    kinds: list[Mapping[str, Any]] = []
    firsts: list[str] = []
    appearances: list[Appearance] = []
    for body, table in zip(bodies, tables, strict=True):
        if table not in kinds:
            others = sum(appearance.ink in OTHERS for appearance in appearances)
            look = appearance_of(table.get("law", "material"), table, others)
            # Lighter than those of the same name before it.
            share = 1 - 0.7 ** sum(other.name == look.name for other in appearances)
            appearances.append(replace(look, color=lighter(look.color, share), ink=lighter(look.ink, share)))
            kinds.append(table)
            firsts.append(body)
    names = [appearance.name for appearance in appearances]
    for k, (name, body) in enumerate(zip(names, firsts, strict=True)):
        # A viscous water may be nearest to honey but is not honey.
        exact = name in PRESETS and _distance(PRESETS[name].parameters, dict(kinds[k])) < ALIKE
        if not exact or names.count(name) > 1:
            appearances[k] = replace(appearances[k], label=f"{name} ({body})" if exact else body)
    return tuple(appearances), tuple(kinds.index(table) for table in tables)


@dataclass(frozen=True)
class Group:
    """Particles drawn as one body: those of one liquid, or of one solid body."""

    key: tuple[int, int]  # the material, and the body if bodies of one material are separate
    appearance: Appearance
    rows: np.ndarray  # (n,) of the frame
    position: np.ndarray  # (n, d) float64, m
    distance: float  # between neighbouring particles at the start, m; the largest of its bodies

    @property
    def hashes(self) -> np.ndarray:
        """Three numbers from -1 to 1 for each particle, (n, 3) float32, fixed for each row."""
        return np.random.default_rng(1).uniform(-1.0, 1.0, (self.rows.max() + 1, 3)).astype(np.float32)[self.rows]


def groups_of(scene: RenderScene, frame: Frame) -> list[Group]:
    """Return the groups of a frame with particles to draw, in the order of materials and bodies."""
    material_of, distances = np.array(scene.material_of), np.array(scene.distances)
    body = np.clip(frame.body, 0, len(material_of) - 1)
    sound = drawable(frame.position, scene.lower, scene.upper, max(scene.distances))
    groups = []
    for m, appearance in enumerate(scene.appearances):
        bodies = np.flatnonzero(material_of == m).tolist()
        for key, members in [((m, -1), bodies)] if appearance.liquid else [((m, b), [b]) for b in bodies]:
            rows = np.flatnonzero(sound & np.isin(body, members))
            if len(rows):
                distance = float(distances[members].max())
                groups.append(Group(key, appearance, rows, frame.position[rows].astype(np.float64), distance))
    return groups


class SharedGeometry:
    """Keeps what the images of one frame from several cameras have in common."""

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._kept: dict[Hashable, Any] = {}

    def once(self, frame: Frame, key: Hashable, make: Callable[[], T]) -> T:
        """Return make(), called once for a frame and a key."""
        if frame is not self._frame:
            self._frame, self._kept = frame, {}
        if key not in self._kept:
            self._kept[key] = make()
        return self._kept[key]


@contextmanager
def result_of_start(scene: Scene) -> Iterator[tuple[Result, tuple[Arrow, ...]]]:
    """Yield the start of a scene as a result, in a directory that is removed afterwards, its velocities and its loads.

    It includes the first layer of each emitter. Raises InputError as `sample_bodies` does.
    """
    sources, found, d = scene.sources, sample_bodies(scene), scene.dimension
    names = sorted({source.material.law for source in sources})
    counts, none = [len(one.position) for one in found], np.empty((0, d))
    there, arrows = [], []
    for source, one in zip(sources, found, strict=True):
        shown, velocity = len(one.position), one.velocity.mean(axis=0)
        if one.waits:
            shown, velocity = one.sheets.size * one.sheets.per_layer, np.array(source.velocity)
        there.append(np.arange(len(one.position)) < shown)
        arrows.append((one.position[:shown].mean(axis=0), velocity))
    for collider in scene.colliders:
        arrows += _motion_of(collider, d)
    frame = Frame(
        0,
        0.0,
        0,
        np.concatenate([none, *(one.position for one in found)]).astype(np.float32),
        np.concatenate([none, *(np.broadcast_to(one.velocity, one.position.shape) for one in found)]).astype(
            np.float32
        ),
        np.repeat(np.arange(len(sources), dtype=np.int32), counts),
        np.repeat(np.array([names.index(source.material.law) for source in sources], np.int32), counts),
        {STATUS: np.concatenate(there).astype(np.int8)} if scene.particle_count_varies else {},
    )
    zero = (0.0,) * d
    row = LedgerRow(
        0.0, 0, 0.0, 0.0, "", volume_ratio_min=1.0, volume_ratio_max=1.0,
        linear_momentum=zero, angular_momentum=(0.0,) * (1 if d == 2 else 3), **NOTHING_YET,
    )  # fmt: skip
    header = RunHeader.of(
        scene, scene_to_toml(scene), [laws()[name] for name in names], {"precision": scene.solver.precision}
    )
    with TemporaryDirectory() as directory:
        store = SegmentStore(Path(directory), header.stored, colliders=scene.colliders)
        store.write(frame, row)
        store.finish()
        loads = _arrows(_loads(scene, found), "N/m" if d == 2 else "N")
        yield open_result(directory), (*_arrows(arrows, "m/s"), *loads)


def _arrows(vectors: Iterable[tuple[np.ndarray, np.ndarray]], unit: str) -> Iterator[Arrow]:
    """Yield the arrows of vectors of one kind, (d,), at some places, (d,), m, without those that are zero."""
    sized = [(place, vector, float(np.linalg.norm(vector))) for place, vector in vectors]
    longest = max((size for _, _, size in sized), default=0.0)
    for place, vector, size in sized:
        if size > 0.0:
            yield tuple(place.tolist()), tuple((vector / longest).tolist()), f"{size:.3g} {unit}"


def _loads(scene: Scene, found: Sequence[BodyParticles]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield where each force on a body acts, (d,), m, and its resultant, (d,), N: the largest at LOAD_TIMES times."""
    loaded = {one.name: (one.position, one.mass) for one in found if not one.waits}
    loaded |= {one.name: (one.motion.pose(0.0)[0][None], one.moments.mass) for one in scene.colliders if one.free}
    for force in scene.forces:
        if force.body in loaded:
            position, mass = loaded[force.body]
            # At rest.
            places = dict.fromkeys(VELOCITY, 0.0)
            places |= dict(zip((*POSITION[: scene.dimension], *INITIAL), [*position.T] * 2, strict=False))
            forces = (
                mass * np.stack([value_of(a, t=t, **places) + 0.0 * position[:, 0] for a in force.acceleration], axis=1)
                for t in np.linspace(0.0, scene.time.end, LOAD_TIMES)
            )
            largest = max(forces, key=lambda each: np.linalg.norm(each.sum(axis=0)))
            sizes, total = np.linalg.norm(largest, axis=1), largest.sum(axis=0)
            if np.linalg.norm(total) > COHERENT * sizes.sum():
                yield sizes @ position / sizes.sum(), total


def _motion_of(collider: Collider, d: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return points of a collider and their initial velocities: its pivot, and its rim if it rotates."""
    pivot = collider.motion.pose(0.0)[0]
    if collider.free:
        velocity = np.array(collider.rates[:d])
        spin = np.array([0.0, 0.0, collider.spin[0]] if d == 2 else collider.spin)
    else:
        rates = [evaluate(one, {"t": 0.0}) for one in collider.motion.rates]
        velocity, spin = np.array(rates[:d], np.float64), np.array(collider.motion.axis) * rates[d]
    arrows = [(pivot, velocity)]
    if spin.any() and not isinstance(collider.form, Plane):
        axis = spin / np.linalg.norm(spin)
        along = next(a for a in np.eye(3) if abs(a @ axis) < PARALLEL)
        across = np.cross(axis, np.cross(along, axis))
        across /= np.linalg.norm(across)
        half = 0.5 * float(np.ptp(collider.form.bounds(), axis=0) @ np.abs(across[:d]))
        arm = half * across
        arrows.append((pivot + arm[:d], velocity + np.cross(spin, arm)[:d]))
    return arrows
