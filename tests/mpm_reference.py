"""One MLS-MPM step in plain numpy, one particle and one node at a time, from the published formulas.

It shares no code with the solver: Hu et al. (2018) for the scatter with A = m C - kick V0 tau / D, D = h^2/4 or h^2/3,
Jiang et al. (2015) for the gather, relaxed APIC (docs/theory.md, 2.3), and the fold of ghost nodes at a wall
(docs/theory.md, 3.1).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

# Nodes kept beyond each wall.
MARGIN = 2


@dataclass(frozen=True)
class Particles:
    """Particles of one law: x, v (n, d), C (n, d, d), deformation J (n) or F (n, d, d), mass and volume (n).

    `stress` returns tau (d, d) of one particle's deformation and its number; kept (n) is the share of its motion that
    each keeps.
    """

    x: np.ndarray
    v: np.ndarray
    C: np.ndarray
    deformation: np.ndarray
    mass: np.ndarray
    volume: np.ndarray
    stress: Callable[[np.ndarray, int], np.ndarray]
    kept: np.ndarray | float = 0.0


@dataclass(frozen=True)
class Box:
    """The domain: cells per axis, spacing, gravity, the words of the (lower, upper) faces per axis, and the knobs.

    Faces whose word is "open" do nothing.
    """

    cells: tuple[int, ...]
    spacing: float
    gravity: np.ndarray
    faces: Sequence[tuple[str, str]]
    kernel: str = "quadratic"

    @property
    def inverse_moment(self) -> float:
        """1 / D, 1/m^2."""
        return {"quadratic": 4, "cubic": 3}[self.kernel] / self.spacing**2


def quadratic(u: float) -> float:
    """Quadratic B-spline: 3/4 - u^2 within half a cell, (3/2 - |u|)^2 / 2 within one and a half."""
    u = abs(u)
    if u <= 0.5:
        return 0.75 - u * u
    return 0.5 * (1.5 - u) ** 2 if u <= 1.5 else 0.0


def cubic(u: float) -> float:
    """Cubic B-spline: 2/3 - u^2 + |u|^3 / 2 within a cell, (2 - |u|)^3 / 6 within two."""
    u = abs(u)
    if u <= 1:
        return 2 / 3 - u * u + u**3 / 2
    return (2 - u) ** 3 / 6 if u <= 2 else 0.0


def stencil_of(x: np.ndarray, box: Box) -> list[tuple[tuple[int, ...], float, np.ndarray]]:
    """Return (node, weight, x_i - x) of the nodes around a point that feel it; node 0 lies on the lower wall."""
    h = box.spacing
    spline = {"quadratic": quadratic, "cubic": cubic}[box.kernel]
    axes = []
    for along in x / h:
        nearest = int(np.floor(along + 0.5))
        near = [(i, spline(along - i)) for i in range(nearest - 2, nearest + 3)]
        axes.append([(i, w) for i, w in near if w > 0])
    found = []
    for entries in product(*axes):
        node = np.array([i for i, _ in entries])
        weight = float(np.prod([w for _, w in entries]))
        found.append((tuple(int(i) for i in node), weight, node * h - x))
    return found


def scatter(groups: Sequence[Particles], box: Box, kick: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the momentum (..., d) and the mass of every node, MARGIN ghost nodes beyond each wall included."""
    shape = tuple(n + 1 + 2 * MARGIN for n in box.cells)
    momentum = np.zeros((*shape, len(shape)))
    mass = np.zeros(shape)
    for group in groups:
        for p, x in enumerate(group.x):
            tau = group.stress(group.deformation[p], p)
            A = -kick * group.volume[p] * box.inverse_moment * tau
            A = A + group.mass[p] * group.C[p]
            for node, w, lever in stencil_of(x, box):
                at = tuple(i + MARGIN for i in node)
                momentum[at] += w * (group.mass[p] * group.v[p] + A @ lever)
                mass[at] += w * group.mass[p]
    return momentum, mass


