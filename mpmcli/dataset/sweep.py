"""The model of a sweep: its tables, its distributions, and the draws of a trajectory."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from hashlib import sha256
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, PlainValidator, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from mpmcli.dataset.hold_out import Rules, held_in
from mpmcli.render.settings import USUAL_WHAT, CameraMode, What
from mpmcli.scene.problem import hint_at, listed, quoted, written
from mpmcli.scene.quantity import AXES, LARGEST, Integer, NotNegative, Number, Table, flaw, list_of_axes

# Default bounds of a normal distribution, in standard deviations.
USUAL_DEVIATIONS = 3.0
Method = Literal["random", "sobol", "latin"]
Accepted = Literal["stable", "suspect"]
_KINDS = ["uniform", "loguniform", "normal", "integers", "choice", "grid"]
# 2^64 / golden ratio, made odd.
GOLDEN = 0x9E3779B97F4A7C15
# Number of consecutive trajectories that are divided among the splits.
TOGETHER = 10
ROUND_OFF = 1e-9


@dataclass(frozen=True)
class Distribution:
    """The distribution of one key of a sweep.

    Attributes:
        continuous: whether the value depends continuously on u; such values are drawn by the sweep's method.
        components: number of components of u that a value needs.
    """

    continuous: ClassVar[bool] = False
    components: ClassVar[int] = 0

    def value(self, u: Sequence[float]) -> Any:
        """Return the value at u, `components` numbers in [0, 1), as a plain Python value for TOML."""
        raise NotImplementedError

    def extremes(self) -> list[Any]:
        """Return the values at both ends; all values if they have no order."""
        raise NotImplementedError


@dataclass(frozen=True)
class Choice(Distribution):
    """One of several values with equal probability; a constant if there is only one."""

    components = 1
    values: tuple[Any, ...]

    def value(self, u: Sequence[float]) -> Any:
        return self.values[int(len(self.values) * u[0])]

    def extremes(self) -> list[Any]:
        return list(self.values)


@dataclass(frozen=True)
class Grid(Distribution):
    """Values in order: trajectories run through the combinations of all grids of a sweep."""

    values: tuple[Any, ...]

    def extremes(self) -> list[Any]:
        return list(self.values)


@dataclass(frozen=True)
class Numbers(Distribution):
    """A number, or a vector of independent ones; the last two `parameters` of each are its bounds."""

    continuous = True
    parameters: tuple[tuple[float, ...], ...]
    vector: bool

    @property
    def components(self) -> int:
        return len(self.parameters)

    def value(self, u: Sequence[float]) -> Any:
        drawn = [min(max(self.quantile(x, *one), one[-2]), one[-1]) for x, one in zip(u, self.parameters, strict=True)]
        return drawn if self.vector else drawn[0]

    def extremes(self) -> list[Any]:
        """Return the value with every component at its lower end, and that with every one at its upper end."""
        ends = [[one[end] for one in self.parameters] for end in (-2, -1)]
        return ends if self.vector else [end[0] for end in ends]

    @staticmethod
    def quantile(u: float, *parameters: float) -> float:
        """Return the quantile u of one component."""
        raise NotImplementedError


class Uniform(Numbers):
    """Uniform between two bounds."""

    @staticmethod
    def quantile(u: float, low: float, high: float) -> float:
        return low + u * (high - low)


class LogUniform(Numbers):
    """The logarithm is uniform between the logarithms of two bounds: lo (hi / lo)^u."""

    @staticmethod
    def quantile(u: float, low: float, high: float) -> float:
        return low * math.exp(u * (math.log(high) - math.log(low)))


class Integers(Numbers):
    """Uniform whole numbers, both bounds included; below 2^53, so that rounding skips none."""

    continuous = False

    @staticmethod
    def quantile(u: float, low: float, high: float) -> float:
        return low + math.floor(u * (high - low + 1))


class Normal(Numbers):
    """Normal, truncated at two bounds."""

    @staticmethod
    def quantile(u: float, mean: float, deviation: float, low: float, high: float) -> float:
        """mean + std Phi^-1(Phi(a) + u (Phi(b) - Phi(a))), with a and b the bounds in standard deviations."""
        a, b = (low - mean) / deviation, (high - mean) / deviation
        # Phi rounds to 1 in the upper tail, so both tails are computed in the lower one.
        sign = 1.0 if a + b <= 0 else -1.0
        from_a, from_b = cumulative_normal(sign * a), cumulative_normal(sign * b)
        p = min(max(from_a + u * (from_b - from_a), math.ulp(0.0)), 1.0 - math.ulp(0.5))
        return mean + sign * deviation * NormalDist().inv_cdf(p)


def cumulative_normal(z: float) -> float:
    """Return Phi(z) = erfc(-z / sqrt 2) / 2, exact in the lower tail."""
    return math.erfc(-z / math.sqrt(2)) / 2


def read_distribution(value: object) -> Distribution:
    """Return the distribution given by a value of a sweep file.

    `uniform = [lo, hi]`, `loguniform = [lo, hi]`, `integers = [lo, hi]` with both bounds, `normal = [mean, std]` with
    `within = [min, max]` (default: three standard deviations either side), `choice = [values]`, `grid = [values]`; a
    value that is not a table is a constant. Where both bounds are lists of equal length, the value is a list with
    independent components. Faults are raised for pydantic to report.
    """
    if not isinstance(value, dict):
        return Choice((value,))
    kind = _kind(value)
    given = value[kind]
    if kind in ("choice", "grid"):
        if not isinstance(given, list) or not given:
            raise flaw(f"must be a list with at least one value; found {written(given)}", kind)
        return (Choice if kind == "choice" else Grid)(tuple(given))
    first, second = _two(given, kind)
    vector = isinstance(given[0], list)
    if kind == "normal":
        return Normal(_bounded(first, second, value, vector), vector)
    for low, high in zip(first, second, strict=True):
        if not low <= high:
            raise flaw(f"must be [lower, upper]; found {written(low)} above {written(high)}", kind)
        if kind == "loguniform" and low <= 0:
            raise flaw(f"needs bounds greater than 0; found {written(low)}", kind)
        if kind == "integers" and not (isinstance(low, int) and isinstance(high, int)):
            raise flaw(f"needs whole numbers; found {written(given)}", kind)
    numbers = {"uniform": Uniform, "loguniform": LogUniform, "integers": Integers}[kind]
    cast = int if kind == "integers" else float
    return numbers(tuple((cast(low), cast(high)) for low, high in zip(first, second, strict=True)), vector)


def _kind(table: dict[str, Any]) -> str:
    """Return the distribution that a table of `vary` names, and refuse tables that name none, several or other keys."""
    if any(isinstance(inner, dict) for inner in table.values()):
        raise flaw('must be a distribution or a value; a key with dots stands in quotes, "domain.gravity"')
    found = [kind for kind in _KINDS if kind in table]
    if len(found) > 1:
        raise flaw(f"is one distribution, and {listed(quoted(found), 'and')} are {len(found)}; keep one of them")
    for key in table:
        known = ["within"] if found == ["normal"] else [] if found else _KINDS
        if key not in (*found, *known):
            takes = f"{found[0]} takes no other key" if found else f"the distributions are {listed(_KINDS, 'and')}"
            raise flaw(f"unknown key; {hint_at(key, known, takes)}", key)
    if not found:
        raise flaw(f"must be a distribution, {listed(_KINDS)}, or a value; found an empty table")
    return found[0]


def _two(given: object, key: str) -> tuple[list[Any], list[Any]]:
    if isinstance(given, list) and len(given) == 2:
        first, second = (one if isinstance(one, list) else [one] for one in given)
        alike = isinstance(given[0], list) == isinstance(given[1], list) and len(first) == len(second) > 0
        if alike and all(is_number(one) for one in first + second):
            return first, second
    raise flaw(f"must be two numbers, or two lists of numbers of the same length; found {written(given)}", key)


def is_number(value: object) -> bool:
    """Return whether a value is a finite number within the supported range."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _bounded(
    mean: list[float], deviation: list[float], table: dict[str, Any], vector: bool
) -> tuple[tuple[float, ...], ...]:
    """Return (mean, deviation, lower bound, upper bound) of each component of a normal distribution."""
    if not all(std > 0 for std in deviation):
        right = "is [mean, standard deviation], and a deviation is greater than 0"
        raise flaw(f"{right}; found {written(deviation)}", "normal")
    low = [m - USUAL_DEVIATIONS * std for m, std in zip(mean, deviation, strict=True)]
    high = [m + USUAL_DEVIATIONS * std for m, std in zip(mean, deviation, strict=True)]
    if "within" in table:
        low, high = _two(table["within"], "within")
        if isinstance(table["within"][0], list) != vector or len(low) != len(mean):
            raise flaw("must be two bounds of the same kind as mean and standard deviation", "within")
    for m, std, lo, hi in zip(mean, deviation, low, high, strict=True):
        near = min(abs(lo - m), abs(hi - m)) if (lo - m) * (hi - m) > 0 else 0.0
        if not lo < hi or cumulative_normal(-near / std) == 0:
            raise flaw(f"must be [min, max] around values that occur; found [{lo:g}, {hi:g}]", "within")
    return tuple(tuple(map(float, one)) for one in zip(mean, deviation, low, high, strict=True))


