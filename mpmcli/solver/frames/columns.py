"""Particle data at output times, row i for particle i, and the fields of frames computed from them."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mpmcli.materials.law import Law
from mpmcli.solver.particles.arrays import MASS, VOLUME

# Fields that need the stress of every particle.
STRESSES = ("stress", "pressure")
# Particles per batch of array operations, which bounds the memory and fits the cache.
PART = 2**15
# Rows and columns of the entries of a symmetric 3 x 3 matrix; 2D omits the entries that vanish.
ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


def stress_entries(dimension: int) -> tuple[tuple[int, int], ...]:
    """Return the row and column of each stored entry of tau."""
    return ENTRIES if dimension == 3 else ENTRIES[:4]


def parts_of(count: int) -> Iterator[slice]:
    """Yield slices of the rows of `count` particles, PART at a time; an empty one without particles."""
    for first in range(0, max(1, count), PART):
        yield slice(first, min(first + PART, count))


class FrameColumns:
    """Columns of particle data.

    In this order: x relative to the origin of the domain, m, and v, m/s, d each; the stored energy per volume at rest,
    J/m^3, half a step earlier, at the time of the velocities; J or det F, and the internal variables of the law, after
    plastic flow; if a field needs them, C and F after plastic flow, d^2 each, and tau, Pa, see `stress_entries`; and if
    particles come and go, their status, see `particles.sort`.

    Attributes:
        first: first column of each quantity by name, -1 if it is omitted.
        widths: number of columns of each included quantity.
        count: number of all columns.
        dimension: d.
    """

    def __init__(
        self, dimension: int, internal: int, fields: Collection[str] = (), *, particle_count_varies: bool = False
    ) -> None:
        """Assign columns, given the largest number of internal variables of a law and the fields of the frames."""
        d = dimension
        widths = {"x": d, "v": d, "energy": 1, "J": 1, "internal": internal}
        if "affine" in fields:
            widths["affine"] = d * d
        if "deformation_gradient" in fields:
            widths["gradient"] = d * d
        if not set(STRESSES).isdisjoint(fields):
            widths["tau"] = len(stress_entries(d))
        if particle_count_varies:
            widths["activity"] = 1
        self.dimension, self.widths, self.count = d, widths, 0
        self.first = dict.fromkeys(("affine", "gradient", "tau", "activity"), -1)
        for name, width in widths.items():
            self.first[name] = self.count
            self.count += width


@dataclass(frozen=True)
class FrameArrays:
    """Data of n particles at T times: the columns of `reals`, (T, n, k), which may have additional columns."""

    columns: FrameColumns
    reals: np.ndarray

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the columns of a name as a view of `reals`: (T, n) for energy, J and status, else (T, n, columns)."""
        first = self.columns.first[name]
        if name in ("energy", "J", "activity"):
            return self.reals[..., first]
        return self.reals[..., first : first + self.columns.widths[name]]

    def of_rows(self, rows: slice) -> "FrameArrays":
        return FrameArrays(self.columns, self.reals[:, rows])


class RunConstants:
    """Constant data of the n particles of a run, row i for particle i.

    Attributes:
        body, material: (n,) int32, read-only, indices into the bodies of the scene and the laws of the run.
    """

    def __init__(self, groups: Sequence, counts: Sequence[int]) -> None:
        """Store the constants of each `RunGroup`; `counts` are the numbers of particles of each body of the scene."""
        self._laws = [group.law for group in groups]
        # Per body: its law, and the mass and volume of a particle.
        self._law_of = np.zeros(len(counts), np.int32)
        self._table = np.zeros((len(counts), 2))
        for g, group in enumerate(groups):
            self._law_of[list(group.bodies)] = g
            self._table[list(group.bodies)] = group.rows[:, [MASS, VOLUME]]
        self._flows = np.array([law.flows for law in self._laws])
        if len(counts) == 1:
            self.body = self.material = np.broadcast_to(np.int32(0), counts[0])
        else:
            self.body = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
            self.material = self._law_of[self.body]
        # All frames share these arrays.
        for array in (self.body, self.material):
            array.flags.writeable = False
        self._all: ParticleConstants | None = None

    @property
    def masses(self) -> np.ndarray:
        return self._table[:, 0]

    def of_rows(self, rows: slice) -> "ParticleConstants":
        """Return the constants of the particles of some rows; those of all rows are computed once."""
        whole = rows.stop - rows.start == len(self.body)
        if whole and self._all is not None:
            return self._all
        body, material = self.body[rows], self.material[rows]
        if len(self._table) == 1:
            mass, volume, flows = (np.broadcast_to(value, body.shape) for value in (*self._table[0], self._flows[0]))
        else:
            (mass, volume), flows = self._table[body].T, self._flows[material]
        members = tuple(
            (law, slice(None) if len(self._laws) == 1 else np.flatnonzero(material == g))
            for g, law in enumerate(self._laws)
        )
        found = ParticleConstants(mass, volume, flows, members)
        if whole:
            self._all = found
        return found


