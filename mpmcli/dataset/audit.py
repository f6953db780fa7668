"""Audits exported files as a stranger would: metadata.json and trajectories alone, rule by rule.

Tolerances: stored positions have a spacing `eps` = 2^-23 max|x| (float32), a second difference an error of 2 eps, the
mean of n of them one of 2 eps / sqrt(n). Frames lie `dt` apart to within a step of the solver, on which second
differences depend by less than a thousandth.
"""

import json
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, starmap
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.dataset.certify import STD_LEAST
from mpmcli.dataset.exported import trajectories
from mpmcli.dataset.hold_out import held_in
from mpmcli.dataset.metadata import EXPORTED_BY
from mpmcli.dataset.shard import SPLITS
from mpmcli.frames.frame import ACTIVE
from mpmcli.output.header import nearest_image
from mpmcli.plain_text import counted

# Findings of a rule that are printed; frames of a window of free flight, about the most windows in a trajectory, and
# the most cells of the grid on which bodies are told apart.
MOST, WINDOW, WINDOWS, CELLS = 5, 5, 32, 10**7
# Names of the types of particles on walls in metadata.json; and their numbers for GNS and LagrangeBench without it.
WALLS, USUAL_WALLS = ("wall", "moving_wall", "rigid_body"), {"gns": (3,), "lagrangebench": (1, 2, 3)}
# Frame and value, None if there is none, and a sentence.
Findings = Iterator[tuple[int | None, float | None, str]]


class AbsentError(Exception):
    """The facts that a rule needs are absent; the text says which."""


def _size(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=-1)


def _worst(excess: np.ndarray, sentence: str, first: int = 0) -> Findings:
    """Yield where the excess of particles, (T, n), is largest, if it is positive."""
    excess = np.nan_to_num(excess, nan=-np.inf, posinf=np.inf, neginf=-np.inf)
    if excess.max(initial=0.0) > 0:
        t, p = np.unravel_index(excess.argmax(), excess.shape)
        many = counted(int((excess > 0).any(axis=0).sum()), "particle")
        yield int(t) + first, float(excess[t, p]), f"{many} {sentence}, number {p} by {excess[t, p]:.3g} too much."