def generator(seed: int, number: int, key: str) -> np.random.Generator:
    """Return a generator of random numbers for one key of one trajectory, independent of all others.

    Philox (J. K. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11), seeded by the sweep's seed,
    the trajectory's number, and the first 128 bits of the SHA-256 of the key.
    """
    words = np.frombuffer(sha256(key.encode()).digest()[:16], "<u4").tolist()
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=(number, *words))))


def joint_point(method: Method, seed: int, number: int, dimension: int, count: int) -> list[float]:
    """Return one number in [0, 1) for each of the `dimension` continuous components of a trajectory's values.

    With "sobol" it is point `number` of a Sobol sequence scrambled with the seed (A. B. Owen 1998), which does not
    depend on the count; with "latin" it is row `number` of a Latin hypercube of `count` points drawn with the seed.
    """
    if method == "latin":
        return _latin_hypercube(seed, dimension, count)[number].tolist()
    from scipy.stats import qmc

    sequence = qmc.Sobol(dimension, scramble=True, rng=seed)
    if number:  # SciPy cannot advance by 0.
        sequence.fast_forward(number)
    return sequence.random(1)[0].tolist()


@lru_cache(maxsize=2)
def _latin_hypercube(seed: int, dimension: int, count: int) -> np.ndarray:
    from scipy.stats import qmc

    return qmc.LatinHypercube(dimension, rng=seed).random(count)


