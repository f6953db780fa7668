"""Rules on what the grid can resolve: thin bodies, gaps, walls that are nearly touched, and particles per cell."""

from collections.abc import Iterator

import numpy as np

from mpmcli.check.distance import close_pairs
from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.scene.quantity import AXES

# Cells across a body below which its motion within itself is lost: with three, one particle row has neighbours on
# both sides that do not feel the surface (the stencil is three nodes wide; hard case H12).
FEWEST_CELLS = 3.0
# Cells that the kernels of two particles reach over together, by kernel: closer ones always share a node.
REACH = {"quadratic": 2.0, "cubic": 3.0}
# Cells below which a gap is contact on purpose: round-off, and bodies set on each other by hand.
TOUCHING = 0.1
# Cells from a wall within which a body feels it: the stencil reaches 1.5 nodes, its matter half of that.
WALL_REACH = 1.0
# Particles along an axis of a cell: below two, stretched matter tears (numerical fracture) and the sum over
# particles is no integral; above four they cost without making anything more accurate.
FEWEST_PER_AXIS, MOST_PER_AXIS = 2, 4


def shape_findings(facts: SceneFacts) -> Iterator[Finding]:
    """Yield what is to be said of shapes and their particles."""
    yield from _thin(facts)
    yield from _gaps(facts)
    yield from _walls(facts)
    yield from _particles(facts)


def _thin(facts: SceneFacts) -> Iterator[Finding]:
    h = facts.scene.domain.spacing
    for body in facts.bodies:
        cells = body.thickness / h
        # A body of just so many cells is not thin for the rounding of its corners.
        if cells < FEWEST_CELLS * (1 - 1e-6):
            lost = "its motion as a whole is right at best" if cells < 1 else "it bends and waves as if it were stiffer"
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
        # Bodies that come to rest on each other end there anyway; those that pass are dragged along.
        passing = not np.array_equal(first.velocity, second.velocity)
        yield Finding(
            "warning" if passing else "note",
            "gap",
            f'Bodies "{first.name}" and "{second.name}" are {cells:.2g} cells apart and act on each other already, as '
            f"the grid joins what is closer than {reach:g} cells.",
            f"Set them {reach * h:.3g} m apart, or make the spacing {distance / reach:.3g} m, to keep them apart.",
            cells,
            first.name,
        )


def _walls(facts: SceneFacts) -> Iterator[Finding]:
    domain = facts.scene.domain
    h = domain.spacing
    for body in facts.bodies:
        lower, upper = body.body.shape.form.bounds()
        for axis, a in zip(AXES, range(facts.scene.dimension), strict=False):
            for face, gap in (
                (f"{axis}_min", lower[a] - domain.origin[a]),
                (f"{axis}_max", domain.upper[a] - upper[a]),
            ):
                cells = gap / h
                if 1e-3 < cells < WALL_REACH * (1 - 1e-6):
                    yield Finding(
                        "note",
                        "wall-margin",
                        f'Body "{body.name}" begins {cells:.2g} cells from the wall {face} and feels it already.',
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
                f"{fewest}; the grid, not the particles, limits what is resolved.",
                f"Set particles_per_cell = {most} or fewer, and spend the time on a finer grid.",
                count,
                body.name,
            )
