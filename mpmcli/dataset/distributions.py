"""Distributions of a sweep file: each is a quantile function, from numbers u in [0, 1) to a value."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, ClassVar

from mpmcli.scene.quantity import LARGEST, flaw
from mpmcli.scene.sentences import listed, nearest, quoted, written

# A normal distribution that says no bounds ends at so many standard deviations.
USUAL_DEVIATIONS = 3.0


@dataclass(frozen=True)
class Distribution:
    """What one key of a sweep is drawn from.

    Attributes:
        continuous: whether the value depends continuously on u; such values are drawn by the sweep's method.
    """

    continuous: ClassVar[bool] = False

    @property
    def components(self) -> int:
        """Number of u that a value needs."""
        return 0

    def value(self, u: Sequence[float]) -> Any:
        """Return the value at u, `components` numbers in [0, 1); plain Python, as TOML holds it."""
        raise NotImplementedError

    def extremes(self) -> list[Any]:
        """Return the values at both ends; all values where they have no order."""
        raise NotImplementedError


@dataclass(frozen=True)
class Constant(Distribution):
    """One value."""

    constant: Any

    def value(self, u: Sequence[float]) -> Any:
        """Return the constant."""
        return self.constant

    def extremes(self) -> list[Any]:
        """Return the constant alone."""
        return [self.constant]


@dataclass(frozen=True)
class Choice(Distribution):
    """One of some values, each as likely."""

    values: tuple[Any, ...]

    @property
    def components(self) -> int:
        """One."""
        return 1

    def value(self, u: Sequence[float]) -> Any:
        """Return the value of index floor(n u)."""
        return self.values[int(len(self.values) * u[0])]

    def extremes(self) -> list[Any]:
        """Return all values."""
        return list(self.values)


@dataclass(frozen=True)
class Grid(Distribution):
    """Values in turn: trajectories run through the combinations of all grids of a sweep."""

    values: tuple[Any, ...]

    def extremes(self) -> list[Any]:
        """Return all values."""
        return list(self.values)


@dataclass(frozen=True)
class Numbers(Distribution):
    """A number, or a vector with independent components.

    Attributes:
        parameters: of each component; the last two are the smallest and the largest value.
        vector: whether the value is a list.
    """

    parameters: tuple[tuple[float, ...], ...]
    vector: bool

    @property
    def components(self) -> int:
        """Length of the vector; 1 for a number."""
        return len(self.parameters)

    def value(self, u: Sequence[float]) -> Any:
        """Return the quantiles at u, within the bounds."""
        drawn = [min(max(self.quantile(x, *one), one[-2]), one[-1]) for x, one in zip(u, self.parameters, strict=True)]
        return drawn if self.vector else drawn[0]

    def extremes(self) -> list[Any]:
        """Return the value with every component at its lower end, and that with every one at its upper end."""
        ends = [[one[-2] for one in self.parameters], [one[-1] for one in self.parameters]]
        return ends if self.vector else [end[0] for end in ends]

    @staticmethod
    def quantile(u: float, *parameters: float) -> float:
        """Return where the cumulative distribution of one component is u."""
        raise NotImplementedError


@dataclass(frozen=True)
class Uniform(Numbers):
    """As likely everywhere between two bounds."""

    continuous: ClassVar[bool] = True

    @staticmethod
    def quantile(u: float, low: float, high: float) -> float:
        """lo + u (hi - lo)."""
        return low + u * (high - low)


@dataclass(frozen=True)
class LogUniform(Numbers):
    """The logarithm is uniform between the logarithms of two bounds."""

    continuous: ClassVar[bool] = True

    @staticmethod
    def quantile(u: float, low: float, high: float) -> float:
        """lo (hi / lo)^u."""
        return low * math.exp(u * (math.log(high) - math.log(low)))


@dataclass(frozen=True)
class Integers(Numbers):
    """Whole numbers, both bounds included, each as likely."""

    @staticmethod
    def quantile(u: float, low: float, high: float) -> float:
        """lo + floor(u (hi - lo + 1)); bounds are whole numbers below 2^53, so that no rounding skips one."""
        return low + math.floor(u * (high - low + 1))


@dataclass(frozen=True)
class Normal(Numbers):
    """Normal, cut off at two bounds: the density between them is that of the whole one, scaled."""

    continuous: ClassVar[bool] = True

    @staticmethod
    def quantile(u: float, mean: float, deviation: float, low: float, high: float) -> float:
        """mean + std Phi^-1(Phi(a) + u (Phi(b) - Phi(a))), with a and b the bounds in standard deviations."""
        a, b = (low - mean) / deviation, (high - mean) / deviation
        # In the upper tail Phi rounds to 1, so that both tails are computed in the lower one.
        sign = 1.0 if a + b <= 0 else -1.0
        from_a, from_b = cumulative_normal(sign * a), cumulative_normal(sign * b)
        p = min(max(from_a + u * (from_b - from_a), math.ulp(0.0)), 1.0 - math.ulp(0.5))
        return mean + sign * deviation * NormalDist().inv_cdf(p)


def cumulative_normal(z: float) -> float:
    """Return Phi(z) = erfc(-z / sqrt 2) / 2, exact in the lower tail."""
    return math.erfc(-z / math.sqrt(2)) / 2


def read_distribution(value: object) -> Distribution:
    """Return the distribution that a value of a sweep file means.

    `uniform = [lo, hi]`, `loguniform = [lo, hi]`, `integers = [lo, hi]` with both bounds, `normal = [mean, std]`
    with `within = [min, max]` (default: three standard deviations either side), `choice = [values]`, `grid =
    [values]`; what is no table is a constant. Where both bounds are lists of equal length, the value is a list
    with independent components.

    Raises:
        PydanticCustomError: a flaw, for pydantic to report.
    """
    if not isinstance(value, dict):
        return Constant(value)
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


_KINDS = ["uniform", "loguniform", "normal", "integers", "choice", "grid"]


def _kind(table: dict[str, Any]) -> str:
    """Return the one key that names the distribution."""
    if any(isinstance(inner, dict) for inner in table.values()):
        raise flaw('must be a distribution or a value; a key with dots stands in quotes, "domain.gravity"')
    found = [kind for kind in _KINDS if kind in table]
    if len(found) > 1:
        raise flaw(f"is one distribution, and {listed(quoted(found), 'and')} are {len(found)}; keep one of them")
    for key in table:
        known = ["within"] if found == ["normal"] else [] if found else _KINDS
        if key not in (*found, *known):
            guess = nearest(key, known)
            takes = f"{found[0]} takes no other key" if found else f"the distributions are {listed(_KINDS, 'and')}"
            hint = f'did you mean "{guess}"?' if guess else takes
            raise flaw(f"unknown key; {hint}", key)
    if not found:
        raise flaw(f"must be a distribution, {listed(_KINDS)}, or a value; found an empty table")
    return found[0]


def _two(given: object, key: str) -> tuple[list[Any], list[Any]]:
    """Return two numbers, or two lists of numbers, as lists."""
    if isinstance(given, list) and len(given) == 2:
        first, second = (one if isinstance(one, list) else [one] for one in given)
        alike = isinstance(given[0], list) == isinstance(given[1], list) and len(first) == len(second) > 0
        if alike and all(is_number(one) for one in first + second):
            return first, second
    raise flaw(f"must be two numbers, or two lists of numbers of the same length; found {written(given)}", key)


def is_number(value: object) -> bool:
    """Say whether a value is a finite number that can be computed with."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _bounded(
    mean: list[float], deviation: list[float], table: dict[str, Any], vector: bool
) -> tuple[tuple[float, ...], ...]:
    """Return (mean, deviation, lower bound, upper bound) of each component of a normal distribution."""
    if not all(std > 0 for std in deviation):
        raise flaw(
            f"is [mean, standard deviation], and a deviation is greater than 0; found {written(deviation)}", "normal"
        )
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
