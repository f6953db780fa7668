"""What features cost: all scenes are the pool here, deep water at rest, and the same with one feature more."""

import statistics
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import product
from math import pi
from pathlib import Path
from tempfile import TemporaryDirectory

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.materials import GRAVITY, material_of
from mpmcli.bench.ours import Ours
from mpmcli.bench.report import REASON, head, heading, number, page, picked, ratios_of, rows_text
from mpmcli.bench.side import BenchOptions, Setting, Side, Turns
from mpmcli.materials.registry import laws
from mpmcli.plain_text import counted

# Depth of the pool in a unit box: 72 cells of 128, and 18 of 32.
DEPTH = 0.5625
# Centre of colliders, the radius of the ball, and that of the octahedron, m.
CENTER = (0.5, 0.35, 0.5)
BALL, OCTAHEDRON = 0.2, 0.25
# Bars of the cross that stands for the mesh in 2D, (half width, half height), m.
BARS = ((0.2, 0.05), (0.05, 0.2))
FRICTION = 0.5
# About a quarter of the step that the stiffness at rest allows, with 4 (2D) and 8 (3D) particles per cell.
FEATURE_CASES = (
    BenchCase(dimension=2, cells=128, particles=36_864, step=1e-4),
    BenchCase(dimension=3, cells=32, particles=147_456, step=4e-4),
)
# Start of the measured interval, s: what moves has set the water in motion, and the emitter has emitted all.
SETTLING = 0.1
# Rounds, and the length of a block, s: many short blocks, so that those of a round run beside the same other processes.
ROUNDS, BLOCK = 15, 0.5


@dataclass(frozen=True)
class Feature:
    """A scene, that without its feature, None for those that others are compared with, and a bound of the ratio."""

    name: str
    base: str | None
    limit: float | None = None


FEATURES = (
    Feature("plain", None),
    Feature("plain again", "plain", 1.02),
    Feature("moving ball", "plain", 1.10),
    Feature("friction of the ball", "moving ball", 1.03),
    Feature("moving mesh", "plain", 1.15),
    Feature("friction of walls", "plain", 1.03),
    Feature("moving wall", "friction of walls"),
    Feature("periodic faces", "plain"),
    Feature("force", "plain"),
    Feature("force with exp", "plain"),
    Feature("sparse grid", "plain", 1.30),
    # As where steps are shorter than a body's own.
    Feature("aflip", "plain", 1.30),
    Feature("jet", None),
    Feature("emitter", "jet", 1.03),
    Feature("jelly", None),
    Feature("f_bar", "jelly"),
)
_OF_NAME = {feature.name: feature for feature in FEATURES}