@dataclass(frozen=True, eq=False)
class Exported:
    """A trajectory, the facts that rules need, and a method for each rule.

    `arrays` are as stored: `position`, (T, N, d), and others; `own` are those facts of `meta` that are its alone.
    """

    name: str
    split: str
    form: str
    arrays: dict[str, Any]
    meta: dict[str, Any]
    own: dict[str, Any]

    def need(self, key: str) -> Any:
        """Return a fact of the metadata."""
        if not self.meta.get(key):
            raise AbsentError(f"metadata.json does not state {key}")
        return self.meta[key]

    @cached_property
    def on_wall(self) -> np.ndarray:
        """Which of the stored particles are on walls, (N,)."""
        known, n = self.meta.get("particle_types"), self.arrays["position"].shape[1]
        types = USUAL_WALLS.get(self.form, ()) if known is None else [known[k] for k in WALLS if k in known]
        return np.isin(self.kind("kind"), types) if "kind" in self.arrays else np.zeros(n, bool)

    def kind(self, *keys: str) -> np.ndarray:
        """Return the first of some labels of particles that is stored, (N,)."""
        found = next((self.arrays[key] for key in keys if key in self.arrays), 0)
        return np.resize(np.atleast_2d(found)[0], self.arrays["position"].shape[1])

    @cached_property
    def x(self) -> np.ndarray:
        """Positions of material, (T, n, d) float64, nan where a particle is not there."""
        x, there = self.arrays["position"].astype(float), self.arrays.get("status", ACTIVE) == ACTIVE
        return np.where(np.expand_dims(there, -1), x, np.nan)[:, ~self.on_wall]

    @cached_property
    def v(self) -> np.ndarray:
        """Displacements, (T - 1, n, d), to the nearest image."""
        repeats = np.resize(self.meta.get("periodic_boundary_conditions") or False, self.x.shape[2])
        period = np.where(repeats, np.ptp(self.box, axis=0) if repeats.any() else 0, np.inf)
        return nearest_image(np.diff(self.x, axis=0), period)

    @cached_property
    def on_walls(self) -> np.ndarray:
        """Positions of particles on walls, (T, W, d)."""
        own = self.arrays["position"][:, self.on_wall]
        return np.asarray(self.arrays.get("boundary", self.arrays.get("wall_position", own)), float)

    @cached_property
    def eps(self) -> float:
        """Spacing of stored numbers at the largest position."""
        return float(np.finfo(self.arrays["position"].dtype).eps * np.nanmax(np.abs(self.x), initial=0.0))

    @property
    def box(self) -> np.ndarray:
        """Corners of the bounds, (2, d)."""
        return np.asarray(self.need("bounds"), float).T

    @property
    def pause(self) -> float:
        """Time between frames."""
        if not self.meta.get("dt") and len(self.arrays.get("time", ())) > 1:
            return float(np.diff(self.arrays["time"]).mean())
        return float(self.need("dt")) * (self.meta.get("write_every") or 1)

    @property
    def spacing(self) -> float:
        """Distance between particles at the start, `dx` or two thirds of the radius."""
        return float(self.meta.get("dx") or self.need("default_connectivity_radius") / 1.5)

    @cached_property
    def flights(self) -> list[tuple[int, np.ndarray, int]]:
        """Bodies in free flight: first frame of a window, mean second differences (3, d) in it, number of particles.

        Nodes carry forces over 3 cells, 6 spacings: bodies are linked by distances that may be shorter between two
        frames. One flies if its particles are of one kind, there, and as far from bounds and walls.
        """
        from scipy.ndimage import generate_binary_structure, label

        (n, d), kind, found = self.x.shape[1:], self.kind("body", "kind")[~self.on_wall], []
        for key in ("emitters", "forces", "impulses", *["colliders"] * (not self.on_walls.shape[1])):
            if self.own.get("scene", {}).get(key):
                raise AbsentError(f"the scene has {key}")
        low, high = self.box if self.meta.get("bounds") else (-np.inf, np.inf)
        starts = range(0, len(self.x) - WINDOW + 1, WINDOW - 2)
        for first in starts[:: len(starts) // WINDOWS + 1]:
            x, v = self.x[first : first + WINDOW], self.v[first : first + WINDOW - 1]
            reach = 6 * self.spacing + _size(v).max(initial=0.0)
            points = np.concatenate([x, self.on_walls[first : first + WINDOW]], axis=1)
            cells = np.floor((points - points.min(axis=(0, 1))) / reach)
            if not np.prod(cells.max(axis=(0, 1)) + 1) < CELLS:
                continue
            place = tuple(np.moveaxis(cells.astype(int), -1, 0))
            there = np.zeros([part.max() + 1 for part in place], bool)
            there[place] = True
            body = label(there, generate_binary_structure(d, d))[0][place]
            near = ((x < low + reach) | (x > high - reach)).any(axis=-1)
            for b in np.setdiff1d(body, [*body[:, :n][near], *body[:, n:].flat]):
                of = body[0, :n] == b
                if len(np.unique(kind[of])) == 1:
                    found.append((first, np.diff(v[:, of], axis=0).mean(axis=1), int(of.sum())))
        if not found:
            raise AbsentError("no body is in free flight")
        return found

    def finite(self) -> Findings:
        """Positions are numbers."""
        there = np.broadcast_to(self.arrays.get("status", ACTIVE) == ACTIVE, self.arrays["position"].shape[:2])
        bad = (~np.isfinite(self.arrays["position"]).all(axis=-1) & there).sum(axis=1)
        if bad.any():
            yield int(bad.argmax()), int(bad.max()), f"{bad.sum()} positions are not finite, at most {bad.max()} here."

    def counts(self) -> Findings:
        """Frames, particles and components are as many as stated."""
        seen = dict(zip(("num_frames", "num_particles_max", "dim"), self.arrays["position"].shape, strict=True))
        # sequence_length may leave out the frame that is only a target.
        length = self.meta.get("sequence_length") or seen["num_frames"]
        right = {"num_frames": length + (seen["num_frames"] == length + 1)} | self.meta
        for key, value in seen.items():
            stated = right.get(key) or value
            if value > stated or (key != "num_particles_max" and value < stated):
                yield None, value, f"{key} is {value}; metadata.json states {stated}."

    def types(self) -> Findings:
        """Types of particles are those that metadata.json lists, one for each particle."""
        known, laws, right = self.meta.get("particle_types"), self.own.get("laws"), {"kind": range(-1, 10)}
        if known is not None:
            right["kind"] = [known[k] for k in known if laws is None or k in (*laws, *WALLS)]
        right |= {k: range(len(names)) for k, names in (("material", laws), ("body", self.own.get("bodies"))) if names}
        stored = [key for key in right if key in self.arrays]
        if not stored:
            raise AbsentError("no types are stored")
        for key in stored:
            array = self.arrays[key]
            for wrong in sorted({*np.unique(array).tolist()} - {*right[key]})[:1]:
                yield None, wrong, f"particles have the {key} {wrong}; metadata.json lists {[*right[key]]}."
            if array.shape[-1] != self.arrays["position"].shape[1]:
                yield None, array.shape[-1], f"{key} has {array.shape[-1]} entries, and not one per particle."
            elif (change := (np.atleast_2d(array) != self.kind(key)).any(axis=1)).any():
                yield int(change.argmax()), None, f"the {key} of a particle changes."

    def bounds(self) -> Findings:
        """Particles are within bounds, beyond which impacts may press them by one spacing."""
        beyond = np.maximum(self.box[0] - self.x, self.x - self.box[1]) - self.spacing
        return _worst(beyond.max(axis=-1), "beyond bounds")

    def units(self) -> Findings:
        """Neighbours are about `dx` apart at the start."""
        from scipy.spatial import cKDTree

        x = self.x[0][np.isfinite(self.x[0]).all(axis=-1)]
        if len(x) < 2 or "particle_seed" in self.meta:
            raise AbsentError("only some particles are stored, or fewer than two are there")
        seen = float(np.median(cKDTree(x).query(x, k=2)[0][:, 1]))
        if not self.spacing / 6 < seen < self.spacing * 4:
            yield 0, seen, f"neighbours are {seen:.3g} apart; dx is {self.spacing:.3g}: units differ."

    def precision(self) -> Findings:
        """Positions have more digits than float16 or four decimals."""
        x = self.arrays["position"][len(self.x) // 2 :, ~self.on_wall]
        for name, rounded in (("float16", x.astype(np.float16).astype(x.dtype)), ("four decimals", np.round(x, 4))):
            if x.size > 20 and np.allclose(rounded, x, rtol=np.finfo(x.dtype).eps, atol=0, equal_nan=True):
                yield None, None, f"positions are rounded to {name}; displacements need float32."

    def frames(self) -> Findings:
        """No frame is there twice while particles move."""
        seen: dict[bytes, int] = {}
        moved = np.nan_to_num(_size(self.v)).max(axis=1, initial=0.0)
        for t, frame in enumerate(self.x):
            s = seen.setdefault(np.nan_to_num(frame).tobytes(), t)
            # What comes to rest slows down before.
            if 0 < s < t and moved[s - 1] > 0.01 * moved.max():
                yield t, float(moved[s - 1]), f"the frame is frame {s} again, up to which particles moved."

    def jumps(self) -> Findings:
        """No particle moves by 3 spacings and 4 times as far in one frame as in those around it."""
        way = np.pad(_size(self.v), ((1, 1), (0, 0)), constant_values=np.nan)
        if len(way) < 6:
            raise AbsentError("there are fewer than five frames")
        usual = np.nanmedian([way[k : len(way) - 4 + k] for k in (0, 1, 3, 4)], axis=0)
        return _worst(way[2:-2] - 3 * self.spacing - 4 * usual, "jump", first=2)

    def dt(self) -> Findings:
        """`dt` is the ratio of displacements and velocities, and fits t_end."""
        meta, right = self.meta, {}
        if EXPORTED_BY in meta and (meta.get("num_frames") or 0) > 1 and meta.get("dt"):
            right["t_end and the number of frames"] = meta["t_end"] / (meta["num_frames"] - 1)
        if "velocity" in self.arrays:
            u = self.arrays["velocity"].astype(float)
            change, u = _size(np.diff(u, axis=0)), (u[1:] + u[:-1]) / 2
            # Over three intervals: between two frames of a vibration velocities are others.
            steady = np.pad((change < 0.02 * _size(u)) & (_size(self.v) > 50 * self.eps), ((1, 1), (0, 0)))
            steady = steady[:-2] & steady[1:-1] & steady[2:]
            if steady.sum() >= 10:
                ratios = (self.v * u).sum(axis=-1)[steady] / (u * u).sum(axis=-1)[steady]
                right["displacements and velocities"] = float(np.median(ratios))
        if not right:
            raise AbsentError("no velocities of steady motion are stored")
        for what, value in right.items():
            if abs(value - self.pause) > 0.01 * value:
                yield None, self.pause, f"dt is {self.pause:.6g}; {what} give {value:.6g}."

    def gravity(self) -> Findings:
        """Bodies in free flight have the stated gravity, to 1e-3."""
        stated = self.own.get("scene", {}).get("domain", {}).get("gravity")
        stated = self.arrays.get("grav", self.meta.get("gravity", stated))
        if stated is None or any(isinstance(g, str) for g in stated):
            raise AbsentError("metadata.json states no constant gravity")
        right = np.asarray(stated, float) * self.pause**2
        # Of a body that turns only some particles may be stored: theirs is no steady acceleration.
        means = [(a.mean(axis=0), _size(a - a.mean(axis=0)).max(), n) for _, a, n in self.flights]
        means = [(m, n) for m, off, n in means if off < 4 * self.eps + 2e-3 * _size(m) < 0.2 * _size(m)]
        if not means:
            raise AbsentError("no body is in free flight with a steady acceleration")
        a, n = np.array([m for m, _ in means]), np.array([n for _, n in means])
        # What slides has a steady acceleration too: one body in ten must fall as stated.
        if (_size(a - right) <= 1e-3 * _size(right) + 2 * self.eps / np.sqrt(n)).mean() < 0.1:
            fall = np.median(a, axis=0) / self.pause**2
            told = f"metadata.json states {np.round(stated, 3).tolist()}, and dt {self.pause:.6g}"
            yield self.flights[0][0], float(_size(fall)), f"bodies fall with {np.round(fall, 3).tolist()}; {told}."

    def momentum(self) -> Findings:
        """The momentum of a body in free flight changes steadily."""
        if "particle_seed" in self.meta or (len(self.own.get("bodies", ())) > 1 and "body" not in self.arrays):
            raise AbsentError("only some particles are stored, or not of which bodies they are")
        usual = np.median(np.concatenate([a for _, a, _ in self.flights]), axis=0)
        for first, a, n in self.flights:
            off = _size(a - usual)
            if off.max() > 0.02 * _size(usual) + 8 * self.eps / np.sqrt(n):
                told = (
                    f"the mean motion of {counted(n, 'particle')} in free flight changes by {off.max():.3g} too much."
                )
                yield first + int(off.argmax()) + 1, float(off.max()), told

    def walls(self) -> Findings:
        """Particles on walls of the domain are on its faces."""
        of_domain = self.arrays.get("wall_collider", np.full(self.on_walls.shape[1], -1)) < 0
        if not of_domain.any() or ("wall_collider" not in self.arrays and self.own.get("colliders") != []):
            raise AbsentError("no particles are known to be on walls of the domain")
        domain, box = self.own.get("scene", {}).get("domain", {}), self.box
        if domain.get("origin") and domain.get("size") and self.form != "lagrangebench":
            box = np.array([domain["origin"], np.add(domain["origin"], domain["size"])])
        inside = np.minimum(self.on_walls[:, of_domain] - box[0], box[1] - self.on_walls[:, of_domain])
        apart = np.maximum(np.abs(inside).min(axis=-1), -inside.min(axis=-1))
        return _worst(apart - 4 * self.eps - 1e-5 * np.ptp(box), "on walls lie beside them")


class Seen:
    """What is kept of a trajectory: moments, (4, d), hashes of frames but the first, and a fingerprint of lengths."""

    def __init__(self, one: Exported) -> None:
        """Compute moments, hashes and fingerprint of an exported trajectory."""
        self.name, self.split, self.size = one.name, one.split, one.v.size
        self.draws, self.particles = one.own.get("draws", {}), one.own.get("particles")
        self.moments = [f(a, axis=(0, 1)) for a in (one.v, np.diff(one.v, axis=0)) for f in (np.nanmean, np.nanvar)]
        self.hashes = {hash(frame.tobytes()) for frame in one.arrays["position"][1:]}
        # Neither signs nor the order of particles matter: a mirror image has the same.
        some = one.x[np.linspace(0, len(one.x) - 1, 5).astype(int)]
        center = np.nanmean(some, axis=1)
        box = (
            one.box
            if one.meta.get("bounds")
            else np.array([np.nanmin(some, axis=(0, 1)), np.nanmax(some, axis=(0, 1))])
        )
        apart = np.abs(some - center[:, None])
        lengths = [np.abs(center - box.mean(axis=0)), *(np.nanmean(apart**k, axis=1) ** (1 / k) for k in (1, 2, 3))]
        self.lengths, self.extent = np.nan_to_num(np.ravel(lengths)), float(np.ptp(box))


@dataclass
class Audit:
    """For each rule: its verdict, how often it was applied, why not, and its findings."""

    path: Path
    seen: list[Seen] = field(default_factory=list)
    meta: dict[str, Any] = field(default_factory=dict)
    rules: dict[str, dict[str, Any]] = field(default_factory=dict)

    def judge(self, rule: Callable[[], Findings], name: str | None = None) -> None:
        """Apply a rule to a trajectory, or, without a name, to all."""
        entry = self.rules.setdefault(rule.__name__, dict(verdict="skipped", applied=0, skipped=None, findings=[]))
        try:
            entry["findings"] += [dict(trajectory=name, frame=f, value=v, sentence=s) for f, v, s in rule()]
            entry["applied"] += 1
            entry["verdict"] = "finding" if entry["findings"] else "ok"
        except AbsentError as absent:
            entry["skipped"] = str(absent)
        except (IndexError, KeyError, TypeError, ValueError) as error:
            told = f"{name or 'metadata.json'} holds arrays or facts of another kind than the rule needs ({error})."
            entry["findings"] += [dict(trajectory=name, frame=None, value=None, sentence=told)]
            entry["verdict"] = "finding"

    def statistics(self) -> Findings:
        """vel_mean, vel_std, acc_mean and acc_std are those of the training split."""
        chosen = [one for one in self.seen if one.split == "train"] or self.seen
        if not self.meta.get("vel_std") or not chosen:
            raise AbsentError("metadata.json does not state statistics of motion")
        moments, right = np.array([one.moments for one in chosen]), []
        # Trajectories have equal weights, or particles.
        for weights in (None, [one.size for one in chosen]):
            mean = np.average(moments[:, ::2], axis=0, weights=weights)
            square = np.average(moments[:, 1::2] + (moments[:, ::2] - mean) ** 2, axis=0, weights=weights)
            right.append((mean, np.sqrt(square)))
        for k, key in enumerate(("vel_mean", "vel_std", "acc_mean", "acc_std")):
            values = [(one[k % 2][k // 2], one[1][k // 2]) for one in right]
            off = [np.abs(self.meta[key] - value) > 0.01 * std + STD_LEAST for value, std in values]
            # A standard deviation of 0 may be written as 1.
            if all((each & (std > STD_LEAST)).any() for each, (_, std) in zip(off, values, strict=True)):
                yield None, None, f"{key} is {self.meta[key]}; the training split has {values[0][0].tolist()}."

    def splits(self) -> Findings:
        """Splits have the stated numbers of trajectories, and those with rules what meets them, and nothing else."""
        stated = {split: self.meta[f"num_trajs_{split}"] for split in SPLITS if f"num_trajs_{split}" in self.meta}
        if not stated:
            raise AbsentError("metadata.json does not state num_trajs_train")
        for split, right in stated.items():
            if (count := sum(one.split == split for one in self.seen)) != right:
                yield None, count, f"{split} has {counted(count, 'trajectory')}; metadata.json states {right}."
        rules = self.meta.get("hold_out", {})
        for one in self.seen:
            held = held_in(rules, one.draws, one.particles)
            if held != one.split and (held or one.split in rules):
                told = f"by the rules of hold_out it is {f'of {held}' if held else 'not'}."
                yield None, None, f"{one.name} is of {one.split}; {told}"

    def duplicates(self, across: bool = False) -> Findings:
        """No trajectory is in its split twice, nearly, mirrored, or with half of its frames."""
        from scipy.spatial import cKDTree

        if len(self.seen) < 2:
            raise AbsentError("there is one trajectory")
        seen, owners = self.seen, dict[int, list[int]]()
        pairs = cKDTree([one.lengths for one in seen]).query_pairs(1e-4 * max(one.extent for one in seen), p=np.inf)
        for k, one in enumerate(seen):
            for value in one.hashes:
                owners.setdefault(value, []).append(k)
        shared = Counter(pair for ks in owners.values() for pair in combinations(ks, 2))
        pairs |= {(i, j) for (i, j), n in shared.items() if 2 * n >= min(len(seen[i].hashes), len(seen[j].hashes))}
        for i, j in sorted(pair for pair in pairs if (seen[pair[0]].split != seen[pair[1]].split) == across):
            same = f"{shared[i, j]} frames are the same" if shared[i, j] else "distances agree to 1e-4 of bounds"
            yield None, shared[i, j], f"{seen[j].name} of {seen[j].split} is {seen[i].name} of {seen[i].split}: {same}."

    def leakage(self) -> Findings:
        """No trajectory is in two splits, nearly, mirrored, or with half of its frames; nor draws held out."""
        yield from self.duplicates(across=True)
        rules, trained = self.meta.get("hold_out", {}), {}
        for one in sorted(self.seen, key=lambda one: one.split != "train") if rules else ():
            draws = json.loads(json.dumps(one.draws, sort_keys=True), parse_float=lambda text: f"{float(text):.4g}")
            if one.split == "train":
                trained[json.dumps(draws)] = one.name
            elif one.split in rules and (other := trained.get(json.dumps(draws))):
                yield None, None, f"{one.name} of {one.split} has the draws of {other} of train to four digits."

    @property
    def findings(self) -> int:
        """Number of findings."""
        return sum(len(entry["findings"]) for entry in self.rules.values())

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return dict(path=str(self.path), ok=not self.findings, trajectories=len(self.seen), rules=self.rules)

    def text(self) -> str:
        """Return a line for each rule, and its first findings."""
        outcome = counted(self.findings, "finding") if self.findings else "ok"
        lines = [f"{self.path}: {counted(len(self.seen), 'trajectory')}: {outcome}"]
        for name, entry in self.rules.items():
            why = entry["skipped"] if entry["verdict"] == "skipped" else counted(len(entry["findings"]), "finding")
            lines.append(f"{name}: ok" if entry["verdict"] == "ok" else f"{name}: {entry['verdict']}: {why}")
            for one in entry["findings"][:MOST]:
                place = [one["trajectory"]] * bool(one["trajectory"])
                place += [f"frame {one['frame']}"] * (one["frame"] is not None)
                lines.append("  " + f"{', '.join(place)}: " * bool(place) + one["sentence"])
        return "\n".join(lines)


def audit(directory: Path) -> Audit:
    """Judge an export by all rules; InputError: it is none, or a file cannot be read."""
    found = Audit(directory)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for one in starmap(Exported, trajectories(directory)):
            own = (one.finite, one.counts, one.types, one.bounds, one.units, one.precision, one.frames, one.jumps)
            for rule in (*own, one.dt, one.gravity, one.momentum, one.walls):
                found.judge(rule, one.name)
            found.seen.append(Seen(one))
            found.meta = one.meta
        for each in (found.statistics, found.splits, found.duplicates, found.leakage):
            found.judge(each)
    return found
