"""Checks the values of a frame: finite numbers, particles inside the domain, labels, volumes."""

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.frames.frame import Frame
from mpmcli.output.header import RunHeader
from mpmcli.plain_text import counted

# No law is valid for J below the first. Coherent material would have torn for J above the second.
CRUSHED, BLOWN_UP = 0.1, 10.0
# Share of the particles of a frame on walls from which on it is said: where walls are folded there are none.
HELD = 0.01
LOOK = "Look at this particle, and lower time.safety or refine the domain where it is."
TOUCHED = "The file was changed after the run; copy it again or run the scene again."


class StateCheck:
    """Checks frames in order; quantities that are constant in a run are compared with the first frame."""

    def __init__(self, header: RunHeader, findings: FrameFindings, *, stored: bool = True) -> None:
        """Begin; `stored` is whether the frames come from a file, which may have been changed."""
        self._stored = stored
        self._header = header
        self._findings = findings
        self._first: Frame | None = None

    def check(self, number: int, frame: Frame, ids: np.ndarray, count: int) -> np.ndarray | None:
        """Check a frame, given the ids of its rows and the number of particles that the file lists.

        Returns:
            Which particles have finite values only, (n,) bool; None if all have.
        """
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
            p = int(np.flatnonzero(~rows)[0])
            body = self._body(frame, p)
            lost = counted(len(rows) - int(rows.sum()), "particle")
            what = f'In frame {number} {name} is not finite at {lost}, the first of them number {p} of body "{body}"'
            fix = "Leave out the frames from here on, and run the scene again with a lower time.safety."
            self._findings.add(
                "error", "not-finite", number, what, fix, value=len(rows) - int(rows.sum()), body=body, kind=name
            )
            sound = rows if sound is None else sound & rows
        return sound

    def _inside(self, number: int, frame: Frame) -> None:
        header = self._header
        if header.origin is None or len(frame.position) == 0:
            return
        frame = frame.of_present
        if len(frame.position) == 0:
            return
        tolerance = np.full(header.dimension, 4 * header.place_error(frame.position.dtype))
        for axis, is_open in enumerate(header.open_axes):
            # There they stay until the next sort.
            tolerance[axis] += 2 * header.spacing * is_open
        low, high = header.origin - tolerance, header.upper + tolerance
        # A NaN fails both comparisons and is ignored below; it has its own finding.
        lowest, highest = extent(frame.position)
        if (
            number > 0
            and not any(header.open_axes)
            and not ((lowest > header.origin).all() and (highest < header.upper).all())
        ):
            self._held(number, frame)
        if (lowest >= low).all() and (highest <= high).all():
            return
        out = np.fmax(header.origin - frame.position, frame.position - header.upper)
        beyond = np.where(out > tolerance, out, -np.inf).max(1)
        if not np.isfinite(beyond.max()):
            return
        p, body = int(beyond.argmax()), self._body(frame, int(beyond.argmax()))
        outside = counted(int(np.isfinite(beyond).sum()), "particle")
        what = (
            f"In frame {number} {outside} out of the domain, the farthest "
            f'of them, number {p} of body "{body}", by {beyond[p]:.4g} m'
        )
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
            fix = 'Walls that are "folded" let none so near; with solids = "total" a stiffer material gives way less.'
            self._findings.add("note", "held-positions", number, what, fix, value=held / len(on_wall))

    def _labels(self, number: int, frame: Frame, first: Frame, ids: np.ndarray) -> None:
        n = len(frame.position)
        labels = {"id": (ids, np.arange(n)), "body": (frame.body, first.body)}
        labels["material"] = (frame.material, first.material)
        for name, (found, expected) in labels.items():
            if len(found) != len(expected):
                continue  # a finding of the count
            changed = np.flatnonzero(found != expected)
            if len(changed):
                p = int(changed[0])
                what = (
                    f"In frame {number} the {name} of particle {p} is {found[p]} instead of {expected[p]}"
                    f"{f', and {len(changed) - 1} more differ' if len(changed) > 1 else ''}"
                )
                self._findings.add("error", "label", number, what, TOUCHED, value=len(changed), kind=name)
        for name, found, known in (
            ("body", frame.body, self._header.bodies),
            ("material", frame.material, self._header.laws),
        ):
            if known and not _within(found, len(known)):
                what = f"In frame {number} a particle has {name} {found.max()}, where there are {len(known)}"
                self._findings.add("error", "label", number, what, TOUCHED, kind=f"{name} range")

    def _twins(self, number: int, frame: Frame) -> None:
        """Find particles of equal position and velocity, except on walls, where several may coincide."""
        frame = frame.of_present
        n = len(frame.position)
        keys = _hashes(frame.position)
        ordered = np.sort(keys)
        if n < 2 or not (ordered[1:] == ordered[:-1]).any():
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
                body = self._body(frame, p)
                was = first.fields["mass"][p]
                what = (
                    f'In frame {number} particle {p} of body "{body}" weighs {mass[p]:.6g} kg instead of {was:.6g} kg'
                )
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
                fix = "Make its material stiffer, the domain finer, or time.safety lower."
                self._findings.add(severity, "volume", number, what, fix, float(J[p]), body, kind=word)

    def _holds_together(self, frame: Frame) -> np.ndarray:
        """Return whether the law of each particle is coherent, (n,) bool."""
        coherent = [law.coherent for law in self._header.laws]
        if not _within(frame.material, len(coherent)):
            return np.zeros(len(frame.material), bool)
        return np.array(coherent)[frame.material]

    def _body(self, frame: Frame, p: int) -> str:
        return self._header.body_name(int(frame.body[p]))


def extent(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner of the particles, (d,) each, m; column by column, which is faster."""
    columns = np.ascontiguousarray(position.T)
    return columns.min(1), columns.max(1)


def _within(labels: np.ndarray, count: int) -> bool:
    return len(labels) == 0 or bool(labels.min() >= 0 and labels.max() < count)


def _hashes(position: np.ndarray) -> np.ndarray:
    """Return a hash of each row, (n,) uint64."""
    # Adding 0.0 turns -0.0 into 0.0.
    columns = [np.ascontiguousarray(column + 0.0).view(f"u{column.itemsize}") for column in position.T]
    result = np.zeros(len(position), np.uint64)
    for column in columns:
        result ^= column.astype(np.uint64)
        result *= np.uint64(0x9E3779B97F4A7C15)
        result ^= result >> np.uint64(29)
    return result
