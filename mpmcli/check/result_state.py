"""Checks the frames of a result: values, momentum, distances of neighbours, and crowds."""

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from mpmcli.check.finding import FrameFindings, Severity
from mpmcli.check.material_rules import VISCOUS
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output.header import BodyHeader, RunHeader, nearest_image
from mpmcli.plain_text import counted
from mpmcli.stability.limits import OVERLAP

# No law is valid for J below the first. Coherent material would have torn for J above the second.
CRUSHED, BLOWN_UP = 0.1, 10.0
# J of liquids and pastes below which their modulus is too low for what presses on them, and the fraction of the mass of
# a body that is reported.
COMPRESSED, MUCH = 0.9, 0.01
# Fraction of the particles of a frame on walls that is reported; bodies on the updated grid have none.
ON_WALLS = 0.01
# On a GPU the Courant number is estimated between measurements, during which an impact may double the speed.
GPU_FACTOR = 2.0
# Distance from a wall, in cells, from which on it does not act: a particle acts on nodes up to 1.5 cells away, and the
# first plane of nodes of a wall is the wall itself.
WALL_REACH = 2.0
# Distance of neighbours, in cells, above which the grid hardly resolves their relative motion; with one particle per
# cell, whose distance at rest is a cell, the distance at a stretch of SPARSE.
STRETCHED, SPARSE = 0.9, 1.25
# Distance, in cells, that a kernel reaches.
TORN = 1.5
# Distance at the start, over that of a lattice, up to which two particles count as neighbours; the diagonal is at 1.41.
NEIGHBOUR = 1.2
# Number of frames of a run that are searched for crowds, and the largest number of cells around its material.
FEW, MOST_CELLS = 4, 3e7
# Particles in a cell over the nominal number, and fraction of empty cells inside, that are reported.
CROWDED, GAPS = 3.0, 0.05
# Mean J of a viscous liquid that is reported.
OPENED = 1.2
# Share of the energy stored that a run at rest counts as having turned over.
AT_REST = 0.2
# Water turns at rest if it moves farther than TURNED cells on average in the last half of a run that turns over less
# than STILL of the energy stored. Its kinetic energy never falls below STEADY of the mean, unlike that of waves.
TURNED, STILL, STEADY = 1.0, 0.1, 0.3
# Cells to each side of an inner cell, their smallest mean filling, and the fewest inner cells for a fraction.
WINDOW, INSIDE, ENOUGH = 2, 0.85, 64


class FrameCheck:
    """A check of the frames of a run in their order; `figures` by name, see `ResultCheck`."""

    START: ClassVar[dict[str, float | None]] = {}

    def __init__(self, header: RunHeader, findings: FrameFindings) -> None:
        self._header, self._findings = header, findings
        self.figures = dict(self.START)

    def _most(self, name: str, value: float) -> None:
        self.figures[name] = max(self.figures[name] or 0.0, value)

    def _tell(
        self, severity: Severity, rule: str, frame: Frame, p: int, what: str, fix: str, value: float, kind: str = ""
    ) -> None:
        """Add a finding of particle p, which `what` names by {one}."""
        body = self._header.body_name(int(frame.body[p]))
        what = f"In frame {frame.index} " + what.format(one=f'{p} of body "{body}"')
        self._findings.add(severity, rule, frame.index, what, fix, value, body, kind)


