"""How wrong the simulator of a dataset is: some trajectories are computed again with one numerical choice changed.

Their siblings are two coarser grids and gravity times 1 + 1e-6. The last two have the particles of the trajectory, so
that each has an error: its distance from its twin, over r - 1 for a grid r times coarser.
"""

import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from hashlib import sha256
from heapq import nsmallest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mpmcli.dataset.shard import CERTIFICATES, LABELS, MOVING, StoredGroup, group_name, open_shard
from mpmcli.dataset.sweep import Sweep
from mpmcli.error_bars.bars import bars_of
from mpmcli.error_bars.observables import DENSITY, Map, Observer
from mpmcli.error_bars.siblings import RATIOS, LeftOut, Reach, Sibling, coarser, nudged, tables_of
from mpmcli.errors import RunError
from mpmcli.frames.frame import STATUS, Frame
from mpmcli.output.durable import sealed, write_text, writing
from mpmcli.output.header import RunHeader, nearest_image
from mpmcli.plain_text import counted, markdown_table, plain_number
from mpmcli.plot.style import LIGHT_SERIES, THEMES, drawing, svg
from mpmcli.scene import Scene, parse_scene, sample_bodies
from mpmcli.scene.material import Laws
from mpmcli.scene.quantity import dimension_of

if TYPE_CHECKING:
    from mpmcli.simulation.runner import Runner

# The names of certificates; the figure, its title, by which it is known, its size.
NAMES = re.compile(r"\d{6,}\.json")
FIGURE, TITLE, SIZE = "certify.svg", "Errors of the simulator", (1000, 420)
# Fewest trajectories, unless their siblings take more than this share of the runs of the sweep.
FEWEST, MOST_COST = 8, 0.25
# Particles are twins if they start within a share of a cell; nearly all must have one. States are the same while twins
# are within another share.
SAME_PLACE, NEARLY_ALL, SAME_STATE = 1e-3, 0.95, 0.1
# Strides of exports that have a one-step error.
STRIDES = range(1, 11)
# Standard deviations below it, m, become 1, as in LagrangeBench (data_gen/lagrangebench_data/gen_dataset.py): it avoids
# a division by zero along a direction without motion.
STD_LEAST = 1e-7
# Frames of the table, besides the last one.
HORIZONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def cost_of_one(sweep: Sweep) -> float:
    """Return the time of the siblings of a trajectory in runs."""
    return RATIOS[0] ** -(dimension_of(sweep.base_data) + 1) + 1 / RATIOS[1] + 1.0


def certify_plan(sweep: Sweep) -> dict[str, Any]:
    """Return how many trajectories [certify] asks for, and which are computed again: fewer if they cost too much.

    They are the first ones in the order of a hash of seed and number.
    """
    share = sweep.certify.fraction if sweep.certify else 0.0
    asked = min(sweep.count, max(FEWEST, math.ceil(share * sweep.count))) if share else 0
    most = min(asked, math.floor(MOST_COST * sweep.count / cost_of_one(sweep)))
    hashed = ((sha256(f"{sweep.seed} {number}".encode()).digest(), number) for number in range(sweep.count))
    return {"asked": asked, "numbers": sorted(number for _, number in nsmallest(most, hashed)) if most else []}


def plan_text(count: int, asked: int, numbers: Sequence[int]) -> str:
    """Return how many of the trajectories of a sweep are computed again, on what, and why not as many as asked."""
    limit = f"; {asked} would take more than {MOST_COST:.0%} of the runs of the sweep" if len(numbers) < asked else ""
    chosen = f"{len(numbers)} of {counted(count, 'trajectory')}, chosen by the seed"
    return f"{chosen}, computed again on two coarser grids and with gravity x (1 + 1e-6){limit}"