def scene_of(name: str, case: BenchCase, precision: str) -> dict:
    """Return the scene of a feature; a mesh is "mesh.obj" beside it, and colliders raise the water they displace."""
    d, center = case.dimension, [*CENTER[: case.dimension]]
    law = "neo_hookean" if name in ("jelly", "f_bar") else "fluid"
    body = {"name": "pool", "material": material_of(laws()[law].parameters), "particles_per_cell": 2**d}
    shape, displaced = {"box": {"min": [0.0] * d, "max": [1.0, DEPTH, 1.0][:d]}}, 0.0
    data = case.scene(f"Pool, {name}", [body | {"shape": shape}], GRAVITY, end=100.0, precision=precision)
    if name in ("moving ball", "friction of the ball"):
        displaced, form = (pi * BALL**2, 4 / 3 * pi * BALL**3)[d - 2], {"ball": {"center": center, "radius": BALL}}
        data["colliders"] = [{"name": "ball", "shape": form, "velocity": ["0.5 * cos(10 * t)", *[0.0] * (d - 1)]}]
        if name != "moving ball":
            data["colliders"][0]["friction"] = FRICTION
    elif name == "moving mesh":
        displaced, form = 4 / 3 * OCTAHEDRON**3, {"mesh": {"file": "mesh.obj", "translate": center}}
        if d == 2:
            corners = [[[c + sign * e for c, e in zip(center, half, strict=True)] for sign in (-1, 1)] for half in BARS]
            first, second = ({"box": {"min": low, "max": high}} for low, high in corners)
            displaced, form = 0.07, first | {"add": [second]}
        data["colliders"] = [{"name": "mesh", "shape": form, "angular_velocity": 2.0}]
    elif name in ("friction of walls", "moving wall"):
        data["domain"]["friction"] = FRICTION
        if name == "moving wall":
            data["domain"]["wall_velocity"] = {"y_min": [0.5, 0.0, 0.0][:d]}
    elif name == "periodic faces":
        data["domain"]["walls"] = {"default": "separate", "x_min": "periodic", "x_max": "periodic"}
    elif name.startswith("force"):
        near = " * exp(-((x - 0.5)**2 + (y - 0.3)**2) / 0.1**2)" if "exp" in name else ""
        swirl = [f"-3 * sin(9 * t) * (y - 0.3){near}", f"3 * sin(9 * t) * (x - 0.5){near}"]
        data["forces"] = [{"body": "pool", "acceleration": [*swirl, 0][:d]}]
    elif name in ("jet", "emitter"):
        down, radius = [0.0, -2.0, 0.0][:d], (0.1, 0.14)[d - 2]
        # Sheets of about 51 (2D) and 250 particles (3D), which all enter within SETTLING.
        count = case.particles // (16, 50)[d - 2]
        mouth = (2 * radius, pi * radius**2)[d - 2]
        if name == "emitter":
            form = {"ball": {"center": [0.5, 0.85, 0.5][:d], "radius": radius}}
            common = {key: body[key] for key in ("material", "particles_per_cell")}
            data["emitters"] = [common | {"name": "jet", "shape": form, "velocity": down, "particles": count}]
        else:
            # As much, which falls from where it is after SETTLING as well.
            height, half = count / (2 * case.cells) ** d / mouth, mouth ** (1 / (d - 1)) / 2
            form = {
                "box": {"min": [0.5 - half, 0.8, 0.5 - half][:d], "max": [0.5 + half, 0.8 + height, 0.5 + half][:d]}
            }
            data["bodies"].append(body | {"name": "jet", "shape": form, "velocity": down})
    elif name == "sparse grid":
        data["solver"]["grid"] = "sparse"
    elif name == "aflip":
        data["solver"]["transfer"] = "aflip"
    elif law != "fluid":
        data["solver"]["f_bar"] = name == "f_bar"
    if displaced:
        shape["box"]["max"][1] += displaced
        shape["subtract"] = [form] if "add" not in form else [first, second]
    return data


