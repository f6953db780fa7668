"""The stable step of every scheme: no particle, cluster or block is less stable than a lone particle, whose bound is
closed; and what a wave loses in a step."""

from collections.abc import Callable

import numpy as np
import pytest
from blow_up.scenes import alone, block, liquid, solid
from blow_up.trial import Trial
from scenes import slow
from step_spectrum import Choice, Coupling, free, periodic, radius, step_matrix

from mpmcli.scene.schema import SolverSettings
from mpmcli.stability.limits import mode_limit
from mpmcli.stability.transfer_factors import loss_per_step, step_inertia

KNOBS = [
    {"kernel": kernel, **transfer}
    for kernel in ("quadratic", "cubic")
    for transfer in ({"transfer": "apic"}, {"transfer": "aflip", "flip": 1.0})
]
# Eigenvalues of 1 that share an eigenvector are found to the square root of round-off.
NEUTRAL = 1 + 2e-5


def name_of(knobs: dict) -> str:
    return "-".join(map(str, knobs.values()))


def bound_of(knobs: dict, dimension: int, lam: float, mu: float) -> float:
    """Return the solver's bound at a spacing and a density of 1."""
    inertia = step_inertia(SolverSettings(**knobs))
    return mode_limit(1.0, 1.0, dimension * lam + 2 * mu, 0.0, inertia)[0]


def clusters() -> list[np.ndarray]:
    random = np.random.default_rng(3)
    return [random.uniform(0, size, (count, 2)) for size in (0.3, 0.8, 1.5) for count in (2, 4, 7)]


def blocks(kernel: str, per_axis: int, offset: float) -> list[Coupling]:
    """Return an endless lattice in 2D at a set of wave vectors."""
    line = (offset + np.arange(per_axis)) / per_axis
    x = np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)
    waves = np.linspace(0.1, np.pi, 4)
    return [periodic(x, kernel, np.array([k, j])) for k in waves for j in (0.0, *waves) if j <= k]


@pytest.mark.parametrize("knobs", KNOBS, ids=name_of)
def test_nothing_is_less_stable_than_a_lone_particle(knobs: dict) -> None:
    """Spectra of a step below the bound: a lone particle, random clusters, and lattices of 1 and 4 per cell.

    The lone particle itself has no margin above; nu = 0 in 2D is where a lattice of one per cell has least.
    """
    choice = Choice(**knobs)
    for nu in (0.0, 0.3):
        lam, mu = nu / ((1 + nu) * (1 - 2 * nu)), 0.5 / (1 + nu)
        bound = bound_of(knobs, 2, lam, mu)
        lone = free(np.array([[0.31, 0.42]]), choice.kernel)
        assert radius(lone, choice, lam, mu, 0.99 * bound) < NEUTRAL
        assert radius(lone, choice, lam, mu, 1.01 * bound) > 1.01
        couplings = [free(x, choice.kernel) for x in clusters()]
        couplings += [near for offset in (0.0, 0.5) for near in blocks(choice.kernel, 1, offset)]
        couplings += blocks(choice.kernel, 2, 0.5)
        worst = max(radius(near, choice, lam, mu, 0.99 * bound) for near in couplings)
        assert worst < NEUTRAL


@pytest.mark.parametrize("knobs", KNOBS, ids=name_of)
def test_a_wave_loses_what_check_says(knobs: dict) -> None:
    """The eigenvalue of a long wave in 1D, two particles per cell, at two steps: its modulus squared is 1 - loss.

    Beside it stands the loss of order (k h)^6, and AFLIP's own, which comes of C alone.
    """
    choice = Choice(**knobs)
    k, x = 0.2, np.array([[0.25], [0.75]])
    for dt in (0.2, 0.6):
        eigenvalues = np.linalg.eigvals(step_matrix(periodic(x, choice.kernel, np.array([k])), choice, 1.0, 0.0, dt))
        angles = np.abs(np.angle(eigenvalues))
        wave = eigenvalues[(np.abs(eigenvalues) > 0.5) & (np.abs(angles - k * dt) < 0.3 * k * dt)]
        lost = 1 - np.abs(wave).max() ** 2
        assert lost == pytest.approx(loss_per_step(SolverSettings(**knobs), k), rel=0.03, abs=1e-3 * k**4)


@pytest.mark.parametrize("knobs", [{"kernel": "cubic"}, slow({"transfer": "aflip", "flip": 1.0})], ids=name_of)
def test_a_lone_particle_blows_up_at_the_bound(backend_of: Callable, knobs: dict) -> None:
    """The solver's own steps, at 0.98 and 1.02 of what it allows."""
    scene = alone("fluid", liquid(), 2, stretches=(1 + 1e-6,) * 2)
    trial = Trial(scene, backend_of("f64", 1), knobs)
    assert not trial.run(0.98 * trial.predicted, 2000).blew_up
    assert trial.run(1.02 * trial.predicted, 500).blew_up


@pytest.mark.slow
@pytest.mark.parametrize("flip", [0.95, 1.0])
@pytest.mark.parametrize("per_axis", [1, 2, 3])
def test_blocks_stay_bounded_with_flip(backend_of: Callable, flip: float, per_axis: int) -> None:
    """What the grid does not see of the velocities is kept, and not fed: 10^4 steps at 0.98 of the bound."""
    scene = block("block", solid("neo_hookean", 1e5, 0.3), 2, per_axis)
    trial = Trial(scene, backend_of("f64", 1), {"transfer": "aflip", "flip": flip})
    run = trial.run(0.98 * trial.predicted, 10_000)
    assert not run.blew_up and run.late < 2
