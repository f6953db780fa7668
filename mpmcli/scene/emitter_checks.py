"""Checks of emitters and open faces that need the whole scene."""

from collections.abc import Iterator

import numpy as np

from mpmcli.scene.emitters import Emitter
from mpmcli.scene.problem import Problem
from mpmcli.scene.quantity import AXES
from mpmcli.scene.schema import Scene
from mpmcli.scene.sheets import Mouth, most_in_mouth, mouth_of, sheets_of, sheets_until

# Fraction of a spacing that counts as round-off.
_TOLERANCE = 1e-6
# Particles that a run can number.
_MOST = 2**31 - 1
# Particles of one sheet.
_MOST_IN_MOUTH = 10_000_000


def emitter_problems(scene: Scene) -> Iterator[Problem]:
    """Find emitters that cannot be, and solvers that know neither emitters nor open faces."""
    for k, emitter in enumerate(scene.emitters):
        where = ("emitters", k)
        count = most_in_mouth(emitter, scene.domain.spacing)
        if not count <= _MOST_IN_MOUTH:
            said = f'the mouth of "{emitter.name}" could hold {count:.3g} particles at once, and {_MOST_IN_MOUTH:g} is '
            yield Problem((*where, "shape"), said + "the most; make it narrower, or the grid coarser")
            continue
        mouth = mouth_of(emitter, scene.domain.spacing)
        if not mouth.filled.any():
            said = (
                f'"{emitter.name}" has no particle in its mouth, the section through the centre of its shape across '
                f"the velocity: they would be {mouth.spacing[0]:.6g} m apart; make it wider, or the grid finer"
            )
            yield Problem((*where, "shape"), said)
            continue
        yield from (Problem((*where, "shape"), said) for said in _outside(emitter, mouth, scene))
        if emitter.start >= scene.time.end:
            said = f"must be before the end of the scene, {scene.time.end:g} s; found {emitter.start:g}"
            yield Problem((*where, "start"), said)
            continue
        yield from (Problem((*where, key), said) for key, said in _total(emitter, scene))
    yield from _unsuited(scene)


def _outside(emitter: Emitter, mouth: Mouth, scene: Scene) -> Iterator[str]:
    places, slack = mouth.places, _TOLERANCE * scene.domain.spacing
    beyond = np.maximum(np.array(scene.domain.origin) - places, places - np.array(scene.domain.upper)).max(axis=0)
    for axis in np.flatnonzero(beyond > slack):
        yield (
            f'the mouth of "{emitter.name}" reaches out of the domain along {AXES[axis]} by {beyond[axis]:.6g} m; '
            "move it or enlarge the domain"
        )


def _total(emitter: Emitter, scene: Scene) -> Iterator[tuple[str, str]]:
    sheets = sheets_of(emitter, scene)
    most = sheets_until(emitter, scene, sheets.period)
    n = len(sheets.places)
    for key, unit, one in (("particles", "particles", n), ("volume", "m^3", n * sheets.volume)):
        asked = getattr(emitter, key)
        if asked is not None and round(asked / one) > most:
            end = "end" if emitter.end is not None else "time.end"
            unit = "m^2" if key == "volume" and scene.dimension == 2 else unit
            yield (
                key,
                f'takes {round(asked / one) * sheets.period:.4g} s to flow out of "{emitter.name}", which has '
                f"{most * sheets.period:.4g} s until {end}; {most * one:.6g} {unit} at most come out by then",
            )
    if sheets.particles > _MOST:
        yield "particles", f"would be {sheets.particles:.3g}, more than a run can number, {_MOST}; give fewer"


def _unsuited(scene: Scene) -> Iterator[Problem]:
    if scene.output.drop_retired and not scene.comes_and_goes:
        said = "is for scenes with emitters or open faces, where particles come and go; leave it out"
        yield Problem(("output", "drop_retired"), said)
    opens = scene.domain.walls.any_open(scene.dimension)
    found = [("emitters",)] * bool(scene.emitters) + [("domain", "walls")] * opens
    if scene.solver.solids == "total" and found:
        what = "emitters" if scene.emitters else "open faces"
        said = f'solver.solids = "total" knows no {what}: give solids = "updated", or leave them out'
        yield Problem(found[0], said)
    if scene.solver.walls == "zeroed" and opens:
        yield Problem(("domain", "walls"), 'solver.walls = "zeroed" knows no open faces: give walls = "folded"')
