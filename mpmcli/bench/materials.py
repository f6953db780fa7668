"""What laws cost, alone and two in one scene: all take the column here, which lands, shears and collapses."""

import statistics
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from operator import itemgetter

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.ours import Ours
from mpmcli.bench.report import REASON, head, heading, number, page, picked, ratios_of, rows_text, span
from mpmcli.bench.side import BenchOptions, Setting, Side, Turns
from mpmcli.errors import RunError
from mpmcli.materials.registry import laws
from mpmcli.scene.material import Knob, MaterialParameters

# Parameters by the names that laws share, so that a new law needs no entry: one density, one stiffness, and strengths
# well below the stress of the weight (up to 7 kPa) and of the impact (about 20 kPa), so that plastic laws flow.
# Other parameters are those at the middle of their knobs.
VALUES = {
    "density": 1000.0,
    "youngs_modulus": 4e5,
    "poissons_ratio": 0.3,
    "bulk_modulus": 4e5,
    "yield_stress": 1e3,
    "consistency": 10.0,
    "friction_angle": 35.0,
}
GRAVITY = 9.81
# At the start: downward, m/s, so that the column lands within 30 ms, and dv_x/dy, 1/s.
SPEED = 1.0
SHEAR = 10.0
# Edges of the column and its height above the floor, in a unit box.
EDGES = {2: (0.75, 0.75), 3: (0.25, 0.5, 0.25)}
CLEARANCE = 1 / 32

# A fifth or less of the step that the stiffness at rest allows leaves room for hardening and impact. The particles are
# 4 (2D) and 8 (3D) per cell, as scenes have by default.
MATERIAL_CASES = (
    BenchCase(dimension=2, cells=128, particles=36_864, step=4e-5),
    BenchCase(dimension=3, cells=64, particles=65_536, step=1e-4),
)
# The cheapest pair, for which the overhead of a second law is largest, and two typical ones.
MIXES = (("fluid", "neo_hookean"), ("fluid", "sand"), ("neo_hookean", "snow"))
# Start and duration of the measured interval, s. The wave of the impact, at about 25 m/s, is then inside the column,
# which leans and spreads; nothing is at rest.
SETTLING = 0.05
STRETCH = 0.01
# (law, reference law, largest ratio of their costs).
TARGETS = (("fixed_corotated", "neo_hookean", 2.0), ("sand", "fluid", 5.0), ("snow", "fluid", 5.0))
# Largest ratio of the cost of a scene with two laws to the sum of its parts.
MIX_TARGET = 1.05
# Laws that every law is compared with.
MEASURES = ("fluid", "neo_hookean")
FIGURES = (
    "particles step_s ns_per_particle_step ns_per_particle_step_blocks compile_s device_bytes_per_particle "
    "flowing watch_share smallest_step_s sound"
)


def steps_of(case: BenchCase) -> tuple[int, int]:
    """Return the number of steps before the measured interval, and in it."""
    return round(SETTLING / case.step), round(STRETCH / case.step)


def material_of(model: type[MaterialParameters]) -> dict[str, object]:
    """Return the material of a law: VALUES, then knobs, then defaults; RunError: a parameter has none of them."""
    law = model.model_fields["law"].default
    material: dict[str, object] = {"law": law}
    for name, field in model.model_fields.items():
        if name in VALUES:
            material[name] = VALUES[name]
        elif field.is_required() and name != "law":
            knob = next((entry for entry in field.metadata if isinstance(entry, Knob)), None)
            if knob is None:
                raise RunError(f'The law "{law}" needs {name}, which has no knob and no value in the benchmark.')
            material[name] = knob.value(0.5)
    return material


def scene_of(names: Sequence[str], case: BenchCase, precision: str) -> dict:
    """Return the column as a scene, with a slice of equal size for each law; the place of an empty name stays empty."""
    d, edges = case.dimension, EDGES[case.dimension]
    lower = [CLEARANCE if axis == 1 else (1 - edge) / 2 for axis, edge in enumerate(edges)]
    shear = [[SHEAR if (row, column) == (0, 1) else 0.0 for column in range(d)] for row in range(d)]
    slices = []
    for index, name in enumerate(names):
        if not name:
            continue
        size = (edges[0] / len(names), *edges[1:])
        corner = [lower[0] + edges[0] * index / len(names), *lower[1:]]
        slices.append(
            {
                "name": name,
                "material": material_of(laws()[name].parameters),
                "shape": {"box": {"min": corner, "max": [c + s for c, s in zip(corner, size, strict=True)]}},
                "velocity": [0.0, -SPEED, 0.0][:d],
                "velocity_gradient": shear,
                "particles_per_cell": 2**d,
            }
        )
    return case.scene(f"Column of {' and '.join(filter(None, names))}", slices, GRAVITY, precision=precision)