Drawn = Annotated[Distribution, PlainValidator(read_distribution)]


class Region(Table):
    """A box with faces along the axes, in which bodies are placed."""

    min: Annotated[list_of_axes(Number), Field(description="Lower corner, m.")]
    max: Annotated[list_of_axes(Number), Field(description="Upper corner, m.")]

    @model_validator(mode="after")
    def _upper_corner_above_lower(self) -> "Region":
        flat = [a for a, lo, hi in zip(AXES, self.min, self.max, strict=False) if not lo < hi]
        if flat:
            raise flaw(f"must be above min along {' and '.join(flat)}, so that the region holds bodies", "max")
        return self


class Placement(Table):
    """Bodies or colliders that replace one of the base scene, at random positions in a region."""

    body: Annotated[
        str | None, Field(description="Name of a body of the base scene, a box or a ball: the template.")
    ] = None
    collider: Annotated[str | None, Field(description="Name of a collider in place of a body.")] = None
    count: Annotated[Drawn, Field(description="Number of bodies or colliders.")]
    size: Annotated[Drawn | None, Field(description="Edge lengths of a box, m. Default: those of the template.")] = None
    radius: Annotated[Drawn | None, Field(description="Radius of a ball, m. Default: that of the template.")] = None
    velocity: Annotated[
        Drawn | None, Field(description="Velocity, m/s, of a body the initial one. Default: that of the template.")
    ] = None
    region: Annotated[Region, Field(description="Box that they lie in, m.")]
    min_distance: Annotated[
        NotNegative, Field(description="Smallest distance to every other body and collider, m. Default: none.")
    ] = 0.0

    @model_validator(mode="after")
    def _one_template(self) -> "Placement":
        if (self.body is None) == (self.collider is None):
            found = "neither" if self.body is None else "both"
            raise flaw(f"must be the name of a body, or collider that of a collider; found {found}", "body")
        return self

    @property
    def template(self) -> str:
        """Name of the template."""
        return self.collider if self.body is None else self.body

    @property
    def list(self) -> Literal["bodies", "colliders"]:
        """The list of the scene that the template is in."""
        return "colliders" if self.body is None else "bodies"

    @property
    def key(self) -> str:
        """The key of the placed entries among the drawn values."""
        return f"place.{self.template}" if self.collider is None else f"place.colliders.{self.template}"

    @property
    def distributions(self) -> dict[str, Distribution]:
        """The distributions by key, such as `place.sand.size`."""
        drawn = {name: getattr(self, name) for name in ("count", "size", "radius", "velocity")}
        return {f"{self.key}.{name}": one for name, one in drawn.items() if one is not None}


Share = Annotated[float, Field(strict=True, ge=0, le=1)]


def _share_or_rules(value: object, share: ValidatorFunctionWrapHandler) -> Any:
    """Return a fraction, or a tuple of rules from a table or a list of tables."""
    rules = [value] if isinstance(value, dict) else value
    if not isinstance(rules, list):
        return share(value)
    if not rules or not all(isinstance(rule, dict) and rule for rule in rules):
        raise flaw(f"must be a fraction, or tables of keys and what of them is held out; found {written(value)}")
    return tuple(rules)


