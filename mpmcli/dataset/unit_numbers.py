"""Numbers in [0, 1) that trajectories are drawn with: independent, of a Sobol sequence, or of a Latin hypercube."""

from functools import lru_cache
from hashlib import sha256
from typing import Literal

import numpy as np

Method = Literal["random", "sobol", "latin"]


def generator(seed: int, number: int, key: str) -> np.random.Generator:
    """Return the random numbers of one key of one trajectory; no other key and no other trajectory shares them.

    Philox (J. K. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11), seeded by the sweep's seed,
    the trajectory's number, and the first 128 bits of the SHA-256 of the key.
    """
    words = np.frombuffer(sha256(key.encode()).digest()[:16], "<u4").tolist()
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=(number, *words))))


def joint_point(method: Method, seed: int, number: int, dimension: int, count: int) -> list[float]:
    """Return the point of a trajectory in the unit cube that all continuous components of a sweep share.

    Args:
        method: "sobol", point `number` of the scrambled Sobol sequence (A. B. Owen 1998); "latin", row `number` of
            a Latin hypercube of `count` points.
        seed: of the scrambling, or of the hypercube.
        number: of the trajectory, from 0.
        dimension: number of components.
        count: number of trajectories; a Sobol sequence does not depend on it.
    """
    if method == "latin":
        return _latin_hypercube(seed, dimension, count)[number].tolist()
    from scipy.stats import qmc

    sequence = qmc.Sobol(dimension, scramble=True, rng=seed)
    if number:  # SciPy cannot go forward by nothing.
        sequence.fast_forward(number)
    return sequence.random(1)[0].tolist()


@lru_cache(maxsize=2)
def _latin_hypercube(seed: int, dimension: int, count: int) -> np.ndarray:
    from scipy.stats import qmc

    return qmc.LatinHypercube(dimension, rng=seed).random(count)
