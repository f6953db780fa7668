"""The state that the particles of a body start with: velocity, its gradient, and deformation, at their places."""

from collections.abc import Iterator

import numpy as np

from mpmcli.scene.derivative import derivative
from mpmcli.scene.domain import Domain
from mpmcli.scene.entry import Entry, value_of, varies
from mpmcli.scene.expression import INITIAL, Expression, evaluate
from mpmcli.scene.problem import Path
from mpmcli.scene.schema import Body


def has_expressions(body: Body) -> bool:
    """Say whether anything that a body starts with depends on the place."""
    return moves_unevenly(body) or body.deformation is not None


def moves_unevenly(body: Body) -> bool:
    """Say whether the velocity of a body, or its gradient, is an expression."""
    return varies(*body.velocity) or replaces_gradient(body)


def replaces_gradient(body: Body) -> bool:
    """Say whether velocity_gradient is the affine velocity C itself, and adds nothing to the velocity."""
    return body.velocity_gradient is not None and varies(*(entry for row in body.velocity_gradient for entry in row))


def initial_motion(body: Body, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the velocity, (n, d), m/s, and the affine velocity C, (n, d, d), 1/s, at some places, (n, d), m.

    C is grad(velocity) + L, and the velocity velocity(X) + L (X - c), where velocity_gradient L is all numbers, c the
    centre of the bounding box; an L with an expression in it is C alone.
    """
    n, d = position.shape
    if not moves_unevenly(body):
        velocity = np.broadcast_to(np.array(body.velocity), position.shape)
        affine = np.zeros((d, d))
        if body.velocity_gradient is not None:
            affine = np.array(body.velocity_gradient)
            velocity = velocity + _offset(body, position) @ affine.T
        return velocity, np.broadcast_to(affine, (n, d, d))
    velocity = entries_at(body.velocity, position)
    if replaces_gradient(body):
        return velocity, matrix_at(body.velocity_gradient, position)
    affine = np.zeros((n, d, d))
    for c, entry in enumerate(body.velocity):
        if isinstance(entry, Expression):
            for a, name in enumerate(INITIAL[:d]):
                affine[:, c, a] = evaluate(derivative(entry.tree, name), _places(position))
    if body.velocity_gradient is not None:
        L = np.array(body.velocity_gradient)
        velocity = velocity + _offset(body, position) @ L.T
        affine = affine + L
    return velocity, affine


def initial_deformation(body: Body, position: np.ndarray, domain: Domain) -> np.ndarray | None:
    """Return J, (n,), or F, (n, d, d), at some places, (n, d), m; None where the body starts undeformed."""
    if body.initial_pressure == "hydrostatic":
        return body.material.volume_ratio_under(hydrostatic_load(body, position, domain))
    if body.deformation is None:
        return None
    if isinstance(body.deformation, tuple):
        return matrix_at(body.deformation, position)
    return np.broadcast_to(value_of(body.deformation, **_places(position)), len(position)).astype(np.float64)


def hydrostatic_load(body: Body, position: np.ndarray, domain: Domain) -> np.ndarray:
    """Return density g depth, (n,), Pa, the depth below the top of the bounding box of the body, against gravity.

    Particles start evenly spaced, with the mass that their spacing has at rest, and act with J p times their volume at
    rest: it is J p that has to carry their weight.
    """
    gravity = domain.gravity_at(0.0)
    lower, upper = body.shape.form.bounds()
    top = np.minimum(gravity * lower, gravity * upper).sum()
    return body.material.density * (position @ gravity - top)


def initial_faults(body: Body, position: np.ndarray, domain: Domain) -> Iterator[tuple[Path, str]]:
    """Yield the keys of a body whose values are not usable at some place, each with a sentence on the first place."""
    d = position.shape[1]
    for c, entry in enumerate(body.velocity):
        yield from _not_finite(("velocity", c), entry, position)
        if isinstance(entry, Expression) and not replaces_gradient(body):
            for name in INITIAL[:d]:
                slope = np.broadcast_to(evaluate(derivative(entry.tree, name), _places(position)), len(position))
                where = _first(~np.isfinite(slope), position)
                if where and np.isfinite(value_of(entry, **_places(position))).all():
                    said = f"has no finite slope along {name} at the particle {where}; give velocity_gradient as well"
                    yield ("velocity", c), said
    for i, row in enumerate(body.velocity_gradient or ()):
        for j, entry in enumerate(row):
            yield from _not_finite(("velocity_gradient", i, j), entry, position)
    if body.deformation is not None:
        yield from _deformation_faults(body, position, domain)
    elif body.initial_pressure == "hydrostatic" and getattr(body.material, "bulk_modulus", None) != "auto":
        load = hydrostatic_load(body, position, domain)
        where = _first(~np.isfinite(body.material.volume_ratio_under(load)), position)
        if where:
            said = f"asks for {load.max():.4g} Pa, more than the material can press with; give it a larger bulk_modulus"
            yield ("initial_pressure",), said


def _deformation_faults(body: Body, position: np.ndarray, domain: Domain) -> Iterator[tuple[Path, str]]:
    before = len(position)
    whole: Path = ("deformation",)
    if isinstance(body.deformation, tuple):
        found = [
            fault
            for i, row in enumerate(body.deformation)
            for j, entry in enumerate(row)
            for fault in _not_finite((*whole, i, j), entry, position)
        ]
    else:
        found = list(_not_finite(whole, body.deformation, position))
    yield from found
    if found or before == 0:
        return
    values = initial_deformation(body, position, domain)
    J = values if values.ndim == 1 else np.linalg.det(values)
    where = _first(~(J > 0), position)
    if where:
        name = "J" if values.ndim == 1 else "det F"
        sentence = f"must keep {name} above 0; it is {J[np.argmax(~(J > 0))]:.4g} at the particle {where}"
        yield whole, sentence


def entries_at(entries: tuple[Entry, ...], position: np.ndarray) -> np.ndarray:
    """Return a list of k entries at some places, (n, d), as (n, k)."""
    places = _places(position)
    columns = [np.broadcast_to(value_of(entry, **places), len(position)) for entry in entries]
    return np.stack(columns, axis=1)


def matrix_at(rows: tuple[tuple[Entry, ...], ...], position: np.ndarray) -> np.ndarray:
    """Return a matrix of entries at some places, (n, d), as (n, d, d)."""
    return np.stack([entries_at(row, position) for row in rows], axis=1)


def _offset(body: Body, position: np.ndarray) -> np.ndarray:
    return position - np.mean(body.shape.form.bounds(), axis=0)


def _places(position: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(INITIAL, position.T, strict=False))


def _not_finite(key: Path, entry: Entry, position: np.ndarray) -> Iterator[tuple[Path, str]]:
    if isinstance(entry, Expression):
        values = np.broadcast_to(value_of(entry, **_places(position)), len(position))
        where = _first(~np.isfinite(values), position)
        if where:
            found = values[np.argmax(~np.isfinite(values))]
            yield key, f"is {found} at the particle {where}; it must be finite everywhere"


def _first(wrong: np.ndarray, position: np.ndarray) -> str:
    """Return the place of the first particle that is wrong, "" where none is."""
    return f"at [{', '.join(f'{x:.6g}' for x in position[np.argmax(wrong)])}]" if wrong.any() else ""