# A fraction, or what the split holds out; `sweep_file` checks keys and values.
ShareOrRules = Annotated[Share, WrapValidator(_share_or_rules)]


class Split(Table):
    """Fractions of the trajectories by split; their sum is 1. Rules in place of one take theirs out before."""

    train: Annotated[Share, Field(description="Fraction to train with, 0 to 1.")] = 0.0
    valid: Annotated[ShareOrRules, Field(description="Fraction to choose parameters with, 0 to 1, or rules.")] = 0.0
    test: Annotated[ShareOrRules, Field(description="Fraction to measure errors with, 0 to 1, or rules.")] = 0.0

    @model_validator(mode="after")
    def _whole(self) -> "Split":
        total = sum(self.shares.values())
        if abs(total - 1) > ROUND_OFF:
            raise flaw(f"must make 1 together, as train = 0.8, valid = 0.1, test = 0.1 do; found {total:g}")
        return self

    @property
    def shares(self) -> dict[str, float]:
        """The fractions; 0 of a split with rules."""
        return {name: 0.0 if isinstance(part, tuple) else part for name, part in self}

    @property
    def rules(self) -> Rules:
        """The rules of splits that have them."""
        return {name: part for name, part in self if isinstance(part, tuple)}


class Certify(Table):
    """Which trajectories are computed again, to measure their errors."""

    fraction: Annotated[
        float, Field(strict=True, gt=0, le=1, description="Fraction of the trajectories, above 0, up to 1.")
    ] = 0.02


class Images(Table):
    """Which images for training are made of the accepted trajectories; see `mpmcli render --cameras`."""

    cameras: Annotated[
        str | None, Field(description="A file with [[cameras]], beside the sweep. Default: those of the scene.")
    ] = None
    what: Annotated[tuple[What, ...], Field(min_length=1, description="What images hold. Default: all but normal.")] = (
        USUAL_WHAT
    )
    mode: Annotated[CameraMode, Field(description="Style of particles.")] = "dots"
    frames: Annotated[str, Field(description="Frames, as --frame selects them: first, last, all, N or A:B:S.")] = "all"

    @model_validator(mode="after")
    def _surfaces_have_normals(self) -> "Images":
        if self.mode == "dots" and "normal" in self.what:
            raise flaw('"normal" is for surfaces, and dots have none; give mode = "surface"', "what")
        return self


class SweepTable(Table):
    """The keys of a sweep file."""

    base: Annotated[str, Field(description="The base scene, a TOML file beside the sweep.")]
    count: Annotated[Integer, Field(ge=1, le=10**9, description="Number of trajectories.")]
    seed: Annotated[Integer, Field(ge=0, le=2**63 - 1, description="Seed of all draws.")] = 0
    method: Annotated[Method, Field(description="Sampling method of continuous distributions of [vary].")] = "random"
    accept: Annotated[Accepted, Field(description="The worst verdict of a trajectory of the dataset.")] = "stable"
    vary: Annotated[dict[str, Drawn], Field(description="Keys of the base scene and their distributions.")] = {}  # noqa: RUF012
    place: Annotated[tuple[Placement, ...], Field(description="Bodies and colliders placed at random.")] = ()
    split: Annotated[Split, Field(description="Fractions of the trajectories by their purpose.")] = Split(
        train=0.8, valid=0.1, test=0.1
    )
    certify: Annotated[Certify | None, Field(description="Trajectories whose errors are measured. Default: none.")] = (
        None
    )
    images: Annotated[Images | None, Field(description="Images for training of the trajectories. Default: none.")] = (
        None
    )