class StateCheck(FrameCheck):
    """Checks the values of each frame."""

    def __init__(self, header: RunHeader, findings: FrameFindings) -> None:
        super().__init__(header, findings)
        # Time since which each body that is compressed has been so, s.
        self._since: dict[str, float] = {}

    def check(self, frame: Frame) -> bool:
        """Check a frame; return whether all of its values are finite."""
        finite = True
        for name, array in (("position", frame.position), ("velocity", frame.velocity), *frame.fields.items()):
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                finite = False
                lost = np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(1))
                what = f"{name} is not finite at {counted(len(lost), 'particle')}, the first of them number {{one}}"
                fix = "Leave out the frames from here on, and run the scene again with a lower time.safety."
                self._tell("error", "not-finite", frame, int(lost[0]), what, fix, len(lost), name)
        self._inside(frame)
        self._volumes(frame)
        return finite

    def _inside(self, frame: Frame) -> None:
        """Find particles outside the domain, and those that it keeps on a wall (docs/theory.md, 3.5)."""
        header, frame = self._header, frame.of_present
        if header.origin is None or len(frame.position) == 0:
            return
        # A NaN has a finding of its own.
        lowest, highest = extent(frame.position)
        if (lowest > header.origin).all() and (highest < header.upper).all():
            return
        out = np.fmax(header.origin - frame.position, frame.position - header.upper)
        error = 4 * header.place_error(frame.position.dtype)
        held = int(((out >= 0) & (out <= error) & ~header.periodic).any(1).sum())
        opened = any(header.open_axes)
        if frame.index > 0 and not opened and held > ON_WALLS * len(out):
            what = f"In frame {frame.index} {held} of {counted(len(out), 'particle')} lie on a wall"
            what += ", where the domain keeps particles that would leave it: the rest of their displacement is lost"
            fix = 'With solids = "total" a stiffer material deforms less; "updated" keeps particles away from walls.'
            self._findings.add("note", "held-positions", frame.index, what, fix, value=held / len(out))
        # At an open face particles stay outside until the next sort.
        late = 2 * header.spacing * np.array(header.open_axes) if opened else 0.0
        # Solids that meet walls at their surfaces overlap them.
        solid = np.array([law.coherent and law.deformation == "F" for law in header.laws], bool)
        deep = OVERLAP * (header.spacing or 0.0) * solid[frame.material][:, None] if solid.any() else 0.0
        far = (out > error + late + deep) & np.isfinite(out)
        beyond = np.where(far, out, 0.0).max(1)
        if beyond.any():
            p, escaped = int(beyond.argmax()), counted(np.count_nonzero(beyond), "particle")
            what = f"{escaped} out of the domain, the farthest of them, number {{one}}, by {beyond[p]:.4g} m"
            fix = "Look at this particle, and lower time.safety or refine the domain where it is."
            self._tell("error", "escaped", frame, p, what, fix, float(beyond[p]))

    def _volumes(self, frame: Frame) -> None:
        """Report the first particle without volume, and the crushed and the blown-up one of the largest |log J|."""
        J = volume_ratio(self._header, frame)
        if J is None or len(J) == 0 or (J.min() >= COMPRESSED and J.max() <= BLOWN_UP):
            self._since = {}
            return
        self._compressed(frame.of_present)
        fine, coherent = np.isfinite(J), np.array([law.coherent for law in self._header.laws], bool)
        coheres = coherent[frame.material] if len(coherent) else False
        for severity, bad, word in (
            ("error", fine & (J <= 0), "has no volume left"),
            ("warning", (J > 0) & (J < CRUSHED), "is crushed"),
            ("warning", fine & (J > BLOWN_UP) & coheres, "is blown up"),
        ):
            rows = np.flatnonzero(bad)
            if len(rows):
                p = int(rows[0] if severity == "error" else rows[np.abs(np.log(J[rows])).argmax()])
                what = f"particle {{one}} {word}: its J is {J[p]:.4g}"
                fix = "Make its material stiffer, the domain finer, or time.safety lower."
                self._tell(severity, "volume", frame, p, what, fix, float(J[p]), word)

    def _compressed(self, frame: Frame) -> None:
        """Find liquids and pastes that lose volume under pressure for longer than a wave takes to cross them."""
        header, J = self._header, volume_ratio(self._header, frame)
        close = np.array([law.coherent and law.name in laws() and laws()[law.name].flows for law in header.laws], bool)
        low = (J < COMPRESSED) & (close[frame.material] if len(close) else False)
        since, self._since = self._since, {}
        for label, body in enumerate(header.bodies if low.any() else ()):
            own = frame.body == label
            share = float(low[own].mean()) if own.any() else 0.0
            if share <= MUCH:
                continue
            began = self._since[body.name] = since.get(body.name, frame.time)
            modulus, smallest = body.material.get("bulk_modulus"), float(J[own].min())
            known = bool(isinstance(modulus, float) and body.density and body.volume)
            across = body.volume ** (1 / header.dimension) * (body.density / modulus) ** 0.5 if known else 0.0
            if frame.time - began > across:
                what = f"In frame {frame.index} {100 * share:.2g} % of the mass of "
                what += (
                    f'"{body.name}" has a J below {COMPRESSED:g}, the smallest {smallest:.3g}, as since {began:.4g} s: '
                )
                what += f"its bulk modulus{f' of {modulus:.4g} Pa' if known else ''} is too low for the pressure on it"
                fix = "Set its bulk_modulus to ten times as much; if as much remains, refine the domain."
                self._findings.add("warning", "compressed", frame.index, what, fix, smallest, body.name, body.name)


