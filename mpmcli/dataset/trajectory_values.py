"""What a trajectory of a sweep draws for each key."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from mpmcli.dataset.distributions import Distribution, Grid
from mpmcli.dataset.sweep import Sweep
from mpmcli.dataset.unit_numbers import generator, joint_point


class TrajectoryValues:
    """Values of one trajectory.

    Args:
        sweep: what they are drawn from.
        number: of the trajectory.
        given: values in place of drawn ones, by the keys of `sweep.distributions`.
    """

    def __init__(self, sweep: Sweep, number: int, given: Mapping[str, Any]) -> None:
        self.sweep = sweep
        self.number = number
        self.given = {**_grid_values(sweep, number), **given}
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
        """Return the random numbers of a stream of this trajectory."""
        return generator(self.sweep.seed, self.number, stream)


def _grid_values(sweep: Sweep, number: int) -> dict[str, Any]:
    """Return the value of every grid; the last one changes from each trajectory to the next."""
    values = {}
    for key, grid in reversed(sweep.distributions.items()):
        if isinstance(grid, Grid):
            number, index = divmod(number, len(grid.values))
            values[key] = grid.values[index]
    return values