def certificates(directory: Path) -> tuple[dict[int, dict[str, Any]], list[str]]:
    """Return the certificates of a dataset by number, and a sentence for each that is damaged."""
    found, faults = {}, []
    for path in sorted((directory / CERTIFICATES).glob("*.json")):
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
            if stored.pop("checksum") != _checksum(stored) or path.stem != group_name(stored["number"]):
                raise ValueError("its checksum differs")
            found[stored["number"]] = stored
        except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
            faults.append(f"{path} is damaged ({error}); mpmcli sweep --resume computes it again.")
    return found, faults


def write_certificate(directory: Path, errors: dict[str, Any]) -> None:
    """Write what `certify` returns, in one durable step."""
    path = directory / CERTIFICATES / f"{group_name(errors['number'])}.json"
    with writing(path):
        path.parent.mkdir(exist_ok=True)
        write_text(path, json.dumps({**errors, "checksum": _checksum(errors)}) + "\n")


def _checksum(stored: dict[str, Any]) -> str:
    return sha256(json.dumps(stored).encode()).hexdigest()


def certify(scene: Scene, folder: Path, laws: Laws, shard: Path, number: int, runner: "Runner") -> dict[str, Any]:
    """Compute the siblings of a trajectory in a shard, and return its errors; files of its scene are in `folder`."""
    particles, tables, observed = sample_bodies(scene), tables_of(scene), Map.of(scene)
    header, frames, ledger = _stored(shard, number)
    x, h = _places(frames), scene.domain.spacing
    base = Observer(scene, particles, observed).taken(frames, ledger)
    runs, left_out, gaps = [], [], {}
    for one, same in _siblings(tables, base.reach):
        try:
            if isinstance(one, LeftOut):
                raise RunError(one.reason)
            other = parse_scene(one.tables, laws=laws, directory=folder).scene
            own = sample_bodies(other) if scene.emitters or not same else []
            own = [*particles[: len(scene.bodies)], *own[len(scene.bodies) :]] if same else own
            run = runner.run(other, particles=own)
            if len(run.frames) < len(frames):
                raise RunError(run.reason)
        except Exception as error:
            left_out.append(f"{one.name}: {str(error).strip().partition(chr(10))[0]}")
            continue
        runs.append((one, Observer(other, own, observed).taken(run.frames, run.ledger)))
        if same and (gap := gap_of(frames, run.frames, header.period, SAME_PLACE * h)) is not None:
            gaps[one.cause] = gap / (one.ratio - 1) if one.cause == "grid" else gap
    ways = {"moved": nearest_image(x - x[0], header.period), **gaps}
    of_law = {law.name: own for k, law in enumerate(header.laws) if (own := frames[0].material == k).any()}
    if len(of_law) > 1 and "grid" in gaps:
        ways |= {f"grid, {law}": gaps["grid"][:, own] for law, own in of_law.items()}
    bars, relative = bars_of(base, runs), {}
    for name, bar in bars.of.items() if runs else ():
        # Beyond all of the mass first order says nothing.
        share = np.minimum(bar.bar / bar.size, 1.0 if name == DENSITY else np.inf)
        relative.setdefault(_kind(name), []).append(share.tolist())
    measured = {
        "time_s": base.time.tolist(),
        "position_m": {"cell": [h] * len(x), **{name: rms(way).tolist() for name, way in ways.items()}},
        "observables": {kind: mean_of(rows) for kind, rows in relative.items()},
        "one_step": one_step(x, gaps["grid"], h, header.period) if "grid" in gaps else {},
    }
    return {"number": number, "left_out": left_out, "parted_s": bars.parted, "measured": measured}


def _siblings(tables: dict[str, Any], reach: Reach) -> Iterator[tuple[Sibling | LeftOut, bool]]:
    """Yield the siblings, and whether each has the particles of the scene."""
    yield coarser(tables, reach, RATIOS[0]), False
    coarse = coarser(tables, reach, RATIOS[1])
    yield with_same_particles(coarse) if isinstance(coarse, Sibling) else coarse, True
    yield nudged(tables), True


