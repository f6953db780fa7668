"""Checks the values of a frame: finite numbers, inside the domain, labels, volumes, distances of neighbours."""

from dataclasses import dataclass

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.frames.frame import Frame
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader
from mpmcli.plain_text import counted

# No law is valid for J below the first. Coherent material would have torn for J above the second.
CRUSHED, BLOWN_UP = 0.1, 10.0
# Share of the particles of a frame on walls from which on it is said: of bodies on the grid there are none.
HELD = 0.01
LOOK = "Look at this particle, and lower time.safety or refine the domain where it is."
TOUCHED = "The file was changed after the run; copy it again or run the scene again."
SOFTER = "Make its material stiffer, the domain finer, or time.safety lower."
# Distance of neighbours, in cells, above which the grid hardly sees their relative motion; with one particle per cell,
# which stand a cell apart at rest, that at which they are stretched by SPARSE.
STRETCHED, SPARSE = 0.9, 1.25
# Distance, in cells, that a kernel reaches.
TORN = 1.5
# Distance at the start, over that of a lattice, up to which two particles count as neighbours; the diagonal is at 1.41.
NEIGHBOUR = 1.2
# Frames of a run that are searched for crowds, and the most cells around its material of which that is done.
FEW, MOST_CELLS = 4, 3e7
# Particles in a cell over those meant, and share of empty cells inside, from which on it is said.
CROWDED, GAPS = 3.0, 0.05
# Mean J of a viscous liquid from which on it is said.
OPENED = 1.2
# Cells to each side of one that is inside, how full they are on average then, and the fewest that tell a share.
WINDOW, INSIDE, ENOUGH = 2, 0.85, 64


class FrameCheck:
    """One of the checks that look at the frames of a run in their order."""

    def __init__(self, header: RunHeader, findings: FrameFindings) -> None:
        self._header = header
        self._findings = findings

    def _body(self, frame: Frame, p: int) -> str:
        return self._header.body_name(int(frame.body[p]))


