"""Colourings of particles: by a value with its unit and limits, or by category; `--color-by` selects one."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.output.result import Result
from mpmcli.render.frame_choice import evenly_spaced
from mpmcli.render.render_scene import RenderScene
from mpmcli.render.settings import LIMIT_MAX, LIMIT_MIN, Theme, rgb_bytes
from mpmcli.scene.problem import hint_at, listed
from mpmcli.scene.schema import ParticleField

# Values available in every result, and values that need a stored field.
ALWAYS = ("speed", "material", "body", "id")
DERIVED = ("density", "pressure", "J", "stress")
# Units of the fields that have one.
UNITS = {
    "velocity": "m/s",
    "density": "kg/m³",
    "pressure": "Pa",
    "stress": "Pa",
    "mass": "kg",
    "initial_position": "m",
    "affine": "1/s",
}
# Perceptually uniform maps; the diverging one is for values on both sides of a neutral value.
SEQUENTIAL, DIVERGING = "viridis", "coolwarm"
LOOKED_AT = 12  # maximum number of frames, evenly spaced, from which limits are computed
OUTSIDE = 0.01  # fraction of the particles of a frame that may lie beyond the limits, at each end
# Colours of bodies that colour-blind people can distinguish (Okabe and Ito 2008, Color universal design).
BODY_INKS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#b0a410", "#8a8a8a")
# Values that exceed the neutral one on one side by less than this fraction of their range count as one-sided.
ONE_SIDED = 0.02
AXES = "xyz"


@dataclass(frozen=True)
class Coloring:
    """Colours by value."""

    name: str
    unit: str  # "" if there is none
    fields: tuple[str, ...]  # fields to read of each frame
    value: Callable[[Frame], np.ndarray]  # returns (n,) float64 for a frame; NaN if missing
    cmap: str = SEQUENTIAL  # name of a colour map of matplotlib
    limits: tuple[float, float] = (0.0, 1.0)  # the values at its two ends, the same for all frames
    missing: str = ""  # "#rrggbb" of missing values
    middle: float | None = None  # the neutral value, if there is one
    floor: float | None = None  # the smallest value, if there is one

    def values(self, frame: Frame) -> np.ndarray:
        """Return (n,) float64; a quotient by zero is a missing value."""
        with np.errstate(all="ignore"):
            return self.value(frame)

    def particle_rgb(self, frame: Frame) -> np.ndarray:
        """Return (n, 3) uint8."""
        return self.rgb(self.values(frame))

    def rgb(self, values: np.ndarray) -> np.ndarray:
        """Return the colours (..., 3) uint8 of values (...)."""
        import matplotlib as mpl

        low, high = self.limits
        with np.errstate(all="ignore"):
            share = np.where(np.isfinite(values), (values - low) / (high - low), np.nan)
        # Matplotlib treats nan as bad.
        return mpl.colormaps[self.cmap].with_extremes(bad=self.missing)(share, bytes=True)[..., :3]


@dataclass(frozen=True)
class Categories:
    """Colours by category: the body or the material of a particle."""

    name: str  # of the property, such as "material"
    names: tuple[str, ...]  # of each category
    inks: tuple[str, ...]  # "#rrggbb" of each category
    kind_of: tuple[int, ...]  # (b,) category of each body
    fields: tuple[str, ...] = ()

    def particle_rgb(self, frame: Frame) -> np.ndarray:
        """Return (n, 3) uint8."""
        table = np.array([rgb_bytes(ink) for ink in self.inks], np.uint8)
        return table[np.array(self.kind_of)[np.clip(frame.body, 0, len(self.kind_of) - 1)]]


def color_by(
    name: str,
    result: Result,
    scene: RenderScene,
    theme: Theme,
    limits: tuple[float, float] | None = None,
    cmap: str | None = None,
) -> Coloring | Categories:
    """Return the colouring of a result by the name of a value.

    The name is one of `ALWAYS` and `DERIVED`, or a stored field: a vector is shown by its length, a tensor by its
    Frobenius norm, `stress.xy` is one component. By default 98 % of the particles of a dozen frames lie within the
    limits.
    """
    if name == "material":
        return material_colors(scene, [appearance.ink for appearance in scene.appearances])
    if name == "body":
        inks = tuple(BODY_INKS[k % len(BODY_INKS)] for k in range(len(scene.bodies)))
        return Categories("body", scene.bodies, inks, tuple(range(len(scene.bodies))))
    colors = _value(name, result, scene)
    limits = limits or _limits(colors, result)
    two_way = colors.middle is not None and limits[0] < colors.middle < limits[1]
    cmap = color_map(cmap, DIVERGING if two_way else SEQUENTIAL)
    return replace(colors, cmap=cmap, limits=limits, missing=theme.missing)


def material_colors(scene: RenderScene, inks: Sequence[str]) -> Categories:
    """Return colours by material, "#rrggbb" of each."""
    names = tuple(appearance.title for appearance in scene.appearances)
    return Categories("material", names, tuple(inks), scene.material_of)


def _value(name: str, result: Result, scene: RenderScene) -> Coloring:
    """Return the colouring by speed, id, density, J or von Mises stress, or else by a stored field."""
    stored = result.field_names
    densities = np.array(scene.densities)
    if name == "speed":
        return Coloring("speed", "m/s", (), lambda f: np.linalg.norm(f.velocity.astype(np.float64), axis=1), floor=0.0)
    if name == "id":
        return Coloring("particle", "", (), lambda frame: np.arange(len(frame.position), dtype=np.float64))
    if name == "density" and "density" not in stored and "volume_ratio" in stored:
        fields = ("volume_ratio",)
        return Coloring("density", "kg/m³", fields, lambda f: densities[f.body] / _scalar(f, "volume_ratio"))
    if name == "J":
        if "volume_ratio" in stored:
            return Coloring("J", "", ("volume_ratio",), lambda frame: _scalar(frame, "volume_ratio"), middle=1.0)
        if "density" in stored:
            return Coloring("J", "", ("density",), lambda f: densities[f.body] / _scalar(f, "density"), middle=1.0)
        raise _not_stored(name, result, "volume_ratio")
    elif name == "stress" and "stress" in stored:
        return Coloring("von Mises stress", "Pa", ("stress",), lambda f: _von_mises(f.fields["stress"]), floor=0.0)
    return _field(name, result)


def _field(name: str, result: Result) -> Coloring:
    """Return the colouring by a field, its norm or a component. Raises InputError if it is not stored."""
    field, _, component = name.partition(".")
    if field not in (*result.field_names, "velocity"):
        raise _not_stored(name, result, field)
    unit = UNITS.get(field, "")
    fields = () if field == "velocity" else (field,)

    def array(frame: Frame) -> np.ndarray:
        values = frame.velocity if field == "velocity" else frame.fields[field]
        return np.asarray(values, dtype=np.float64).reshape(len(frame.position), math.prod(values.shape[1:]))

    width = array(result.present_frame(0, fields)).shape[1]
    plain = field.replace("_", " ")
    if not component:
        if width == 1:
            return Coloring(plain, unit, fields, lambda frame: array(frame)[:, 0])
        return Coloring(f"|{plain}|", unit, fields, lambda frame: np.linalg.norm(array(frame), axis=1), floor=0.0)
    # In 2D the stress has three axes, and so may other fields.
    known = next((list(AXES[:n]) for n in (2, 3) if width == n), [])
    known = next(([a + b for a in AXES[:n] for b in AXES[:n]] for n in (2, 3) if width == n * n), known)
    if component not in known:
        right = f"its components are {listed(known, 'and')}" if known else "it is one number"
        right = right if known or width == 1 else f"its {width} have no names"
        raise InputError(f'--color-by {name}: "{field}" has no component "{component}"; {right}.')
    column = known.index(component)
    return Coloring(f"{plain} {component}", unit, fields, lambda frame: array(frame)[:, column], middle=0.0)


def _not_stored(name: str, result: Result, field: str) -> InputError:
    known = ["velocity", *result.field_names]
    holds = f'--color-by {name}: {result.path} stores no "{field}", but {listed(known, "and")}'
    storable = get_args(ParticleField)
    if field in storable:
        return InputError(f'{holds}; to store it, add "{field}" to output.fields of the scene and run it again.')
    named = f"{listed([*ALWAYS, *DERIVED], 'and')} have names of their own."
    return InputError(f"{holds}; {hint_at(field, [*ALWAYS, *DERIVED, *known, *storable], named)}")


def _limits(value: Coloring, result: Result) -> tuple[float, float]:
    """Return limits between which nearly all particles of the whole result lie."""
    ends = []
    for k in evenly_spaced(range(result.frame_count), LOOKED_AT):
        values = value.values(result.present_frame(k, value.fields))
        values = np.clip(values[np.isfinite(values)], -LIMIT_MAX, LIMIT_MAX)
        if len(values):
            ends.append(np.quantile(values, (OUTSIDE, 1.0 - OUTSIDE)).tolist())
    low, high = (min(low for low, _ in ends), max(high for _, high in ends)) if ends else (0.0, 1.0)
    if value.floor is not None:
        low = value.floor
    if value.middle is not None and min(high - value.middle, value.middle - low) > ONE_SIDED * (high - low):
        reach = max(abs(high - value.middle), abs(low - value.middle))
        low, high = value.middle - reach, value.middle + reach
    if high - low <= max(1e-6 * max(abs(low), abs(high)), LIMIT_MIN):
        # A constant value gets the middle of the map, whatever its rounding.
        reach = 0.05 * max(abs(low), abs(high))
        reach = reach if reach > LIMIT_MIN else 1.0
        low, high = low - reach * (value.floor is None), high + reach
    return low, high


def color_map(name: str | None, usual: str = SEQUENTIAL) -> str:
    """Return the name of a colour map, the usual one for None; InputError: matplotlib has no such map."""
    import matplotlib as mpl

    if name is None:
        return usual
    if name not in mpl.colormaps:
        hint = hint_at(name, list(mpl.colormaps), "viridis, cividis, magma, coolwarm are some.")
        raise InputError(f'--cmap "{name}" is not a colour map of matplotlib; {hint}')
    return name


def _scalar(frame: Frame, field: str) -> np.ndarray:
    return np.asarray(frame.fields[field], dtype=np.float64)


def _von_mises(stress: np.ndarray) -> np.ndarray:
    """Return sqrt(3/2 s : s), s the deviator of the stress (n, 3, 3), or of the in-plane stress (n, 2, 2)."""
    d = stress.shape[1] if stress.ndim == 3 else round(stress.shape[1] ** 0.5)
    tensor = np.asarray(stress, dtype=np.float64).reshape(len(stress), d, d)
    deviator = tensor - np.trace(tensor, axis1=1, axis2=2)[:, None, None] / d * np.eye(d)
    return np.sqrt(1.5 * np.square(deviator).sum(axis=(1, 2)))