def with_same_particles(coarse: Sibling) -> Sibling:
    """Return a scene on a coarser grid, whose tables are changed, for the particles of the scene."""
    d = len(coarse.tables["domain"]["size"])
    for body in coarse.tables.get("bodies", []):
        if "points" not in body["shape"]:
            body["particles_per_cell"] = round(body["particles_per_cell"] ** (1 / d) * coarse.ratio) ** d
    return replace(coarse, name=f"{coarse.name}, same particles")


def _stored(shard: Path, number: int) -> tuple[RunHeader, list[Frame], Any]:
    with open_shard(shard) as file:
        stored = StoredGroup(file, number)
        header, ledger = RunHeader.read(stored.attribute("header")), stored.ledger()
        moving = {name: stored.frames(name, slice(None)) for name in (*MOVING, STATUS) if name in stored.group}
        labels = [stored.table(name) for name in LABELS]
    rows = (([one[k] for one in moving.values()], row.time) for k, row in enumerate(ledger))
    frames = [Frame(k, t, 0, x, v, *labels, {STATUS: s[0]} if s else {}) for k, ((x, v, *s), t) in enumerate(rows)]
    return header, frames, ledger


def _places(frames: Sequence[Frame]) -> np.ndarray:
    """Return the positions, (K, N, d), m; NaN where a particle is not present."""
    x = np.stack([frame.position for frame in frames]).astype(float)
    for place, frame in zip(x, frames, strict=True):
        place[slice(0) if frame.present is None else ~frame.present] = np.nan
    return x