class Column(Ours):
    """The solver on the column of one or more laws, which lands, leans and spreads with a shear.

    SETTLING later most of a plastic law flows. Blocks repeat the same steps: `keep` saves, `rewind` restores.
    """

    def __init__(self, names: Sequence[str], case: BenchCase, *, threads: int, precision: str, arch: str) -> None:
        if unknown := set(names) - {"", *laws()}:
            raise RunError(f"There is no law {min(unknown)}.")
        data = scene_of(names, case, precision)
        # For `flowing`.
        data["output"] = {"fields": ["velocity", "volume_ratio", "deformation_gradient"]}
        super().__init__(data, case.step, threads=threads, precision=precision, arch=arch)
        self._kept = self.run.save().copied()

    def keep(self) -> None:
        """Save the state of the run."""
        self._kept = self.run.save().copied()

    def rewind(self) -> None:
        """Restore the saved state, and take one step that is not measured."""
        self.run.load(self._kept)
        self.advance(1)
        self.sync()

    def flowing(self) -> float:
        """Return the share of particles that the next step projects: those in plastic flow, or torn."""
        # A frame shows the state after plastic flow.
        (frame, _), count = self.run.frame(), 0
        for group in self.run.groups:
            found, name = group.read(), "deformation_gradient" if group.law.deformation == "F" else "volume_ratio"
            seen = frame.fields[name][found["id"]].reshape(found["deformation"].shape)
            count += int((seen != found["deformation"]).reshape(group.count, -1).any(axis=1).sum())
        return count / self.particles


def name_of(who: str) -> str:
    """Return the name of the laws of a column, with commas between its places, such as "fluid + sand"."""
    names = who.split(",")
    return ("" if all(names) else "half of ") + " + ".join(filter(None, names))


def laws_of(who: str) -> list[str]:
    """Return the laws of a column, without its empty places."""
    return [*filter(None, who.split(","))]


def parts_of(who: str) -> list[str]:
    """Return the same column with one law left in it, for each of several laws."""
    names = who.split(",")
    if len(laws_of(who)) < 2:
        return []
    return [",".join(name if i == place else "" for i, name in enumerate(names)) for place in range(len(names))]


def cost_table(record: dict) -> str:
    """Return the record of the costs as text: laws, mixes, targets, and what the columns mean."""

    def column(head: str, key: str, form: str) -> tuple:
        return head, lambda row: number(row[key], form)

    case = column("case", "case", "")
    costs = [
        column("ns", "ns_per_particle_step", ".1f"),
        ("range", lambda row: "{:.1f}-{:.1f}".format(*span(row["ns_per_particle_step_blocks"]))),
    ]
    compiled = column("compile s", "compile_s", ".1f")
    alone = [
        case,
        ("law", _name),
        *costs,
        *(column(f"/ {law}", f"over_{law}", ".2f") for law in MEASURES),
        column("bytes", "device_bytes_per_particle", ""),
        compiled,
        ("flowing", lambda row: f"{100 * row['flowing']:.0f} %"),
        ("watch", lambda row: f"{100 * row['watch_share']:.1f} %"),
    ]
    mixed = [case, ("two laws, and each alone", _name), *costs, column("/ sum", "over_sum_of_parts", ".2f"), compiled]
    rows = record["results"]
    mixes = [row for row in rows if "over_sum_of_parts" in row]
    targets = [
        f"{one['case']}: {one['target']}: {one['ratio']:.3f}, should be at most {one['limit']:g}"
        f"{'' if one['met'] else ', MISSED'}."
        for one in record["targets"]
    ]
    notes = (
        f"ns: {record['clock']} per particle and step, median of the blocks; range: of the blocks.",
        "sum: what the same scene costs with only the one law's half of the column, plus with only the other's.",
        "bytes: on the device per particle, sort buffers included; compile: with no kernel cached on disk.",
        "flowing: particles in plastic flow, or torn, at the end of what was measured.",
        "watch: share of the time that went into measuring the state, which the next steps follow.",
    )
    tables = [
        rows_text([row for row in rows if row not in mixes], alone, left={0, 1}),
        rows_text(mixes, mixed, left={0, 1}) if mixes else "",
        "\n".join(targets),
    ]
    return page(heading(record, [record["threads"]]), tables, notes, [*_warnings(rows), *record["flaws"]])


def _name(row: dict) -> str:
    return ("" if row["share_of_column"] == 1 else "half of ") + " + ".join(row["laws"])


def _warnings(rows: list[dict]) -> Iterator[str]:
    for row in rows:
        where = f"{_name(row)} at {row['case']}"
        if row["smallest_step_s"] < row["step_s"]:
            yield (
                f"the limits of {where} asked for steps down to {row['smallest_step_s']:.3g} s, "
                f"below the {row['step_s']:.3g} s of the others."
            )
        if not row["sound"]:
            yield f"{where} broke down {REASON}."


