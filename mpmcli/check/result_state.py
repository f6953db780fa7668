"""Checks the values of a frame: finite numbers, inside the domain, volumes, distances of neighbours, crowds."""

from collections.abc import Iterator

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.frames.frame import Frame
from mpmcli.materials.registry import laws
from mpmcli.output.header import BodyHeader, RunHeader
from mpmcli.plain_text import counted

# No law is valid for J below the first. Coherent material would have torn for J above the second.
CRUSHED, BLOWN_UP = 0.1, 10.0
# Share of the particles of a frame on walls from which on it is said: of bodies on the grid there are none.
HELD = 0.01
LOOK = "Look at this particle, and lower time.safety or refine the domain where it is."
TOUCHED = "The file was changed after the run; copy it again or run the scene again."
SOFTER = "Make its material stiffer, the domain finer, or time.safety lower."
LOWER_SAFETY = "Lower time.safety, or refine the domain."
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
    """Checks the values of each frame by themselves, and the number of its particles."""

    _count: int | None = None

    def check(self, number: int, frame: Frame) -> np.ndarray | None:
        """Check a frame; return which particles have finite values only, (n,) bool, None if all."""
        n = len(frame.position)
        if self._count is None or self._header.drops:
            self._count = n
        if n != self._count:
            what = f"Frame {number} holds {n} particles instead of {self._count}"
            fix = "No particle may come or go in a run: run the scene again."
            self._findings.add("error", "particle-count", number, what, fix, value=n - self._count)
        self._inside(number, frame)
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
        """Find particles out of the domain, and those that it holds on a wall (docs/theory.md, 3.5)."""
        header, frame = self._header, frame.of_present
        if header.origin is None or len(frame.position) == 0:
            return
        # A NaN has a finding of its own.
        lowest, highest = extent(frame.position)
        if (lowest > header.origin).all() and (highest < header.upper).all():
            return
        out = np.fmax(header.origin - frame.position, frame.position - header.upper)
        held = int(((out >= 0) & ~header.periodic).any(1).sum())
        opened = any(header.open_axes)
        if number > 0 and not opened and held > HELD * len(out):
            what = (
                f"In frame {number} {held} of {counted(len(out), 'particle')} lie on a wall, where the domain "
                "holds what would leave it: the rest of their way is lost"
            )
            fix = 'With solids = "total" a stiffer material gives way less; "updated" lets none so near.'
            self._findings.add("note", "held-positions", number, what, fix, value=held / len(out))
        # At an open face particles stay outside until the next sort.
        late = 2 * header.spacing * np.array(header.open_axes) if opened else 0.0
        far = (out > 4 * header.place_error(frame.position.dtype) + late) & np.isfinite(out)
        beyond = np.where(far, out, 0.0).max(1)
        if beyond.any():
            p = int(beyond.argmax())
            body = self._body(frame, p)
            farthest = f'the farthest of them, number {p} of body "{body}", by {beyond[p]:.4g} m'
            what = f"In frame {number} {counted(np.count_nonzero(beyond), 'particle')} out of the domain, {farthest}"
            self._findings.add("error", "escaped", number, what, LOOK, value=float(beyond[p]), body=body)

    def volume_ratio(self, number: int, frame: Frame) -> np.ndarray | None:
        """Check J of each particle as stored, or from the density; return it, (n,), None if neither is stored."""
        J, densities = frame.fields.get("volume_ratio"), self._header.densities
        if J is None and "density" in frame.fields and densities:
            J = np.array(densities)[frame.body] / frame.fields["density"]
        if J is None or len(J) == 0 or (J.min() >= CRUSHED and J.max() <= BLOWN_UP):
            return J
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
                body = self._body(frame, p)
                what = f'In frame {number} particle {p} of body "{body}" {word}: its J is {J[p]:.4g}'
                self._findings.add(severity, "volume", number, what, SOFTER, float(J[p]), body, kind=word)
        return J