def octahedron(radius: float) -> str:
    """Return a regular octahedron about the origin as the text of an OBJ file, faces outward."""
    corners = [[radius * sign * (a == axis) for a in range(3)] for axis in range(3) for sign in (1, -1)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    # Corners 1 to 6 are at +x, -x, +y, -y, +z, -z. An odd number of negative ones turns a face round.
    for signs in product((0, 1), repeat=3):
        face = [first + sign for first, sign in zip((1, 3, 5), signs, strict=True)]
        lines.append("f " + " ".join(map(str, face if sum(signs) % 2 == 0 else face[::-1])))
    return "\n".join(lines) + "\n"


class Pool(Ours):
    """What `mpmcli simulate` computes with, on the scene of a feature, which goes on from block to block."""

    def __init__(self, name: str, case: BenchCase, *, threads: int, precision: str, arch: str) -> None:
        data = scene_of(name, case, precision)
        with TemporaryDirectory() as directory:
            Path(directory, "mesh.obj").write_text(octahedron(OCTAHEDRON), encoding="utf-8")
            options = {"threads": threads, "precision": precision, "arch": arch}
            super().__init__(data, case.step, directory=directory, **options)

    def rewind(self) -> None:
        """Do nothing: all scenes go on from the same time, and differ by what their feature does."""


def feature_table(record: dict) -> str:
    """Return the record of the features as text: scenes, their ratios, and what the columns mean."""
    rows = record["features"]
    columns = [
        ("case", lambda row: row["case"]),
        ("threads", lambda row: str(row["threads"])),
        ("scene", lambda row: row["feature"]),
        ("over", lambda row: row["over"] or ""),
        ("ns", lambda row: f"{row['ns_per_particle_step']:.1f}"),
        ("ratio", lambda row: number(row["ratio"], ".3f")),
        ("quartiles", lambda row: "{:.3f}-{:.3f}".format(*row["ratio_quartiles"]) if row["ratio"] else ""),
        ("fastest", lambda row: number(row["ratio_fastest"], ".3f")),
        ("at most", lambda row: number(row["limit"], ".2f")),
        ("", lambda row: "MISSED" if row["met"] is False else ""),
    ]
    notes = (
        "ns: per particle and step, median of the blocks; processor time on one thread, wall time on several.",
        "ratio: of blocks measured in the same round, median; fastest: of the fastest block of each.",
        "The plain scene is there twice: its ratio shows the noise.",
    )
    top = heading(record, sorted({row["threads"] for row in rows}) or [1])
    table = rows_text(rows, columns, left={0, 2, 3})
    return page(top, [table], notes, [*_warnings(rows), *record["flaws"]])


def _warnings(rows: list[dict]) -> Iterator[str]:
    for row in rows:
        where, smallest, step = f'"{row["feature"]}" at {row["case"]}', row["smallest_step_s"], row["step_s"]
        # The first step that a run of a batch takes is the step that the time is divided by.
        if smallest < 0.99 * step:
            yield f"{where} took steps down to {smallest:.3g} s instead of {step:.3g} s."
        if not row["sound"]:
            yield f"{where} broke down {REASON}."


def feature_record(figures: Sequence[dict], flaws: list[str], options: BenchOptions) -> dict:
    """Return the costs of features for JSON, from the figures of each number of threads of each case."""
    rows = [_result_dict(one, figures) for one in figures]
    return head(options, arch="cpu") | {"features": rows, "flaws": flaws}


def _result_dict(one: dict, figures: Sequence[dict]) -> dict:
    """Return a scene, and its cost over that without its feature: median and quartiles of neighbouring blocks."""
    feature = _OF_NAME[one["who"]]
    key = {"case": one["case"], "threads": one["threads"], "who": feature.base}
    base = next((other for other in figures if picked(other, "case threads who") == key), None)
    rounds = ratios_of(one, base) if base else []
    ratio = statistics.median(rounds) if rounds else None
    low, _, high = statistics.quantiles(rounds, method="inclusive") if len(rounds) > 1 else 3 * [ratio]
    blocks = "ns_per_particle_step_blocks"
    return {
        **picked(one, "case threads"),
        "feature": feature.name,
        "over": feature.base,
        **picked(one, "particles step_s"),
        "clock": "processor time" if one["threads"] == 1 else "wall time",
        **picked(one, f"ns_per_particle_step {blocks}"),
        "ratio": ratio,
        "ratio_quartiles": [low, high] if base else None,
        "ratio_fastest": min(one[blocks]) / min(base[blocks]) if base else None,
        "limit": feature.limit,
        "met": ratio <= feature.limit if base and feature.limit else None,
        **picked(one, "smallest_step_s sound"),
    }


def run_features(cases: Iterable[BenchCase], options: BenchOptions, *, features: Sequence[Feature] = FEATURES) -> dict:
    """Measure every scene with each number of threads, in blocks of as many steps; the record tells of failures."""
    flaws: list[str] = []
    settings = [(case, threads) for case in cases for threads in options.threads]
    figures = [one for setting in settings for one in _measure(*setting, features, options, flaws)]
    return feature_record(figures, flaws, options)


def _measure(
    case: BenchCase, threads: int, features: Sequence[Feature], options: BenchOptions, flaws: list[str]
) -> list[dict]:
    where = f"{case.name}, {counted(threads, 'thread')}"
    sides = [Side(feature.name, case, Setting(threads), f'"{feature.name}"') for feature in features]
    turns = Turns(sides, flaws)
    with ExitStack() as stack:

        def begin(side: Side) -> float:
            side.begin(stack, options.start)
            # To the time from which costs are measured.
            answer = side.worker.ask(f"repeat {round(SETTLING / case.step)} 0")
            options.progress(f"{where}: {side.who} is ready")
            return answer["seconds"] / answer["steps"]

        step_seconds = turns.take(begin)
        # Each block takes as many steps, so that all scenes are at the same time.
        steps = max(1, round(options.seconds / step_seconds[0])) if step_seconds else 0
        for block in range(options.blocks):
            turns.take(lambda side: side.measure(f"repeat {steps} 0"))
            last = ", ".join(f"{side.who} {1e9 * side.costs[-1]:.1f}" for side in turns.sides)
            options.progress(f"{where}: round {block + 1} of {options.blocks}, ns: {last}")
        return turns.take(Side.finish)