@dataclass(frozen=True, eq=False)
class Sweep:
    """A sweep file and its base scene, checked; see `sweep_file.load_sweep`.

    Attributes:
        path, text, data: the sweep file, its text, and its parsed TOML; base, base_text, base_data: the same of the
            base scene.
        count, seed, method, accept, split, certify, images: as in the file; count may be replaced.
        cameras: the tables of the file of cameras; None for those of the scene.
        vary: distributions by key of the base scene, in the order of the file.
        placements: bodies and colliders placed at random.
    """

    path: Path
    text: str
    data: dict[str, Any]
    base: Path
    base_text: str
    base_data: dict[str, Any]
    count: int
    seed: int
    method: Method
    accept: Accepted
    vary: dict[str, Distribution]
    placements: tuple[Placement, ...]
    split: Split
    certify: Certify | None
    images: Images | None = None
    cameras: dict[str, Any] | None = None

    @cached_property
    def key(self) -> str:
        """SHA-256, hexadecimal, of the base scene, the sweep and the count, independent of the layout of the files.

        [certify] and [images] do not matter, as trajectories do not depend on them.
        The order of keys in [vary] and of [[place]] matters, because grids and Sobol components follow it.
        """
        vary, place = self.data.get("vary", {}), self.data.get("place", [])
        content = {name: getattr(self, name) for name in ("count", "seed", "method", "accept")}
        content |= {"base": self.base_data, "vary": list(vary.items()), "split": dict(self.split)}
        content["place"] = [place] if isinstance(place, dict) else place
        return sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()

    @cached_property
    def distributions(self) -> dict[str, Distribution]:
        """All distributions by key: those of `vary`, then those of the placements, such as `place.sand.size`."""
        return self.vary | {key: one for place in self.placements for key, one in place.distributions.items()}

    @cached_property
    def drawn_once(self) -> dict[str, Distribution]:
        """The distributions with one value in each trajectory: those of `vary`, and the counts of placements."""
        return {key: one for key, one in self.distributions.items() if key in self.vary or key.endswith(".count")}

    def values_of(self, number: int) -> dict[str, Any]:
        """Return the values of `drawn_once` in a trajectory."""
        values = TrajectoryValues(self, number, {})
        return {key: values.value(key, key, one) for key, one in self.drawn_once.items()}

    def split_of(self, number: int, particles: int | None = None) -> str:
        """Return "train", "valid" or "test" for a trajectory; unknown `particles` meet no rule.

        That of the first rule that it meets. Else [0, 1] is divided into consecutive intervals as long as the
        fractions. Each group of TOGETHER consecutive trajectories has one in each of TOGETHER equal parts of [0, 1], in
        an order drawn from the seed. Therefore a trajectory keeps its split when the count grows, each split has its
        fraction of the first n trajectories for every n, to within about 3, and no grid of values of any length
        correlates with the splits.
        """
        rules = self.split.rules
        if rules and (held := held_in(rules, self.values_of(number), particles)):
            return held
        group, member = divmod(number, TOGETHER)
        offset, order = _split_order(self.seed, group)
        place = (order[member] + offset) / TOGETHER
        last, total = "train", 0.0
        for name, share in self.split.shares.items():
            total += share
            last = name if share > 0 else last
            if share > 0 and place < total:
                break
        return last


@lru_cache(maxsize=64)
def _split_order(seed: int, group: int) -> tuple[float, tuple[int, ...]]:
    """Return the position of the trajectories of a group in their parts of [0, 1], and their order.

    The position is a golden-ratio sequence, which is spread evenly for any number of groups; see `Sweep.split_of`.
    """
    first = int(generator(seed, 0, "split").integers(2**64, dtype=np.uint64))
    order = generator(seed, group, "split order").permutation(TOGETHER)
    return (first + group * GOLDEN) % 2**64 / 2**64, tuple(order.tolist())


class TrajectoryValues:
    """Values of one trajectory; those `given`, by the keys of `sweep.distributions`, are not drawn."""

    def __init__(self, sweep: Sweep, number: int, given: Mapping[str, Any]) -> None:
        """Choose the values of grids by the number, and the point of distributions that are drawn together."""
        self.sweep, self.number = sweep, number
        # The last grid changes from each trajectory to the next.
        grids, left = {}, number
        for key, grid in reversed(sweep.distributions.items()):
            if isinstance(grid, Grid):
                left, index = divmod(left, len(grid.values))
                grids[key] = grid.values[index]
        self.given = {**grids, **given}
        joint = {} if sweep.method == "random" else {k: d for k, d in sweep.vary.items() if d.continuous}
        size = sum(distribution.components for distribution in joint.values())
        numbers = iter(joint_point(sweep.method, sweep.seed, number, size, sweep.count) if size else [])
        self.joint = {key: [next(numbers) for _ in range(one.components)] for key, one in joint.items()}

    def value(self, key: str, stream: str, distribution: Distribution) -> Any:
        """Return the value of a key of `sweep.distributions`, drawn with the random numbers of a stream."""
        if key in self.given:
            return self.given[key]
        if key in self.joint:
            return distribution.value(self.joint[key])
        return distribution.value(self.generator(stream).random(distribution.components).tolist())

    def generator(self, stream: str) -> np.random.Generator:
        """Return the random number generator of a stream of this trajectory."""
        return generator(self.sweep.seed, self.number, stream)
