"""Checks how far apart the neighbours of an elastic body stand: what lies between them must be seen by the grid."""

from dataclasses import dataclass

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.frames.frame import Frame
from mpmcli.output.header import RunHeader

# Distance of neighbours, in cells, above which the grid hardly sees their relative motion; with one particle per cell,
# which stand a cell apart at rest, that at which they are stretched by SPARSE.
STRETCHED, SPARSE = 0.9, 1.25
# Distance, in cells, that a kernel reaches.
TORN = 1.5
# Distance at the start, over that of a lattice, up to which two particles count as neighbours; the diagonal is at 1.41.
NEIGHBOUR = 1.2


@dataclass(frozen=True)
class _Neighbours:
    body: int
    first: np.ndarray
    second: np.ndarray
    allowed: float


class StretchCheck:
    """Follows pairs of neighbours of the first frame; laws that yield or flow may part them and have others instead.

    Attributes:
        largest: largest distance of two neighbours in any frame, cells; None without elastic bodies.
    """

    def __init__(self, header: RunHeader, findings: FrameFindings) -> None:
        self._header = header
        self._findings = findings
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
        body = self._header.bodies[pair.body]
        per_axis = body.particles_per_cell ** (1 / self._header.dimension)
        enough = int(np.ceil(per_axis * cells / STRETCHED)) ** self._header.dimension
        torn = cells > TORN
        what = (
            f'In frame {number} {count} pairs of neighbours of body "{body.name}" stand up to {cells:.3g} cells apart'
        )
        what += (
            f", farther than {TORN:g}, which a kernel reaches: it has torn, which its material cannot"
            if torn
            else f", above {pair.allowed:.3g}: the grid hardly sees what moves between them, noise grows, and gaps open"
        )
        fix = f"Set particles_per_cell = {enough}, or stretch it less."
        self._findings.add(
            "warning" if torn else "note", "stretch", number, what, fix, cells, body.name, kind=body.name
        )

    def _neighbours(self, frame: Frame, h: float) -> list[_Neighbours]:
        """Return the pairs of each elastic body that follow each other along an axis of a lattice.

        Bodies on the grid of their state at rest have none that matter.
        """
        found = []
        if self._header.total:
            return found
        for label, body in enumerate(self._header.bodies):
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
                found.append(_Neighbours(label, first, second, max(STRETCHED, SPARSE * distance / h)))
        return found

    def _elastic(self, material: int) -> bool:
        if not 0 <= material < len(self._header.laws):
            return False
        law = self._header.laws[material]
        return law.deformation == "F" and law.coherent and not law.projects
