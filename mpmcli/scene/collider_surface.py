"""The surface of a collider: of its form, turned towards the material, and cut off at the domain."""

import numpy as np

from mpmcli.scene.colliders import Collider, Plane
from mpmcli.scene.form_surface import form_surface
from mpmcli.scene.surface import Surface, within


def collider_surface(collider: Collider, lower: np.ndarray, upper: np.ndarray) -> Surface:
    """Return the surface of a collider where its shape stands, before `Motion` moves it; the material is before it.

    Planes, containers and what never moves are cut off at the domain, at time 0.

    Args:
        lower, upper: corners of the domain, (d,), m.
    """
    if isinstance(collider.form, Plane):
        return _plane(collider, lower, upper)
    surface = form_surface(collider.form)
    motion, inside = collider.motion, collider.side == "inside"
    if inside or not motion.moves:
        placed = Surface(motion.placed(surface.points, 0.0), surface.cells)
        kept = within(placed, lower, upper, caps=not inside)
        if kept is not placed:
            surface = Surface(motion.taken_back(kept.points, 0.0), kept.cells)
    return surface.flipped if inside else surface


def _plane(collider: Collider, lower: np.ndarray, upper: np.ndarray) -> Surface:
    """Return the part of a plane that lies in the domain; of one that misses it, of the parallel one that touches."""
    motion, form = collider.motion, collider.form
    inside = collider.side == "inside"
    point = motion.placed(np.array([form.point]), 0.0)[0]
    normal = motion.placed(np.array([form.point]) + form.direction, 0.0)[0] - point
    normal /= np.linalg.norm(normal)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    reach = float(np.abs(normal) @ half)
    away = float((point - middle) @ normal)
    # Where it lies on a face of the domain, rounding must not cut it off.
    shift = away - np.clip(away, -(1 - 1e-12) * reach, (1 - 1e-12) * reach)
    center = middle + (away - shift) * normal
    far = 2.0 * float(np.linalg.norm(half))
    if len(lower) == 2:
        along = np.array([-normal[1], normal[0]])
        quad = Surface(center + far * np.array([[-1.0], [1.0]]) * along, np.array([[0, 1]]))
    else:
        u = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
        u /= np.linalg.norm(u)
        v = np.cross(normal, u)
        corners = center + far * np.array([-u - v, u - v, u + v, v - u])
        quad = Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    found = within(quad, lower - 1e-9 * half, upper + 1e-9 * half, caps=False)
    back = motion.taken_back(found.points + shift * normal, 0.0)
    return Surface(back, found.cells).flipped if inside else Surface(back, found.cells)