class StateCheck(FrameCheck):
    """Checks values, constant ones against the first frame; `stored` ones are of a file, which may be changed."""

    def __init__(self, header: RunHeader, findings: FrameFindings, *, stored: bool = True) -> None:
        super().__init__(header, findings)
        self._stored = stored
        self._first: Frame | None = None

    def check(self, number: int, frame: Frame, ids: np.ndarray, count: int) -> np.ndarray | None:
        """Check a frame of `count` listed particles; return which have finite values only, (n,) bool, None if all."""
        n = len(frame.position)
        first = self._first if self._first is not None else frame
        if n != count or (len(first.position) != n and not self._header.drops):
            expected = len(first.position) if n == count else count
            what = f"Frame {number} holds {n} particles instead of {expected}"
            fix = "No particle may come or go in a run: run the scene again."
            self._findings.add("error", "particle-count", number, what, fix, value=n - expected)
        sound = self._finite(number, frame)
        self._inside(number, frame)
        if self._stored and not self._header.drops:
            self._labels(number, frame, first, ids)
            self._twins(number, frame)
        self._constants(number, frame, first)
        # Only the arrays that later frames are compared with stay in memory.
        if self._first is None:
            kept = {name: frame.fields[name] for name in ("mass",) if name in frame.fields}
            self._first = Frame(
                frame.index, frame.time, frame.step, frame.position, frame.velocity, frame.body, frame.material, kept
            )
        return sound

    def volume_ratio(self, frame: Frame) -> np.ndarray | None:
        """Return J of each particle as stored, or from the density, (n,); None if neither is stored."""
        if "volume_ratio" in frame.fields:
            return frame.fields["volume_ratio"]
        densities = np.array(self._header.densities)
        if "density" not in frame.fields or not len(densities) or not _within(frame.body, len(densities)):
            return None
        with np.errstate(divide="ignore", invalid="ignore"):
            return densities[frame.body] / frame.fields["density"]

    def _finite(self, number: int, frame: Frame) -> np.ndarray | None:
        sound = None
        for name, array in (("position", frame.position), ("velocity", frame.velocity), *frame.fields.items()):
            if array.dtype.kind != "f" or np.isfinite(array).all():
                continue
            rows = np.isfinite(array).reshape(len(array), -1).all(1)
            p, lost = int(np.flatnonzero(~rows)[0]), len(rows) - int(rows.sum())
            body = self._body(frame, p)
            first = f'the first of them number {p} of body "{body}"'
            what = f"In frame {number} {name} is not finite at {counted(lost, 'particle')}, {first}"
            fix = "Leave out the frames from here on, and run the scene again with a lower time.safety."
            self._findings.add("error", "not-finite", number, what, fix, value=lost, body=body, kind=name)
            sound = rows if sound is None else sound & rows
        return sound

    def _inside(self, number: int, frame: Frame) -> None:
        header, frame = self._header, frame.of_present
        if header.origin is None or len(frame.position) == 0:
            return
        # At an open face particles stay outside until the next sort.
        late = 2 * header.spacing * np.array(header.open_axes) if any(header.open_axes) else 0.0
        tolerance = np.full(header.dimension, 4 * header.place_error(frame.position.dtype)) + late
        # A NaN fails all comparisons and is ignored below; it has its own finding.
        lowest, highest = extent(frame.position)
        strictly = (lowest > header.origin).all() and (highest < header.upper).all()
        if number > 0 and not any(header.open_axes) and not strictly:
            self._held(number, frame)
        if (lowest >= header.origin - tolerance).all() and (highest <= header.upper + tolerance).all():
            return
        out = np.fmax(header.origin - frame.position, frame.position - header.upper)
        beyond = np.where(out > tolerance, out, -np.inf).max(1)
        if not np.isfinite(beyond.max()):
            return
        p = int(beyond.argmax())
        body = self._body(frame, p)
        outside = counted(int(np.isfinite(beyond).sum()), "particle")
        farthest = f'the farthest of them, number {p} of body "{body}", by {beyond[p]:.4g} m'
        what = f"In frame {number} {outside} out of the domain, {farthest}"
        self._findings.add("error", "escaped", number, what, LOOK, value=float(beyond[p]), body=body)

    def _held(self, number: int, frame: Frame) -> None:
        """Find particles that would have left, and that the domain put on a wall (docs/theory.md, 3.5)."""
        on_wall = (frame.position <= self._header.origin) | (frame.position >= self._header.upper)
        on_wall = (on_wall & ~self._header.periodic).any(1)
        held = int(on_wall.sum())
        if held > HELD * len(on_wall):
            what = (
                f"In frame {number} {held} of {counted(len(on_wall), 'particle')} lie on a wall, where the domain "
                "holds what would leave it: the rest of their way is lost"
            )
            fix = 'With solids = "total" a stiffer material gives way less; "updated" lets none so near.'
            self._findings.add("note", "held-positions", number, what, fix, value=held / len(on_wall))

    def _labels(self, number: int, frame: Frame, first: Frame, ids: np.ndarray) -> None:
        for name, labels, expected in (
            ("id", ids, np.arange(len(frame.position))),
            ("body", frame.body, first.body),
            ("material", frame.material, first.material),
        ):
            if len(labels) != len(expected):
                continue  # a finding of the count
            changed = np.flatnonzero(labels != expected)
            if len(changed):
                p = int(changed[0])
                what = f"In frame {number} the {name} of particle {p} is {labels[p]} instead of {expected[p]}"
                what += f", and {len(changed) - 1} more differ" if len(changed) > 1 else ""
                self._findings.add("error", "label", number, what, TOUCHED, value=len(changed), kind=name)
        known = {"body": self._header.bodies, "material": self._header.laws}
        for name, labels in (("body", frame.body), ("material", frame.material)):
            if known[name] and not _within(labels, len(known[name])):
                what = f"In frame {number} a particle has {name} {labels.max()}, where there are {len(known[name])}"
                self._findings.add("error", "label", number, what, TOUCHED, kind=f"{name} range")

    def _twins(self, number: int, frame: Frame) -> None:
        """Find particles of equal position and velocity, except on walls, where several may coincide."""
        frame = frame.of_present
        hashes = np.sort(_hashes(frame.position))
        if not (hashes[1:] == hashes[:-1]).any():
            return
        order = np.lexsort((*frame.velocity.T, *frame.position.T))
        same = (frame.position[order[1:]] == frame.position[order[:-1]]).all(1)
        same &= (frame.velocity[order[1:]] == frame.velocity[order[:-1]]).all(1)
        if self._header.origin is not None:
            inside = (frame.position > self._header.origin) & (frame.position < self._header.upper)
            same &= inside.all(1)[order[1:]]
        if same.any():
            at = int(np.flatnonzero(same)[0])
            p, q = sorted((int(order[at]), int(order[at + 1])))
            what = f"In frame {number} particles {p} and {q} are duplicates: equal in position and velocity"
            self._findings.add("error", "duplicated-particles", number, what, TOUCHED, value=int(same.sum()))

    def _constants(self, number: int, frame: Frame, first: Frame) -> None:
        """Check that masses are constant, and that density times J is the density at rest."""
        mass = frame.fields.get("mass")
        if mass is not None and not self._header.drops and len(mass) == len(first.fields["mass"]):
            changed = np.flatnonzero(mass != first.fields["mass"])
            if len(changed):
                p = int(changed[0])
                body, was = self._body(frame, p), first.fields["mass"][p]
                weighs = f"weighs {mass[p]:.6g} kg instead of {was:.6g} kg"
                what = f'In frame {number} particle {p} of body "{body}" {weighs}'
                self._findings.add("error", "mass", number, what, TOUCHED, float(mass[p]), body, kind="particle")
        densities = np.array(self._header.densities)
        both = {"density", "volume_ratio"} <= frame.fields.keys()
        if both and len(densities) and _within(frame.body, len(densities)):
            product = frame.fields["density"].astype(np.float64) * frame.fields["volume_ratio"]
            error = np.abs(product / densities[frame.body] - 1)
            error = np.where(np.isfinite(error), error, 0.0)
            if len(error) and error.max() > 1e-5:
                p = int(error.argmax())
                what = f"In frame {number} density and volume_ratio of particle {p} differ by {error[p]:.3g}"
                self._findings.add("error", "density", number, what, TOUCHED, value=float(error[p]))

    def check_volume(self, number: int, frame: Frame, J: np.ndarray) -> None:
        """Check the volume ratio of each particle, (n,)."""
        fine = J[np.isfinite(J)]
        if len(fine) == 0 or (fine.min() >= CRUSHED and fine.max() <= BLOWN_UP):
            return
        for severity, bad, word in (
            ("error", J <= 0, "has no volume left"),
            ("warning", (J > 0) & (J < CRUSHED), "is crushed"),
            ("warning", (J > BLOWN_UP) & self._holds_together(frame), "is blown up"),
        ):
            rows = np.flatnonzero(bad)
            if len(rows):
                p = int(rows[0] if severity == "error" else rows[np.abs(np.log(J[rows])).argmax()])
                body = self._body(frame, p)
                what = f'In frame {number} particle {p} of body "{body}" {word}: its J is {J[p]:.4g}'
                self._findings.add(severity, "volume", number, what, SOFTER, float(J[p]), body, kind=word)

    def _holds_together(self, frame: Frame) -> np.ndarray:
        coherent = [law.coherent for law in self._header.laws]
        if not _within(frame.material, len(coherent)):
            return np.zeros(len(frame.material), bool)
        return np.array(coherent)[frame.material]


