"""Rules on resolution: thin bodies, gaps between bodies, distance from walls, particles per cell, and stretch."""

import math
from collections.abc import Iterator

import numpy as np

from mpmcli.check.facts import BodyFacts, SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.check.geometry import close_pairs
from mpmcli.check.result_state import STRETCHED, TORN
from mpmcli.scene.bounds import body_points
from mpmcli.scene.quantity import AXES
from mpmcli.scene.sampling import initial_deformation, initial_motion, moves_unevenly

# Cells across a body below which internal motion is not resolved. The stencil is three nodes wide, so that with three
# cells one row of particles is not affected by the surface (tests/hard_cases, H12).
FEWEST_CELLS = 3.0
# Distance, in cells, below which two particles always share a node, by kernel.
REACH = {"quadratic": 2.0, "cubic": 3.0}
# Distance, in cells, below which a gap counts as intended contact.
TOUCHING = 0.1
# Distance, in cells, below which a wall acts on a body.
WALL_REACH = 1.0
# Particles per axis of a cell. Below two, stretched matter tears (numerical fracture) and sums over particles are poor
# quadratures; above four, the cost grows without a gain in accuracy.
FEWEST_PER_AXIS, MOST_PER_AXIS = 2, 4


def shape_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the findings on shapes and their particles."""
    for rule in (_thin, _gaps, _walls, _particles, _stretched):
        yield from rule(facts)


def _thin(facts: SceneFacts) -> Iterator[Finding]:
    h = facts.scene.domain.spacing
    for body in facts.bodies:
        cells = body.thickness / h
        # The tolerance allows for rounding of the corners.
        if cells < FEWEST_CELLS * (1 - 1e-6):
            lost = "at best its motion as a whole is correct" if cells < 1 else "it is too stiff in bending and waves"
            what = (
                f'Body "{body.name}" is {cells:.3g} cells thick at its thinnest, and fewer than {FEWEST_CELLS:g} do '
                f"not resolve it: {lost}."
            )
            fix = f"Make it {FEWEST_CELLS * h:.3g} m thick, or domain.spacing {body.thickness / FEWEST_CELLS:.3g} m."
            yield Finding("warning", "thin-body", what, fix, cells, body.name)


def _gaps(facts: SceneFacts) -> Iterator[Finding]:
    h = facts.scene.domain.spacing
    bodies = facts.scene.bodies
    reach = REACH[facts.scene.solver.kernel]
    for i, j, distance in close_pairs(facts.scene, reach * h):
        cells = distance / h
        first, second = bodies[i], bodies[j]
        if cells <= TOUCHING or cells >= reach * (1 - 1e-6) or facts.scene.friction_between(first, second) is not None:
            continue
        # Bodies with equal velocity would come to rest in contact; those that pass each other are dragged along.
        passing = not np.array_equal(first.velocity, second.velocity)
        what = (
            f'Bodies "{first.name}" and "{second.name}" are {cells:.2g} cells apart and already act on each other, as '
            f"the grid couples particles closer than {reach:g} cells."
        )
        fix = f"Set them {reach * h:.3g} m apart, or make the spacing {distance / reach:.3g} m, to keep them apart."
        yield Finding("warning" if passing else "note", "gap", what, fix, cells, first.name)


def _walls(facts: SceneFacts) -> Iterator[Finding]:
    domain = facts.scene.domain
    h = domain.spacing
    for body in facts.bodies:
        lower, upper = body.body.shape.form.bounds()
        words = domain.walls.faces(facts.scene.dimension)
        for a, axis in enumerate(AXES[: facts.scene.dimension]):
            gaps = {f"{axis}_min": lower[a] - domain.origin[a], f"{axis}_max": domain.upper[a] - upper[a]}
            for (face, gap), word in zip(gaps.items(), words[a], strict=True):
                meets = word == "separate" and facts.scene.separates(body.body)
                if not meets and not domain.periodic[a] and 1e-3 < gap / h < WALL_REACH * (1 - 1e-6):
                    begins = f'Body "{body.name}" begins {gap / h:.2g} cells from the wall {face}'
                    what = f"{begins}, which already acts on it."
                    fix = f"Let it touch the wall, or set it {WALL_REACH * h:.3g} m or more from it."
                    yield Finding("note", "wall-margin", what, fix, float(gap / h), body.name)


def _particles(facts: SceneFacts) -> Iterator[Finding]:
    d = facts.scene.dimension
    fewest, most = FEWEST_PER_AXIS**d, MOST_PER_AXIS**d
    for body in facts.bodies:
        count = body.body.particles_per_cell
        has = f'Body "{body.name}" has {"one particle" if count == 1 else f"{count} particles"} per cell'
        if count < fewest:
            lost = "under large stretch gaps open between them, and it tears where the material would not."
            if count == 1:
                lost = "stretched by half it tears, and its volume and pressure depend on where its particles lie in "
                lost += "their cells."
            fix = f"Set particles_per_cell = {fewest} or more."
            yield Finding("warning", "particles-per-cell", f"{has}: {lost}", fix, count, body.name)
        elif count > most:
            what = (
                f"{has}, which cost {count / fewest:.3g} times the usual {fewest}; the resolution is that of the grid, "
                "not of the particles."
            )
            fix = f"Set particles_per_cell = {most} or fewer, and spend the time on a finer grid."
            yield Finding("note", "particles-per-cell", what, fix, count, body.name)


def _stretched(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the distance to which the start of an elastic body will pull its particles, where they move on the grid."""
    d = facts.scene.dimension
    if facts.scene.solver.solids == "total":
        return
    for body in facts.bodies:
        if not body.law.coherent or body.law.projects or body.law.deformation == "J":
            continue
        stretch = _stretch_to_come(facts, body)
        cells = stretch * body.body.particles_per_cell ** (-1 / d)
        # Of one particle per cell there is a finding anyway.
        if not STRETCHED < cells < math.inf or stretch * STRETCHED <= 1:
            continue
        what = (
            f'The start of body "{body.name}" stretches it by about {stretch:.3g}, so that its particles come to stand '
            f"{cells:.3g} cells apart: above {STRETCHED:g} the grid hardly sees what moves between them, noise grows, "
            f"and above {TORN:g} it tears."
        )
        more = f"Set particles_per_cell = {math.ceil(stretch / STRETCHED) ** d}, or start" if stretch < 10 else "Start"
        fix = f"{more} it slower or less deformed."
        yield Finding("warning" if cells > TORN else "note", "stretch", what, fix, cells, body.name)