def scatter_kept(groups: Sequence[Particles], box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Return the same of the shares that particles keep, from before stress and forces."""
    return scatter([replace(group, mass=group.kept * group.mass) for group in groups], box, 0.0)


def update(momentum: np.ndarray, mass: np.ndarray, box: Box, kick: float) -> np.ndarray:
    """Return the velocity of every node, with gravity and the walls."""
    return update_both(momentum, mass, np.zeros_like(momentum), np.zeros_like(mass), box, kick)[0]


def update_both(
    momentum: np.ndarray, mass: np.ndarray, before: np.ndarray, kept_mass: np.ndarray, box: Box, kick: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the velocity of every node, with gravity and the walls, and that of what particles keep.

    The latter knows nothing of gravity, and of walls what mirror images do to it.
    A node and its images in the faces that act on it share their momenta, the images' mirrored; on the
    plane of an acting face there is no normal velocity, and none at all where it sticks; the images get
    the velocity back, mirrored. A separating face acts where the material on its plane moves towards it,
    the images of that plane in the faces that never let go included. It leaves alone what has yet to reach it.
    """
    d = len(box.cells)
    g = kick * box.gravity
    raw_momentum, raw_mass = momentum, mass
    velocity, velocity_before = np.zeros_like(momentum), np.zeros_like(momentum)

    def reached(plane: list[int], axis: int, side: int) -> bool:
        mass = [raw_mass[tuple(i + MARGIN + k * (a == axis) for a, i in enumerate(plane))] for k in (-1, 0, 1)]
        beyond, on, inside = mass if side == 0 else mass[::-1]
        return 2 * on >= 0.75 * inside or beyond >= 0.02 * on

    def acting(node: tuple[int, ...]) -> tuple[list[tuple[int, int, int]], list[int]]:
        """Return (axis, side, depth) of the faces that act on a node, and the axes whose faces it has yet to reach."""
        inner = [abs(i) if i <= MARGIN else (n - abs(n - i)) for i, n in zip(node, box.cells, strict=True)]
        found, away = [], []
        for a, n in enumerate(box.cells):
            for side, depth in ((0, node[a]), (1, n - node[a])):
                if depth > MARGIN or box.faces[a][side] == "open":
                    continue
                if box.faces[a][side] == "separate":
                    plane = list(inner)
                    plane[a] = n * side
                    if not reached(plane, a, side):
                        away.append(a)
                        continue
                    out = separating_momentum(plane, a) * (1 if side else -1)
                    if out < 0:
                        continue
                found.append((a, side, depth))
        return found, away

    def separating_momentum(plane: list[int], axis: int) -> float:
        total = 0.0
        sides = [
            (a, side, plane[a] if side == 0 else n - plane[a])
            for a, n in enumerate(box.cells)
            for side in (0, 1)
            if a != axis and box.faces[a][side] != "separate"
        ]
        near = [(a, side) for a, side, depth in sides if 0 < depth <= MARGIN]
        for chosen in product((False, True), repeat=len(near)):
            place, flip = list(plane), np.ones(d)
            for (a, side), taken in zip(near, chosen, strict=True):
                if taken:
                    place[a] = 2 * box.cells[a] * side - place[a]
                    flip = flip * sign(a, side)
            at = tuple(i + MARGIN for i in place)
            total += flip[axis] * (raw_momentum[at][axis] + raw_mass[at] * g[axis])
        return total

    def sign(axis: int, side: int) -> np.ndarray:
        mirror = np.ones(d)
        if box.faces[axis][side] == "stick":
            mirror[:] = -1
        mirror[axis] = -1
        return mirror

    for node in product(*(range(-MARGIN, n + 1 + MARGIN) for n in box.cells)):
        faces, away = acting(node)
        if any(depth < 0 for _, _, depth in faces):
            continue
        mirrors = [f for f in faces if f[2] > 0]
        images = []
        for chosen in product((False, True), repeat=len(mirrors)):
            place, flip = list(node), np.ones(d)
            for (axis, side, _), taken in zip(mirrors, chosen, strict=True):
                if taken:
                    place[axis] = 2 * box.cells[axis] * side - place[axis]
                    flip = flip * sign(axis, side)
            images.append((tuple(i + MARGIN for i in place), flip))
        total = sum(flip * (raw_momentum[at] + raw_mass[at] * g) for at, flip in images)
        weight = sum(raw_mass[at] for at, _ in images)
        if weight <= 0:
            continue
        kept = sum(kept_mass[at] for at, _ in images)
        v, u = total / weight, sum(flip * before[at] for at, flip in images) / (kept or 1.0)
        for axis, side, depth in faces:
            if depth == 0:
                v, u = (np.where(sign(axis, side) < 0, 0.0, w) for w in (v, u))
        for a, n in enumerate(box.cells):
            held = {axis for axis, _, _ in faces} | set(away)
            if a not in held and node[a] <= 0 and box.faces[a][0] != "open":
                v[a] = max(v[a], 0.0)
            if a not in held and node[a] >= n and box.faces[a][1] != "open":
                v[a] = min(v[a], 0.0)
        for at, flip in images:
            velocity[at], velocity_before[at] = flip * v, flip * u
    return velocity, velocity_before


def gather(
    groups: Sequence[Particles],
    velocity: np.ndarray,
    box: Box,
    dt: float,
    before: np.ndarray | None = None,
    kick: float = 0.0,
) -> list[Particles]:
    """Return the particles after the step: v, C, x + dt v, and J det(I + dt C) or (I + dt C) F.

    With the velocity from before the stress they keep a share of what nodes do not see of v and C, and C takes what
    keeps angular momentum; what gravity did in `kick` turns nothing.
    """
    moved = []
    for group in groups:
        v, C, u, H = (np.zeros_like(field) for field in (group.v, group.C, group.v, group.C))
        for p, x in enumerate(group.x):
            for node, w, lever in stencil_of(x, box):
                at = tuple(i + MARGIN for i in node)
                v_i = velocity[at]
                v[p] += w * v_i
                C[p] += box.inverse_moment * w * np.outer(v_i, lever)
                if before is not None:
                    u[p] += w * before[at]
                    H[p] += box.inverse_moment * w * np.outer(before[at], lever)
        if group.deformation.ndim == 1:
            deformation = group.deformation * np.linalg.det(np.eye(C.shape[1]) + dt * C)
        else:
            deformation = group.deformation + dt * C @ group.deformation
        x = np.clip(group.x + dt * v, 0, np.array(box.cells) * box.spacing)
        kept = np.broadcast_to(group.kept, len(v))
        k = kept[:, None] * (group.v - u)
        unseen = kept[:, None, None] * (group.C - H)
        turned = box.inverse_moment * np.einsum("pc,pa->pca", v - u - kick * box.gravity, k) + np.einsum(
            "pcb,pab->pca", unseen, H
        )
        C = C + unseen + 0.5 * dt * (turned - turned.transpose(0, 2, 1))
        moved.append(replace(group, x=x, v=v + k, C=C, deformation=deformation))
    return moved


def fluid_stress(bulk_modulus: np.ndarray, dimension: int) -> Callable[[np.ndarray, int], np.ndarray]:
    """tau = K (J - 1) I, from p = K (1/J - 1); K per particle (n)."""
    return lambda J, p: bulk_modulus[p] * (J - 1) * np.eye(dimension)


def neo_hookean_stress(mu: np.ndarray, lam: np.ndarray) -> Callable[[np.ndarray, int], np.ndarray]:
    """tau = mu (F F^T - I) + lambda ln(det F) I; mu and lambda per particle (n)."""

    def stress(F: np.ndarray, p: int) -> np.ndarray:
        identity = np.eye(len(F))
        return mu[p] * (F @ F.T - identity) + lam[p] * np.log(np.linalg.det(F)) * identity

    return stress