def matched(start: np.ndarray, other: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of indices of particles, (n, d) and (m, d), m, that start within `near` of each other."""
    if start.shape == other.shape and (np.abs(start - other) < near).all():
        return (np.arange(len(start)),) * 2
    from scipy.spatial import cKDTree

    distance, place = cKDTree(other).query(start)
    found = np.flatnonzero(distance < near)
    # Each has one twin.
    found = found[np.unique(place[found], return_index=True)[1]]
    return found, place[found]


def gap_of(frames: Sequence[Frame], others: Sequence[Frame], period: np.ndarray, near: float) -> np.ndarray | None:
    """Return the way from each particle to its twin, (K, N, d), m, NaN without one; None: too few have one."""
    x, (mine, its) = _places(frames), matched(frames[0].position, others[0].position, near)
    if len(mine) < NEARLY_ALL * x.shape[1]:
        return None
    gap = np.full(x.shape, np.nan)
    gap[:, mine] = nearest_image(_places(others)[:, its] - x[:, mine], period)
    return gap


def rms(way: np.ndarray) -> np.ndarray:
    """Return the root of the mean square length of (K, n, d) vectors that are not NaN, (K,); 0 if all are."""
    square = np.square(way).sum(axis=2)
    return np.sqrt(np.nansum(square, axis=1) / np.maximum(np.isfinite(square).sum(axis=1), 1))


def one_step(x: np.ndarray, gap: np.ndarray, h: float, period: np.ndarray) -> dict[str, dict[str, list[float]]]:
    """Return by stride how far second differences of x, (K, N, d), m, are off while states are the same, and `std`.

    Both are along each axis, (d,), m.
    """
    found = {}
    for stride in STRIDES:
        size = np.diff(nearest_image(np.diff(x[::stride], axis=0), period), axis=0)
        error, near = np.diff(gap[::stride], n=2, axis=0), np.linalg.norm(gap[::stride], axis=2) < SAME_STATE * h
        size, error = (
            size[np.isfinite(size).all(axis=2)],
            error[near[:-2] & near[1:-1] & np.isfinite(error).all(axis=2)],
        )
        if len(size) and len(error):
            found[f"{stride}"] = {"error": np.sqrt((error**2).mean(axis=0)).tolist(), "std": size.std(axis=0).tolist()}
    return found


def mean_of(values: Sequence[Any], most: int | None = None) -> Any:
    """Return the root of the mean square of lists of `most` numbers, or of each entry of dictionaries."""
    if isinstance(values[0], dict):
        keys = dict.fromkeys(key for value in values for key in value)
        return {key: mean_of([value[key] for value in values if key in value], most) for key in keys}
    return np.sqrt(np.mean(np.square([value[:most] for value in values]), axis=0)).tolist()


def divisor(std: Any) -> np.ndarray:
    """Return the standard deviations by which numbers are divided, those without motion replaced by 1."""
    return np.where(np.less(std, STD_LEAST), 1.0, std)


def _kind(name: str) -> str:
    """Return the kind of an observable: its name without axis, and without body if there is something left."""
    return name if name.startswith("energy.") else name.split(".")[-2:][0]


def error_of(directory: Path) -> dict[str, Any] | None:
    """Return the errors over the certified trajectories of a dataset, for JSON; None if there are none.

    Lists over frames are roots of mean squares over trajectories. position_m: "grid", also by law, and "rounding"; the
    way "moved" from the start, and the "cell". observables: bars over the size of what they are of, by kind; "density":
    share of the mass that is elsewhere. one_step: by stride, error of accelerations along each axis over `acc_std`.
    parted_s: of each trajectory, from when rounding alone parts two runs, None if never.
    """
    found = certificates(directory)[0].values()
    if not found:
        return None
    all_measured = [one["measured"] for one in found]
    measured = mean_of(all_measured, min(len(one["time_s"]) for one in all_measured))
    steps = {k: np.divide(one["error"], divisor(one["std"])) for k, one in measured["one_step"].items()}
    return {
        "trajectories": [one["number"] for one in found],
        "left_out": [f"trajectory {one['number']}, {why}" for one in found for why in one["left_out"]],
        "parted_s": [one["parted_s"] for one in found],
        **measured,
        "one_step": {stride: one.tolist() for stride, one in steps.items()},
    }


def error_section(directory: Path, count: int, plan: dict[str, Any], error: dict[str, Any] | None) -> str:
    """Return the section of a card on the errors, and draw its figure."""
    told = f"## How wrong it is\n\n{plan_text(count, **plan)}."
    if error is None:
        return told
    with sealed(directory / FIGURE) as temporary:
        temporary.write_bytes(_draw(error))
    last, places = len(error["time_s"]) - 1, {f"{name}, m": rows for name, rows in error["position_m"].items()}
    elsewhere = {"mass elsewhere": error["observables"][DENSITY]} if error["observables"] else {}
    columns = {"frame": range(last + 1), "s": error["time_s"], **places, **elsewhere}
    table = [[plain_number(rows[k]) for rows in columns.values()] for k in (*(n for n in HORIZONS if n < last), last)]
    n, parted = len(error["trajectories"]), [t for t in error["parted_s"] if t is not None]
    told += f" Errors are roots of mean squares over {counted(n, 'included trajectory')}."
    if step := error["one_step"].get("1"):
        off = plain_number(math.hypot(*step) / len(step) ** 0.5)
        told += f" In the step of a frame, accelerations are off by {off} standard deviations (`acc_std`)."
    if "rounding" in error["position_m"]:
        told += f" Rounding alone parts {len(parted)} of {n} pairs of runs"
        told += f", from {min(parted):.3g} s on." if parted else "."
    told += "".join(f" Left out: {one}." for one in error["left_out"])
    return "\n\n".join([told, markdown_table(list(columns), table, range(len(columns))), f"![Errors]({FIGURE})"])


def _draw(error: dict[str, Any]) -> bytes:
    """Return a figure of the errors of positions and of observables over time, as SVG."""
    with drawing(SIZE, THEMES["light"]) as figure:
        left, right = figure.subplots(1, 2)
        for axes, curves in ((left, error["position_m"]), (right, error["observables"])):
            for k, (name, rows) in enumerate(curves.items()):
                again, color = divmod(k, len(LIGHT_SERIES))
                style = {"color": LIGHT_SERIES[color], "linestyle": "--" if again else "-", "label": name}
                axes.plot(error["time_s"], [one or math.nan for one in rows], **style)
            axes.set(xlabel="t, s", yscale="log")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.legend()
        left.set(title="Errors of positions, and the way from the start, m")
        right.set(title="Bars of observables over their size")
        return svg(figure, TITLE)