def _stretch_to_come(facts: SceneFacts, body: BodyFacts) -> float:
    """Return the stretch of distances, as they are at the start, that the start of an elastic body makes.

    Relaxing undoes the initial deformation, which is 1 over its smallest stretch. Matter that moves at v relative to
    the body, its rotation left out, strains it by v / c, c = sqrt(E / density), where waves of v meet its ends.
    """
    stretch, material = 1.0, body.body.material
    points = body_points(body.body)
    if body.body.deformation is not None:
        F = initial_deformation(body.body, points, facts.scene.domain)
        F = F[np.isfinite(F).reshape(len(F), -1).all(1)]
        least = np.linalg.svd(F, compute_uv=False).min(initial=math.inf) if F.ndim == 3 else math.inf
        stretch = max(1.0, 1 / float(least)) if least > 0 else math.inf
    modulus = getattr(material, "youngs_modulus", body.stiffness)
    moving = body.body.velocity_gradient is not None or moves_unevenly(body.body)
    if not moving or not modulus > 0:
        return stretch
    C = initial_motion(body.body, points)[1].mean(0)
    with np.errstate(over="ignore", invalid="ignore"):
        speed = np.linalg.norm((points - points.mean(0)) @ (C + C.T) / 2, axis=1).max()
    return stretch * (1 + float(speed) / math.sqrt(modulus / material.density))
