"""Copies particles from and to the host, by one launch for all fields."""

from collections.abc import Sequence

import numpy as np
import taichi as ti

# Particles of a launch that reads them: with up to 27 numbers each, their entries stay within 32-bit indices, and a GPU
# needs half a gigabyte for them.
MOST_READ = 2**22


@ti.data_oriented
class ParticleExchange:
    """What `ParticleArrays` has to be read and written; the attributes are those documented there."""

    def read(self, first: int, count: int, bodies: Sequence[int], row: int = 0) -> dict[str, np.ndarray]:
        """Return x, v, C, deformation, internal, (n, k), id and body, (n), of a range of particles.

        One launch reads all fields of up to MOST_READ particles: a launch per field would take most of the time of a
        frame of few particles.

        Args:
            bodies: index in the scene of each body of the group; row: of the first of them in the table.
        """
        d = self.dimension
        widths = {"x": d, "v": d, "C": d * d, "deformation": self._deformation_width, "internal": len(self.internal)}
        reals, labels = np.empty((count, sum(widths.values())), self.real), np.empty((count, 3), np.int32)
        for begin in range(0, count, MOST_READ):
            rows = slice(begin, begin + MOST_READ)
            self._read(first + begin, reals[rows], labels[rows])
        found, end = {}, 0
        for name, width in widths.items():
            found[name] = reals[:, end : end + width]
            end += width
        found["C"] = found["C"].reshape(count, d, d)
        if self.J_minus_1 is None:
            found["deformation"] = np.eye(d, dtype=self.real) + found["deformation"].reshape(count, d, d)
        else:
            found["deformation"] = 1 + found["deformation"].reshape(count)
        found["id"] = labels[:, 0]
        found["body"] = np.array(bodies, np.int32)[labels[:, 1] - row]
        if self.comes_and_goes:
            found["activity"] = labels[:, 2]
        return found

    def write(self, first: int, found: dict[str, np.ndarray], row: np.ndarray) -> None:
        """Set a range of particles to what `read` returned, and to their initial positions if it keeps them.

        Args:
            row: of the body of each particle in the table, (n) int, in place of `found["body"]`.
        """
        count = len(found["x"])
        rest = np.eye(self.dimension) if self.J_minus_1 is None else 1.0
        parts = (found["x"], found["v"], found["C"], found["deformation"] - rest, found["internal"])
        if self.keeps_initial:
            parts = (*parts, found["initial"])
        reals = np.concatenate([part.reshape(count, -1).astype(self.real) for part in parts], axis=1)
        labels = np.stack([found["id"], row, np.broadcast_to(found.get("activity", 1), count)], axis=1).astype(np.int32)
        self._write(first, np.ascontiguousarray(reals), np.ascontiguousarray(labels))

    @property
    def _deformation_width(self) -> int:
        return self.dimension**2 if self.J_minus_1 is None else 1

    @ti.kernel
    def _read(self, first: int, reals: ti.types.ndarray(), labels: ti.types.ndarray()):
        ti.loop_config(serialize=self.serial)
        for q in range(reals.shape[0]):
            d = ti.static(self.dimension)
            p = first + q
            for c in ti.static(range(d)):
                reals[q, c] = self.x[p][c]
                reals[q, d + c] = self.v[p][c]
                for a in ti.static(range(d)):
                    reals[q, (2 + c) * d + a] = self.gradient[p][a, c]
            start = ti.static((2 + d) * d)
            if ti.static(self.law.deformation == "F"):
                for i, j in ti.static(ti.ndrange(d, d)):
                    reals[q, start + i * d + j] = self.displacement_gradient[p][i, j]
            else:
                reals[q, start] = self.J_minus_1[p]
            for i in ti.static(range(len(self.internal))):
                reals[q, start + self._deformation_width + i] = self.internal[i][p]
            labels[q, 0] = self.id[p]
            # Every entry is written: a GPU does not get the zeros of the host.
            if ti.static(self.several):
                labels[q, 1] = self.body[p]
            else:
                labels[q, 1] = 0
            if ti.static(self.comes_and_goes):
                labels[q, 2] = self.activity[p]

    @ti.kernel
    def _write(self, first: int, reals: ti.types.ndarray(), labels: ti.types.ndarray()):
        ti.loop_config(serialize=self.serial)
        for q in range(reals.shape[0]):
            d = ti.static(self.dimension)
            width = ti.static(self.v.n)
            p = first + q
            for c in ti.static(range(d)):
                self.x[p][c] = reals[q, c]
            for c in ti.static(range(width)):
                self.v[p][c] = reals[q, d + c] if ti.static(c < d) else 0.0
            for a, c in ti.static(ti.ndrange(d, self.gradient.m)):
                self.gradient[p][a, c] = reals[q, (2 + c) * d + a] if ti.static(c < d) else 0.0
            start = ti.static((2 + d) * d)
            if ti.static(self.law.deformation == "F"):
                for i, j in ti.static(ti.ndrange(d, width)):
                    if ti.static(j < d):
                        self.displacement_gradient[p][i, j] = reals[q, start + i * d + j]
                    else:
                        self.displacement_gradient[p][i, j] = 0.0
            else:
                self.J_minus_1[p] = reals[q, start]
            for i in ti.static(range(len(self.internal))):
                self.internal[i][p] = reals[q, start + self._deformation_width + i]
            if ti.static(self.keeps_initial):
                for c in ti.static(range(d)):
                    self.initial[p][c] = reals[q, start + self._deformation_width + ti.static(len(self.internal)) + c]
            if ti.static(self.slips):
                for c in ti.static(range(d)):
                    self.slip[p][c] = 0.0
            self.id[p] = labels[q, 0]
            if ti.static(self.several):
                self.body[p] = labels[q, 1]
            if ti.static(self.comes_and_goes):
                self.activity[p] = labels[q, 2]