def cost_record(figures: Sequence[dict], flaws: list[str], options: BenchOptions) -> dict:
    """Return the costs for JSON, from the figures of the laws and then the mixes of each case."""
    return {
        **head(options, threads=options.threads[0], arch="cpu"),
        "clock": "processor time" if options.threads[0] == 1 else "wall time",
        "results": [_result_dict(one, figures) for one in figures],
        "targets": list(_targets(figures)),
        "flaws": flaws,
    }


def _ratio(one: dict, others: Sequence[str], figures: Sequence[dict]) -> dict | None:
    """Return a cost over the mean of others, which have equal shares, at the same case; None if not measured."""
    found = {other["who"]: other for other in figures if other["case"] == one["case"]}
    if not others or not all(who in found for who in others):
        return None
    parts = [found[who] for who in others]
    low, high = span(ratios_of(one, *parts))
    ratio = one["ns_per_particle_step"] / statistics.fmean(part["ns_per_particle_step"] for part in parts)
    return {"ratio": ratio, "ratio_min": low, "ratio_max": high}


def _result_dict(one: dict, figures: Sequence[dict]) -> dict:
    names = laws_of(one["who"])
    over = {f"over_{name}": [name] for name in MEASURES}
    if "," in one["who"]:
        over = {"over_sum_of_parts": parts_of(one["who"])}
    ratios = {key: _ratio(one, others, figures) for key, others in over.items()}
    return {
        "case": one["case"],
        "laws": names,
        "share_of_column": len(names) / len(one["who"].split(",")),
        **picked(one, FIGURES),
        **{key: ratio["ratio"] if ratio else None for key, ratio in ratios.items()},
    }


def _targets(figures: Sequence[dict]) -> Iterator[dict]:
    for one in figures:
        case, who = one["case"], one["who"]
        wanted = [(f"{law} over {other}", [other], limit) for law, other, limit in TARGETS if law == who]
        singles = [f for f in figures if f["case"] == case and "," not in f["who"] and f is not one]
        if who == "fluid" and singles:
            cheapest = min(singles, key=itemgetter("ns_per_particle_step"))["who"]
            wanted.append((f"fluid over the next cheapest, {cheapest}", [cheapest], 1.0))
        wanted.append((f"{name_of(who)} over the sum of its parts", parts_of(who), MIX_TARGET))
        for text, others, limit in wanted:
            if ratio := _ratio(one, others, figures):
                yield {"case": case, "target": text, **ratio, "limit": limit, "met": ratio["ratio"] <= limit}


def run_costs(
    cases: Iterable[BenchCase],
    options: BenchOptions,
    *,
    names: Sequence[str] | None = None,
    mixes: Sequence[tuple[str, str]] = MIXES,
) -> dict:
    """Measure laws, by default all, mixes of two, and each half of a mix; the record tells of those that fail."""
    contenders = sorted(laws()) if names is None else [*names]
    for pair in map(",".join, mixes):
        contenders += [part for part in parts_of(pair) if part not in contenders]
        contenders.append(pair)
    flaws: list[str] = []
    figures = [one for case in cases for one in _measure(case, contenders, options, flaws)]
    return cost_record(figures, flaws, options)


def _measure(case: BenchCase, contenders: Sequence[str], options: BenchOptions, flaws: list[str]) -> list[dict]:
    before, stretch = steps_of(case)
    tell = options.progress
    tell(f"{case.name}: {case.particles:,} particles, {case.cells}^{case.dimension} cells")
    turns = Turns([Side(who, case, Setting(options.threads[0]), name_of(who)) for who in contenders], flaws)
    with ExitStack() as stack:

        def begin(side: Side) -> None:
            particles = case.particles * len(laws_of(side.who)) // len(side.who.split(","))
            side.begin(stack, options.start, particles)
            side.worker.ask(f"keep {before}")
            tell(f"{case.name}: {side.name} is ready")

        turns.take(begin)
        for block in range(options.blocks):
            turns.take(lambda side: side.measure(f"repeat {stretch} {options.seconds}"))
            last = ", ".join(f"{side.name} {1e9 * side.costs[-1]:.0f}" for side in turns.sides)
            tell(f"{case.name}: block {block + 1} of {options.blocks}, ns: {last}")
        return turns.take(_finish)


def _finish(side: Side) -> dict:
    flowing = side.worker.ask("flowing")["share"]
    shares = [answer["watch_seconds"] / answer["seconds"] for answer in side.answers]
    return side.finish(flowing=flowing, watch_share=statistics.median(shares))
