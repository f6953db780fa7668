"""What splits hold out: rules on drawn values and on the number of particles, for sweep, card and audit.

A rule is a table of conditions by key, all of which a trajectory meets: [lower, upper] of a number, both included, or a
list of other values. Keys are those of the draws, with components and counts as in the card, and PARTICLES.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from mpmcli.plain_text import counted
from mpmcli.scene.problem import listed, written

PARTICLES = "particles"
Rule = Mapping[str, Sequence[Any]]
# The rules of each split that has some.
Rules = Mapping[str, Sequence[Rule]]


def held_in(rules: Rules, draws: Mapping[str, Any], particles: int | None) -> str:
    """Return the first split with a rule that a trajectory meets, "" if there is none."""
    return next((split for split, its in rules.items() if any(meets(rule, draws, particles) for rule in its)), "")


def meets(rule: Rule, draws: Mapping[str, Any], particles: int | None) -> bool:
    """Return whether a trajectory meets a rule; it does not if a value is unknown."""
    return all(_holds(given, _value(draws, key, particles)) for key, given in rule.items())


def is_range(given: object) -> bool:
    """Return whether a condition is [lower, upper]."""
    numbers = isinstance(given, list) and [x for x in given if isinstance(x, int | float) and not isinstance(x, bool)]
    return bool(numbers) and len(numbers) == len(given) == 2


def _holds(given: Sequence[Any], value: Any) -> bool:
    if is_range(given):
        return isinstance(value, int | float) and given[0] <= value <= given[1]
    return value in given


def _value(draws: Mapping[str, Any], key: str, particles: int | None) -> Any:
    """Return the value of a key of a rule: a drawn one, a component of one, or a number of placed bodies."""
    if key == PARTICLES or key in draws:
        return particles if key == PARTICLES else draws[key]
    whole, _, last = key.rpartition(".")
    found = draws.get(whole, ())
    return len(found) if last == "count" else found[int(last)] if found else None


def rules_text(rules: Rules, trajectories: Sequence[tuple[Mapping[str, Any], int]]) -> str:
    """Return the rules in words, and how many of the given draws and numbers of particles meet each; "" without any."""
    lines = [
        "The first of these rules that a trajectory meets decides its split; fractions decide those of all others:\n"
    ]
    for split, rule in ((split, rule) for split, its in rules.items() for rule in its):
        said = []
        for key, given in rule.items():
            values = listed([written(one) for one in given])
            some = f"from {given[0]:.12g} to {given[1]:.12g}" if is_range(given) else values
            said.append(f"`{key}` {some}")
        count = sum(meets(rule, *one) for one in trajectories)
        lines.append(f"* {split}: {' and '.join(said)}: {counted(count, 'trajectory')} included")
    return "\n".join(lines) if rules else ""