def extent(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner of the particles, (d,) each, m; by columns, which is faster."""
    columns = np.ascontiguousarray(position.T)
    return columns.min(1), columns.max(1)


def volume_ratio(header: RunHeader, frame: Frame) -> np.ndarray | None:
    """Return J of each particle as stored, or from the density, (n,); None if neither is stored."""
    J = frame.fields.get("volume_ratio")
    if J is None and "density" in frame.fields and header.densities:
        return np.array(header.densities)[frame.body] / frame.fields["density"]
    return J


def lowest_potential(header: RunHeader) -> float:
    """Return the potential energy of a unit mass at the lowest place of the domain, relative to its origin, J/kg."""
    if header.origin is None or header.gravity is None:
        return 0.0
    return -float(np.maximum(header.gravity * (header.upper - header.origin), 0.0).sum())


def _reach(header: RunHeader, row: LedgerRow, frame: Frame) -> float | None:
    """Return the largest displacement in a row's steps, m, with shifts and rounding; None if unknown."""
    if header.spacing is None or not np.isfinite(row.courant_max):
        return None
    factor = GPU_FACTOR if header.on_gpu else 1.0
    rounding = row.steps * header.step_error + 2 * header.place_error(frame.position.dtype)
    shifts = header.shifts and any(law.name in laws() and laws()[law.name].shifts for law in header.laws)
    shifted = header.shifted(row.steps, frame.step) if shifts else 0.0
    # A particle from an emitter begins at the position that follows from its due time, up to a step earlier.
    steps = row.steps + bool(row.emitted)
    return factor * steps * row.courant_max * header.spacing * (1 + 1e-3) + shifted + rounding


class MomentumCheck(FrameCheck):
    """Compares the momentum of the ledger with P0 + M g (t - dt/2) while no wall can have acted.

    Momentum transferred to colliders is included; velocities are those in the middle of the last step. Momentum along
    an axis is conserved while no particle is near a wall normal to it or one with "stick"; angular momentum without
    gravity, far from all walls, if the transfer conserves it (docs/theory.md, 9.2). The drift is relative to sqrt(2 M
    E_kin), a bound on sum m |v|.
    """

    START: ClassVar = {"momentum_drift": None, "momentum_frames": 0}

    def __init__(self, header: RunHeader, findings: FrameFindings) -> None:
        super().__init__(header, findings)
        self._first: LedgerRow | None = None
        self._time, self._steps, self._kinetic = 0.0, 0, 0.0
        # Momentum that colliders took, and its rounding.
        self._taken, self._rounding = np.zeros(header.dimension), np.zeros(header.dimension)
        self._colliders = len(header.collider_names)
        known = header.origin is not None and header.gravity is not None and header.sticking is not None
        self._free = np.full(header.dimension, known and not header.driven)
        # Distance of the particles from the walls normal to each axis, in the previous frame.
        self._distance = np.zeros(header.dimension)

    def check(self, frame: Frame, row: LedgerRow) -> None:
        """Check the row of a frame of finite values; frames must come in order, without gaps."""
        header = self._header
        if not self._free.any() or len(frame.position) == 0:
            return
        if len(row.collider_force) != self._colliders:
            self.lost()
            return
        self._first = first = self._first or row
        self._kinetic = max(self._kinetic, row.kinetic)
        self._steps += row.steps
        given = np.array(row.collider_force).reshape(-1, header.dimension) * (row.time - self._time)
        self._taken += given.sum(axis=0)
        self._rounding += header.epsilon * np.abs(given).sum(axis=0)
        self._time = row.time
        if frame.index > 0:
            allowed = _reach(header, row, frame)
            touching = ~(self._distance > (np.inf if allowed is None else WALL_REACH * header.spacing + allowed))
            # A wall with "stick" acts along its tangents too.
            self._free &= ~touching & ~(touching & np.array(header.sticking)).any()
        lowest, highest = extent(frame.position)
        self._distance = np.minimum(lowest - header.origin, header.upper - highest)
        self._distance[header.periodic] = np.inf
        scale = float(np.sqrt(2 * row.mass * self._kinetic))
        if frame.index == 0 or not self._free.any() or scale == 0 or not np.isfinite(scale):
            return
        middle = row.time - (row.step_min + row.step_max) / 4
        expected = np.array(first.linear_momentum) + row.mass * header.gravity * (middle - first.time)
        unknown = row.mass * np.abs(header.gravity) * (row.step_max - row.step_min) / 4 + self._rounding
        difference = (np.abs(np.array(row.linear_momentum) + self._taken - expected) - unknown)[self._free].max()
        angular = 0.0
        spins_on = header.keeps_spin and not (header.gravity.any() or self._colliders or header.periodic.any())
        if spins_on and self._free.all():
            turned = np.abs(np.array(row.angular_momentum) - np.array(first.angular_momentum)).max()
            angular = float(turned) / float(np.linalg.norm(header.upper - header.origin))
        drift = float(max(difference, angular, 0.0)) / scale
        self.figures["momentum_frames"] += 1
        self._most("momentum_drift", drift)
        # Rounding may have the same sign in every step.
        if drift > 1e-3 + self._steps * header.epsilon:
            acted = "gravity and colliders" if self._colliders else "gravity"
            what = f"By frame {frame.index} momentum has drifted by {drift:.3g} of what moves"
            what += f", though no wall was near and nothing but {acted} acted"
            fix = 'Run it with solver.precision = "f64" to see whether it is rounding.'
            self._findings.add("warning", "momentum", frame.index, what, fix, value=drift)

    def lost(self) -> None:
        """Stop the comparison, because a frame could not be read or is not finite."""
        self._free[:] = False


class RestCheck(FrameCheck):
    """Finds water that begins at rest and turns, though nothing drives it (docs/theory.md, 9.3)."""

    def __init__(self, header: RunHeader, findings: FrameFindings, last: int) -> None:
        super().__init__(header, findings)
        self._rows: list[LedgerRow] = []
        self._last, self._start, self._middle = last, *np.zeros((2, 0, header.dimension))
        known = header.spacing is not None and header.gravity is not None
        self._closed = known and not (header.driven or header.particle_count_varies or header.moved)
        self._liquid = np.array([law.name == "fluid" for law in header.laws], bool)
        self._thin = np.array([body.material.get("viscosity", 0) < VISCOUS for body in header.bodies], bool)

    def check(self, frame: Frame, row: LedgerRow) -> None:
        """Check a frame of finite values; frames must come in order."""
        if not (self._closed and self._liquid.any()):
            return
        self._rows.append(row)
        if len(self._rows) == 1:
            self._start = frame.position
        if frame.index == self._last // 2:
            self._middle = frame.position
        water = self._liquid[frame.material] & self._thin[frame.body]
        if frame.index < self._last or len(self._middle) == 0 or not water.any() or not self._turns():
            return
        header = self._header
        # Other bodies that have moved may have driven it.
        moved = nearest_image(frame.position[~water] - self._start[~water], header.period)
        if row.rigid_pose:
            poses = np.array([self._rows[0].rigid_pose, row.rigid_pose])[..., : header.dimension]
            moved = np.concatenate([moved, poses[1] - poses[0]])
        if np.linalg.norm(moved, axis=1).max(initial=0.0) > TURNED * header.spacing:
            return
        apart = nearest_image(frame.position[water] - self._middle[water], header.period)
        cells = float(np.linalg.norm(apart, axis=1).mean()) / header.spacing
        if cells > TURNED:
            what = f"Water that began at rest moved {cells:.3g} cells on average between frames {self._last // 2} and "
            what += f"{frame.index}, though nothing drives it: it turns beside inclined or curved surfaces"
            fix = "Give the colliders a friction of 0.01 or more."
            self._findings.add("warning", "turns", frame.index, what, fix, value=cells)

    def _turns(self) -> bool:
        """Return whether motion has arisen from rest, goes on, and has not the energy that gravity released."""
        kinetic, rest = np.array([(row.kinetic, row.potential + row.elastic) for row in self._rows]).T
        late, total = kinetic[len(kinetic) // 2 :], kinetic + rest
        stored = np.abs(rest - self._rows[0].mass * lowest_potential(self._header)).max()
        steady = kinetic[0] < 0.1 * late.mean() and late.min() > STEADY * late.mean()
        released = abs(total[-1] - total[0]) < late.mean() / 2
        return bool(steady and not released and np.ptp(rest) < STILL * stored)


class StretchCheck(FrameCheck):
    """Follows the distance of neighbours in elastic bodies, which the grid must resolve."""

    START: ClassVar = {"neighbour_distance": None}
    _pairs: list[tuple[BodyHeader, np.ndarray, np.ndarray, float]] | None = None
    # Per body, the largest distance of neighbours before it tears, cells.
    _held: dict[str, float]

    def check(self, frame: Frame) -> None:
        """Check a frame of finite values."""
        header, h = self._header, self._header.spacing
        if self._pairs is None:
            self._pairs, self._held = [] if h is None else list(self._neighbours(frame, h)), {}
        for body, first, second, allowed in self._pairs:
            apart = nearest_image(frame.position[second] - frame.position[first], header.period)
            squares = np.einsum("ij,ij->i", apart, apart)
            cells = float(np.sqrt(float(squares.max()))) / h
            self._most("neighbour_distance", cells)
            if cells <= allowed:
                continue
            severity = "warning" if cells > TORN else "note"
            if severity == "note":
                self._held[body.name] = max(cells, self._held.get(body.name, 0.0))
            count = int((squares > (allowed * h) ** 2).sum())
            told = f"farther than {TORN:g}, the reach of a kernel: it has torn, although its material cannot"
            if severity == "note":
                told = f"above {allowed:.3g}: the grid hardly resolves motion between them, noise grows, and gaps open"
            what = f'In frame {frame.index} {count} pairs of neighbours of body "{body.name}"'
            what += f" stand up to {cells:.3g} cells apart, {told}"
            # Of a body that has torn, the distance before it did.
            reached = self._held.get(body.name, TORN) if severity == "warning" else cells
            per_axis = int(np.ceil(body.particles_per_cell ** (1 / header.dimension) * reached / STRETCHED))
            fix = f"Set particles_per_cell = {per_axis**header.dimension}, or stretch it less."
            self._findings.add(severity, "stretch", frame.index, what, fix, cells, body.name, kind=body.name)

    def _neighbours(self, frame: Frame, h: float) -> Iterator[tuple[BodyHeader, np.ndarray, np.ndarray, float]]:
        """Yield each elastic body on the updated grid, rows of its pairs along axes, and their permitted cells."""
        for label, body in enumerate(() if self._header.total else self._header.bodies):
            rows = np.flatnonzero(frame.body == label)
            law = self._header.laws[frame.material[rows[0]]] if len(rows) and self._header.laws else None
            if law is None or law.deformation != "F" or not law.coherent or law.projects:
                continue
            x = frame.position[rows].astype(np.float64)
            distance = h * body.particles_per_cell ** (-1 / self._header.dimension)
            places = np.round((x - x.min(0)) / distance)
            ends = []
            for axis in range(x.shape[1]):
                order = np.lexsort((x[:, axis], *np.delete(places, axis, axis=1).T))
                near = np.linalg.norm(np.diff(x[order], axis=0), axis=1) <= NEIGHBOUR * distance
                ends.append(np.stack([order[:-1][near], order[1:][near]]))
            first, second = rows[np.concatenate(ends, axis=1)]
            if len(first):
                yield body, first, second, max(STRETCHED, SPARSE * distance / h)


class CrowdCheck(FrameCheck):
    """Finds crowds of liquids and grains, and viscous liquids that spray, in a few frames and the last one.

    Its figures are those of the last frame examined, None without such material.
    """

    START: ClassVar = {"densest_cell": None, "empty_cells": None}

    def __init__(self, header: RunHeader, findings: FrameFindings, last: int) -> None:
        super().__init__(header, findings)
        self._flows = np.array([law.name in laws() and laws()[law.name].flows for law in header.laws], bool)
        self._share = np.array([1 / body.particles_per_cell for body in header.bodies])
        # With fewer than two particles along an axis a crowd may be due to chance.
        coarse = (self._share > 2.0**-header.dimension).any()
        known = header.spacing is not None and header.origin is not None and self._flows.any()
        self._looked_at = {*range(0, last + 1, max(1, (last + 1) // FEW)), last} if known and not coarse else set()

    def check(self, frame: Frame) -> None:
        """Check a frame of finite values."""
        if frame.index not in self._looked_at:
            return
        self._spray(frame)
        header, frame = self._header, frame.of_present
        rows = self._flows[frame.material]
        if not rows.any():
            return
        cells = np.floor((frame.position[rows] - header.origin) / header.spacing)
        # Cells around the material; the middle cells have complete windows.
        margin = 2 * WINDOW
        first = cells.min(axis=0) - margin
        shape = cells.max(axis=0) - first + 1 + margin
        if np.prod(shape) > MOST_CELLS:
            return
        first, shape = first.astype(int), shape.astype(int)
        places = np.ravel_multi_index((cells.astype(int) - first).T, shape)
        filled = np.bincount(places, self._share[frame.body[rows]], int(np.prod(shape))).reshape(shape)
        # Means over the cells of the domain alone, because no material is behind its walls; each axis in turn is the
        # last.
        around, ends = filled, np.round((header.upper - header.origin) / header.spacing)
        for axis in reversed(range(header.dimension)):
            along = np.arange(shape[axis]) + first[axis]
            there = ((along >= 0) & (along < ends[axis])).astype(float)
            parts = [slice(i, shape[axis] - margin + i) for i in range(margin + 1)]
            total, count = (sum(array[..., part] for part in parts) for array in (around, there))
            around = np.moveaxis(total / np.where(there[WINDOW:-WINDOW], count, np.inf), -1, 0)
        holes = filled[(slice(WINDOW, -WINDOW),) * header.dimension][around > INSIDE] == 0
        densest, empty = float(filled.max()), float(holes.mean()) if len(holes) >= ENOUGH else 0.0
        self.figures = {"densest_cell": densest, "empty_cells": empty}
        if densest > CROWDED or empty > GAPS:
            what = f"In frame {frame.index} a cell of liquid or grains has {densest:.3g} times the intended particles"
            what += f", and {100 * empty:.2g} % of the cells inside have none: flow has piled particles up"
            fix = 'Refine the domain, or set sampling = "turned".'
            if not header.shifts:
                fix = 'Set solver.redistribute = "auto".'
            self._findings.add("note", "crowd", frame.index, what, fix, value=densest)

    def _spray(self, frame: Frame) -> None:
        """Find viscous bodies whose volume has grown, which shows that they break up into drops."""
        J = volume_ratio(self._header, frame)
        for label, body in enumerate(self._header.bodies if J is not None else ()):
            own = J[frame.body == label]
            if body.material.get("viscosity", 0) >= VISCOUS and len(own) and own.mean() > OPENED:
                mean, name = float(own.mean()), body.name
                what = (
                    f'In frame {frame.index} the viscous liquid of "{name}" has a mean J of {mean:.3g}: it falls apart'
                )
                fix = "Refine the domain across it, or pour it thicker."
                self._findings.add("note", "spray", frame.index, what, fix, value=mean, body=name, kind=name)