@dataclass(frozen=True)
class ParticleConstants:
    """Constant data of some particles of a run, (n,).

    Attributes:
        mass: mass, kg.
        volume: volume at rest, m^3.
        flows: whether the law `flows`.
        members: per law, the law and the rows of its particles.
    """

    mass: np.ndarray
    volume: np.ndarray
    flows: np.ndarray
    members: tuple[tuple[Law, slice | np.ndarray], ...]

    def volume_ratios(self, arrays: FrameArrays) -> np.ndarray:
        """Return the ratio of volume to volume at rest, (T, n)."""
        J, internal = arrays["J"], arrays["internal"]
        if not any(law.internal for law, _ in self.members):
            return J
        ratios = np.empty_like(J)
        for law, rows in self.members:
            own = internal[:, rows]
            named = {variable.name: own[..., i] for i, variable in enumerate(law.internal)}
            ratios[:, rows] = law.total_volume_ratio(J[:, rows], named)
        return ratios

    def fields(self, arrays: FrameArrays, ratios: np.ndarray, names: Collection[str]) -> dict[str, np.ndarray]:
        """Return fields of frames by name, (T, n) or (T, n, k), except the velocity and the initial position."""
        real = arrays.reals.dtype
        return {name: np.asarray(self._field(name, arrays, ratios), real) for name in names}

    def _field(self, name: str, arrays: FrameArrays, ratios: np.ndarray) -> np.ndarray:
        """Return a field by its name, (T, n) or (T, n, k); stress and pressure are those of Cauchy, Pa."""
        match name:
            case "volume_ratio":
                return ratios
            case "density":
                return self.mass / self.volume / ratios
            case "mass":
                return np.broadcast_to(self.mass, ratios.shape)
            case "affine":
                return arrays["affine"]
            case "deformation_gradient":
                return arrays["gradient"]
            case "stress":
                return self._stress(arrays) / ratios[..., None]
            case "pressure":
                # `sum` along such a short axis takes five times as long.
                tau = arrays["tau"]
                return (tau[..., 0] + tau[..., 1] + tau[..., 2]) / (-3 * ratios)
        return self._internal(name, arrays)

    def _stress(self, arrays: FrameArrays) -> np.ndarray:
        tau = np.zeros((*arrays.reals.shape[:2], 9), arrays.reals.dtype)
        # Adding 0 removes the sign of zeros, which depends on the optimisation of the kernel.
        entries = arrays["tau"] + 0.0
        for column, (i, j) in enumerate(stress_entries(arrays.columns.dimension)):
            tau[..., 3 * i + j] = tau[..., 3 * j + i] = entries[..., column]
        return tau

    def _internal(self, name: str, arrays: FrameArrays) -> np.ndarray:
        """Return an internal variable; for particles of other laws, its value at rest."""
        variables = [variable for law, _ in self.members for variable in law.internal if variable.name == name]
        values = np.full(arrays.reals.shape[:2], variables[-1].at_rest, arrays.reals.dtype)
        for law, rows in self.members:
            for i, variable in enumerate(law.internal):
                if variable.name == name:
                    values[:, rows] = arrays["internal"][:, rows, i]
        return values
