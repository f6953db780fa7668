"""Rules on resolution: thin bodies, gaps between bodies, distance from walls, particles per cell, and stretch."""

import math
from collections.abc import Iterator

import numpy as np

from mpmcli.check.distance import close_pairs
from mpmcli.check.facts import BodyFacts, SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.check.result_stretch import STRETCHED, TORN
from mpmcli.scene.bounds import body_points
from mpmcli.scene.initial import initial_deformation, initial_motion, moves_unevenly
from mpmcli.scene.quantity import AXES

# Cells across a body below which internal motion is not resolved. The stencil is three nodes wide, so that with three
# cells one row of particles is not affected by the surface (docs/hard-cases.md, H12).
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
    yield from _thin(facts)
    yield from _gaps(facts)
    yield from _walls(facts)
    yield from _particles(facts)
    yield from _stretched(facts)


def _thin(facts: SceneFacts) -> Iterator[Finding]:
    h = facts.scene.domain.spacing
    for body in facts.bodies:
        cells = body.thickness / h
        # The tolerance allows for rounding of the corners.
        if cells < FEWEST_CELLS * (1 - 1e-6):
            lost = "at best its motion as a whole is correct" if cells < 1 else "it is too stiff in bending and waves"
            yield Finding(
                "warning",
                "thin-body",
                f'Body "{body.name}" is {cells:.3g} cells thick at its thinnest, and fewer than {FEWEST_CELLS:g} do '
                f"not resolve it: {lost}.",
                f"Make it {FEWEST_CELLS * h:.3g} m thick, or domain.spacing {body.thickness / FEWEST_CELLS:.3g} m.",
                cells,
                body.name,
            )


def _gaps(facts: SceneFacts) -> Iterator[Finding]:
    h = facts.scene.domain.spacing
    bodies = facts.scene.bodies
    reach = REACH[facts.scene.solver.kernel]
    for i, j, distance in close_pairs(facts.scene, reach * h):
        cells = distance / h
        if cells <= TOUCHING or cells >= reach:
            continue
        first, second = bodies[i], bodies[j]
        # Bodies with equal velocity would come to rest in contact; those that pass each other are dragged along.
        passing = not np.array_equal(first.velocity, second.velocity)
        yield Finding(
            "warning" if passing else "note",
            "gap",
            f'Bodies "{first.name}" and "{second.name}" are {cells:.2g} cells apart and already act on each other, as '
            f"the grid couples particles closer than {reach:g} cells.",
            f"Set them {reach * h:.3g} m apart, or make the spacing {distance / reach:.3g} m, to keep them apart.",
            cells,
            first.name,
        )


def _walls(facts: SceneFacts) -> Iterator[Finding]:
    domain = facts.scene.domain
    h = domain.spacing
    for body in facts.bodies:
        lower, upper = body.body.shape.form.bounds()
        for a, axis in enumerate(AXES[: facts.scene.dimension]):
            if domain.periodic[a]:
                continue
            for face, gap in (
                (f"{axis}_min", lower[a] - domain.origin[a]),
                (f"{axis}_max", domain.upper[a] - upper[a]),
            ):
                cells = gap / h
                if 1e-3 < cells < WALL_REACH * (1 - 1e-6):
                    yield Finding(
                        "note",
                        "wall-margin",
                        f'Body "{body.name}" begins {cells:.2g} cells from the wall {face}, which already acts on it.',
                        f"Let it touch the wall, or set it {WALL_REACH * h:.3g} m or more from it.",
                        float(cells),
                        body.name,
                    )


def _particles(facts: SceneFacts) -> Iterator[Finding]:
    d = facts.scene.dimension
    fewest, most = FEWEST_PER_AXIS**d, MOST_PER_AXIS**d
    for body in facts.bodies:
        count = body.body.particles_per_cell
        if count < fewest:
            what = (
                f'Body "{body.name}" has one particle per cell: stretched by half it tears, and its volume and '
                "pressure depend on where its particles lie in their cells."
                if count == 1
                else f'Body "{body.name}" has {count} particles per cell: under large stretch gaps open between them, '
                "and it tears where the material would not."
            )
            yield Finding(
                "warning",
                "particles-per-cell",
                what,
                f"Set particles_per_cell = {fewest} or more.",
                count,
                body.name,
            )
        elif count > most:
            yield Finding(
                "note",
                "particles-per-cell",
                f'Body "{body.name}" has {count} particles per cell, which cost {count / fewest:.3g} times the usual '
                f"{fewest}; the resolution is that of the grid, not of the particles.",
                f"Set particles_per_cell = {most} or fewer, and spend the time on a finer grid.",
                count,
                body.name,
            )


def _stretched(facts: SceneFacts) -> Iterator[Finding]:
    """Yield the distance to which the start of an elastic body will pull its particles, where they move on the grid."""
    d = facts.scene.dimension
    if facts.scene.solver.solids == "total":
        return
    for body in facts.bodies:
        if not body.law.coherent or body.law.projects or body.law.deformation == "J":
            continue
        count = body.body.particles_per_cell
        stretch = _stretch_to_come(facts, body)
        cells = stretch * count ** (-1 / d)
        # Of one particle per cell there is a finding anyway.
        if not STRETCHED < cells < math.inf or stretch * STRETCHED <= 1:
            continue
        more = f"Set particles_per_cell = {math.ceil(stretch / STRETCHED) ** d}, or start" if stretch < 10 else "Start"
        yield Finding(
            "warning" if cells > TORN else "note",
            "stretch",
            f'The start of body "{body.name}" stretches it by about {stretch:.3g}, so that its particles come to stand '
            f"{cells:.3g} cells apart: above {STRETCHED:g} the grid hardly sees what moves between them, noise grows, "
            f"and above {TORN:g} it tears.",
            f"{more} it slower or less deformed.",
            cells,
            body.name,
        )


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