def extent(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner of the particles, (d,) each, m; column by column, which is faster."""
    columns = np.ascontiguousarray(position.T)
    return columns.min(1), columns.max(1)


def _within(labels: np.ndarray, count: int) -> bool:
    return len(labels) == 0 or bool(labels.min() >= 0 and labels.max() < count)


def _hashes(position: np.ndarray) -> np.ndarray:
    hashes = np.zeros(len(position), np.uint64)
    for column in position.T:
        # Adding 0.0 turns -0.0 into 0.0.
        hashes ^= np.ascontiguousarray(column + 0.0).view(f"u{column.itemsize}").astype(np.uint64)
        hashes *= np.uint64(0x9E3779B97F4A7C15)
        hashes ^= hashes >> np.uint64(29)
    return hashes


@dataclass(frozen=True)
class _Neighbours:
    """Pairs of particles of a body, by their rows, (k,) each, and the distance in cells that they may have."""

    body: int
    first: np.ndarray
    second: np.ndarray
    allowed: float


class StretchCheck(FrameCheck):
    """Follows neighbours in elastic bodies, which the grid must see; `largest` distance in cells, None without any."""

    def __init__(self, header: RunHeader, findings: FrameFindings) -> None:
        super().__init__(header, findings)
        self._pairs: list[_Neighbours] | None = None
        self.largest: float | None = None

    def check(self, number: int, frame: Frame) -> None:
        """Check a frame of finite values."""
        h = self._header.spacing
        if self._pairs is None:
            self._pairs = [] if h is None else self._neighbours(frame, h)
            self._count = len(frame.position)
        if len(frame.position) != self._count:
            return
        for pair in self._pairs:
            apart = frame.position[pair.second] - frame.position[pair.first]
            squares = np.einsum("ij,ij->i", apart, apart)
            cells = float(np.sqrt(float(squares.max()))) / h
            self.largest = max(self.largest or 0.0, cells)
            if cells > pair.allowed:
                self._tell(number, pair, cells, int((squares > (pair.allowed * h) ** 2).sum()))

    def _tell(self, number: int, pair: _Neighbours, cells: float, count: int) -> None:
        body, d = self._header.bodies[pair.body], self._header.dimension
        enough = int(np.ceil(body.particles_per_cell ** (1 / d) * cells / STRETCHED)) ** d
        pairs = f'{count} pairs of neighbours of body "{body.name}"'
        what = f"In frame {number} {pairs} stand up to {cells:.3g} cells apart"
        if cells > TORN:
            severity = "warning"
            what += f", farther than {TORN:g}, which a kernel reaches: it has torn, which its material cannot"
        else:
            severity = "note"
            what += f", above {pair.allowed:.3g}: the grid hardly sees what moves between them, noise grows, "
            what += "and gaps open"
        fix = f"Set particles_per_cell = {enough}, or stretch it less."
        self._findings.add(severity, "stretch", number, what, fix, cells, body.name, kind=body.name)

    def _neighbours(self, frame: Frame, h: float) -> list[_Neighbours]:
        """Return pairs along axes of a lattice in each elastic body; on the grid of rest none matter."""
        pairs = []
        for label, body in enumerate(() if self._header.total else self._header.bodies):
            rows = np.flatnonzero(frame.body == label)
            if len(rows) < 2 or not self._elastic(int(frame.material[rows[0]])):
                continue
            x = frame.position[rows].astype(np.float64)
            distance = h * body.particles_per_cell ** (-1 / self._header.dimension)
            places = np.round((x - x.min(0)) / distance)
            ends = []
            for axis in range(x.shape[1]):
                order = np.lexsort((x[:, axis], *np.delete(places, axis, axis=1).T))
                apart = np.linalg.norm(np.diff(x[order], axis=0), axis=1)
                near = apart <= NEIGHBOUR * distance
                ends.append(np.stack([order[:-1][near], order[1:][near]]))
            first, second = rows[np.concatenate(ends, axis=1)]
            if len(first):
                pairs.append(_Neighbours(label, first, second, max(STRETCHED, SPARSE * distance / h)))
        return pairs

    def _elastic(self, material: int) -> bool:
        if not 0 <= material < len(self._header.laws):
            return False
        law = self._header.laws[material]
        return law.deformation == "F" and law.coherent and not law.projects


class CrowdCheck(FrameCheck):
    """Looks for crowds of liquids and grains, and for viscous liquids that spray, in a few frames and the last one.

    Attributes:
        densest: particles in the fullest cell over those meant; empty: share of empty cells of those inside, in the
            last frame that was looked at. None without such material.
    """

    def __init__(self, header: RunHeader, findings: FrameFindings, frames: int) -> None:
        super().__init__(header, findings)
        flowing = {name for name, law in laws().items() if law.flows}
        self._flows = np.array([law.name in flowing for law in header.laws])
        self._viscous = np.array([body.material.get("viscosity", 0) > 0 for body in header.bodies], bool)
        self._share = np.array([1 / body.particles_per_cell for body in header.bodies])
        known = header.spacing is not None and header.origin is not None
        # Of fewer than two along an axis a crowd is no more than chance.
        coarse = (self._share > 2.0**-header.dimension).any()
        self._every = max(1, frames // FEW) if known and self._flows.any() and not coarse else 0
        self._last = frames - 1
        self.densest: float | None = None
        self.empty: float | None = None

    def check(self, k: int, number: int, frame: Frame, J: np.ndarray | None = None) -> None:
        """Check the k-th frame, of finite values, with the J of its particles, (n,), where they are known."""
        if self._every == 0 or (k % self._every and k != self._last):
            return
        if J is not None and _within(frame.body, len(self._viscous)):
            self._spray(number, frame, J)
        frame, d, h = frame.of_present, self._header.dimension, self._header.spacing
        if not (_within(frame.body, len(self._share)) and _within(frame.material, len(self._flows))):
            return
        rows = self._flows[frame.material]
        if not rows.any():
            return
        cells = np.floor((frame.position[rows] - self._header.origin) / h).astype(np.int64)
        # Before the first cell a margin of empty ones, which the sums below subtract.
        first = cells.min(axis=0) - WINDOW - 1
        shape = cells.max(axis=0) - first + 1 + WINDOW
        if np.prod(shape.astype(float)) > MOST_CELLS:
            return
        places = np.ravel_multi_index((cells - first).T, shape)
        filled = np.bincount(places, self._share[frame.body[rows]], int(np.prod(shape))).reshape(shape)
        around = filled
        for axis in range(d):
            total = np.cumsum(around, axis=axis)
            # Over the cells of the domain alone, as nothing can be behind its walls.
            along = np.arange(shape[axis]) + first[axis]
            end = round((self._header.upper[axis] - self._header.origin[axis]) / h) - 1
            count = np.minimum(along + WINDOW, end) - np.maximum(along - WINDOW, 0) + 1
            count = np.where((along >= 0) & (along <= end), count, np.inf)
            count = np.expand_dims(count, [a for a in range(d) if a != axis])
            ahead = np.take(total, np.minimum(np.arange(shape[axis]) + WINDOW, shape[axis] - 1), axis)
            around = (ahead - np.roll(total, WINDOW + 1, axis)) / count
        inside = around > INSIDE
        self.densest = float(filled.max())
        self.empty = float((filled[inside] == 0).mean()) if inside.sum() >= ENOUGH else 0.0
        if self.densest > CROWDED or self.empty > GAPS:
            what = (
                f"In frame {number} a cell of liquid or grains has {self.densest:.3g} times the particles meant, and "
                f"{100 * self.empty:.2g} % of the cells inside have none: flow has piled particles up"
            )
            fix = 'Set solver.redistribute = "auto", or jitter the sampling.'
            self._findings.add("note", "crowd", number, what, fix, value=self.densest)

    def _spray(self, number: int, frame: Frame, J: np.ndarray) -> None:
        """Find viscous bodies that have opened, as only what falls apart into drops does."""
        for label in np.flatnonzero(self._viscous).tolist():
            own = frame.body == label
            mean = float(J[own].mean()) if own.any() else 0.0
            if mean > OPENED:
                name = self._header.bodies[label].name
                what = f'In frame {number} the viscous liquid of "{name}" has a mean J of {mean:.3g}: it falls apart'
                fix = "Refine the domain across it, or pour it thicker."
                self._findings.add("note", "spray", number, what, fix, value=mean, body=name, kind=name)