def extent(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner of the particles, (d,) each, m; column by column, which is faster."""
    columns = np.ascontiguousarray(position.T)
    return columns.min(1), columns.max(1)


class StretchCheck(FrameCheck):
    """Follows neighbours in elastic bodies, which the grid must see; `largest` distance in cells, None without any."""

    _count: int | None = None
    largest: float | None = None

    def check(self, number: int, frame: Frame) -> None:
        """Check a frame of finite values."""
        header, h = self._header, self._header.spacing
        if self._count is None:
            self._count, self._pairs = len(frame.position), [] if h is None else list(self._neighbours(frame, h))
        if len(frame.position) != self._count:
            return
        for body, first, second, allowed in self._pairs:
            apart = frame.position[second] - frame.position[first]
            squares = np.einsum("ij,ij->i", apart, apart)
            cells = float(np.sqrt(float(squares.max()))) / h
            self.largest = max(self.largest or 0.0, cells)
            if cells <= allowed:
                continue
            count = int((squares > (allowed * h) ** 2).sum())
            per_axis = int(np.ceil(body.particles_per_cell ** (1 / header.dimension) * cells / STRETCHED))
            pairs = f'{count} pairs of neighbours of body "{body.name}"'
            what = f"In frame {number} {pairs} stand up to {cells:.3g} cells apart"
            if cells > TORN:
                severity = "warning"
                what += f", farther than {TORN:g}, which a kernel reaches: it has torn, which its material cannot"
            else:
                severity = "note"
                what += (
                    f", above {allowed:.3g}: the grid hardly sees what moves between them, noise grows, and gaps open"
                )
            fix = f"Set particles_per_cell = {per_axis**header.dimension}, or stretch it less."
            self._findings.add(severity, "stretch", number, what, fix, cells, body.name, kind=body.name)

    def _neighbours(self, frame: Frame, h: float) -> Iterator[tuple[BodyHeader, np.ndarray, np.ndarray, float]]:
        """Yield each elastic body that moves on the grid, rows of its pairs along axes, and the cells they may have."""
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
    """Looks for crowds of liquids and grains, and for viscous liquids that spray, in a few frames and the last one.

    Attributes:
        densest: particles in the fullest cell over those meant; empty: share of empty cells of those inside, in the
            last frame that was looked at. None without such material.
    """

    densest: float | None = None
    empty: float | None = None

    def __init__(self, header: RunHeader, findings: FrameFindings, frames: int) -> None:
        super().__init__(header, findings)
        self._flows = np.array([law.name in laws() and laws()[law.name].flows for law in header.laws], bool)
        self._share = np.array([1 / body.particles_per_cell for body in header.bodies])
        # Of fewer than two along an axis a crowd is no more than chance.
        coarse = (self._share > 2.0**-header.dimension).any()
        known = header.spacing is not None and header.origin is not None and self._flows.any()
        self._every = max(1, frames // FEW) if known and not coarse else 0
        self._last = frames - 1

    def check(self, k: int, number: int, frame: Frame, J: np.ndarray | None = None) -> None:
        """Check the k-th frame, of finite values, with the J of its particles, (n,), where they are known."""
        if self._every == 0 or (k % self._every and k != self._last):
            return
        if J is not None:
            self._spray(number, frame, J)
        frame, d, h = frame.of_present, self._header.dimension, self._header.spacing
        rows = self._flows[frame.material]
        if not rows.any():
            return
        cells = np.floor((frame.position[rows] - self._header.origin) / h).astype(np.int64)
        # Cells around the material, of which those of the middle have whole windows.
        margin = 2 * WINDOW
        first = cells.min(axis=0) - margin
        shape = cells.max(axis=0) - first + 1 + margin
        if np.prod(shape.astype(float)) > MOST_CELLS:
            return
        places = np.ravel_multi_index((cells - first).T, shape)
        filled = np.bincount(places, self._share[frame.body[rows]], int(np.prod(shape))).reshape(shape)
        # Means over the cells of the domain alone, as nothing can be behind its walls; axes take turns as the last one.
        around, ends = filled, np.round((self._header.upper - self._header.origin) / h)
        for axis in reversed(range(d)):
            along = np.arange(shape[axis]) + first[axis]
            there = ((along >= 0) & (along < ends[axis])).astype(float)
            total, count = (
                sum(array[..., i : array.shape[-1] - margin + i] for i in range(margin + 1))
                for array in (around, there)
            )
            around = np.moveaxis(total / np.where(there[WINDOW:-WINDOW], count, np.inf), -1, 0)
        inside = around > INSIDE
        holes = filled[(slice(WINDOW, -WINDOW),) * d][inside] == 0
        self.densest = float(filled.max())
        self.empty = float(holes.mean()) if len(holes) >= ENOUGH else 0.0
        if self.densest > CROWDED or self.empty > GAPS:
            what = (
                f"In frame {number} a cell of liquid or grains has {self.densest:.3g} times the particles meant, and "
                f"{100 * self.empty:.2g} % of the cells inside have none: flow has piled particles up"
            )
            fix = 'Set solver.redistribute = "auto", or jitter the sampling.'
            self._findings.add("note", "crowd", number, what, fix, value=self.densest)

    def _spray(self, number: int, frame: Frame, J: np.ndarray) -> None:
        """Find viscous bodies that have opened, as only what falls apart into drops does."""
        for label, body in enumerate(self._header.bodies):
            own = frame.body == label if body.material.get("viscosity", 0) > 0 else np.zeros(len(J), bool)
            mean = float(J[own].mean()) if own.any() else 0.0
            if mean > OPENED:
                what = (
                    f'In frame {number} the viscous liquid of "{body.name}" has a mean J of {mean:.3g}: it falls apart'
                )
                fix = "Refine the domain across it, or pour it thicker."
                self._findings.add("note", "spray", number, what, fix, value=mean, body=body.name, kind=body.name)
