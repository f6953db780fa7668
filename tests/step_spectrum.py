"""The linearised step of particles at rest as a matrix, from the formulas of the transfers, and its spectral radius.

The state of each particle is its velocity v, its C and its strain e, with tau = lambda tr(e) I + 2 mu e. Lengths are in
cells, and the density is 1. No code is shared with the solver.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from mpm_reference import cubic, quadratic

SPLINES = {"quadratic": quadratic, "cubic": cubic}
INVERSE_MOMENT = {"quadratic": 4.0, "cubic": 3.0}


@dataclass(frozen=True)
class Choice:
    """Knobs: kernel, transfer, and the share of FLIP."""

    kernel: str = "quadratic"
    transfer: str = "apic"
    flip: float = 0.0


@dataclass(frozen=True)
class Coupling:
    """Weights between n particles and the nodes: `value` and, per axis, `lever` w (x_i - x) from particles to nodes,
    divided by the nodes' masses; `back` and `back_lever` from nodes to particles."""

    value: np.ndarray
    lever: list[np.ndarray]
    back: np.ndarray
    back_lever: list[np.ndarray]


def free(x: np.ndarray, kernel: str) -> Coupling:
    """Return the coupling of particles (n, d) by themselves."""
    ranges = [
        range(int(np.floor(low)) - 2, int(np.ceil(high)) + 3) for low, high in zip(x.min(0), x.max(0), strict=True)
    ]
    r = np.array(list(product(*ranges)))[:, None, :] - x
    w = np.vectorize(SPLINES[kernel])(r).prod(-1)
    r, w = r[w.sum(1) > 1e-14], w[w.sum(1) > 1e-14]
    levers = [w * r[..., a] for a in range(x.shape[1])]
    mass = w.sum(1)[:, None]
    return Coupling(w / mass, [q / mass for q in levers], w.T, [q.T for q in levers])


def periodic(x: np.ndarray, kernel: str, k: np.ndarray) -> Coupling:
    """Return the coupling of particles (n, d) that repeat in every cell with the phase e^(i k R) (Bloch)."""
    shifts = np.array(list(product(range(-3, 4), repeat=x.shape[1])))
    r = -(x + shifts[:, None, :])
    w = np.vectorize(SPLINES[kernel])(r).prod(-1)
    phased = w * np.exp(1j * shifts @ k)[:, None]
    value = phased.sum(0)[None]
    levers = [(phased * r[..., a]).sum(0)[None] for a in range(x.shape[1])]
    mass = w.sum()
    return Coupling(value / mass, [q / mass for q in levers], value.conj().T, [q.conj().T for q in levers])


def step_matrix(near: Coupling, choice: Choice, lam: float, mu: float, dt: float) -> np.ndarray:
    """Return the matrix of a step on (v, C, e), blocks of n entries: v_c, C_ca row by row, e_cc' with c <= c'."""
    n, d = near.value.shape[1], len(near.lever)
    pairs = [(a, b) for a in range(d) for b in range(a, d)]
    place = {pair: d + d * d + k for k, pair in enumerate(pairs)} | {
        (b, a): d + d * d + k for k, (a, b) in enumerate(pairs)
    }

    def block(index: int) -> slice:
        return slice(index * n, (index + 1) * n)

    size = (d + d * d + len(pairs)) * n
    kick, kept = dt * INVERSE_MOMENT[choice.kernel], choice.flip
    gradients = {}
    M = np.zeros((size, size), near.value.dtype)
    for c in range(d):
        before = np.zeros((len(near.value), size), near.value.dtype)
        before[:, block(c)] = near.value
        for a in range(d):
            before[:, block(d + c * d + a)] = near.lever[a]
        after = before.copy()
        for a in range(d):
            after[:, block(place[c, a])] -= kick * 2 * mu * near.lever[a]
            after[:, block(place[a, a])] -= kick * lam * near.lever[c]
        M[block(c)] = near.back @ (after - kept * before)
        M[block(c), block(c)] += kept * np.eye(n)
        for b in range(d):
            own, back = block(d + c * d + b), INVERSE_MOMENT[choice.kernel] * near.back_lever[b]
            gradients[c, b] = back @ after
            M[own] = back @ (after - kept * before)
            M[own, own] += kept * np.eye(n)
    for a, b in pairs:
        M[block(place[a, b])] = 0.5 * dt * (gradients[a, b] + gradients[b, a])
        M[block(place[a, b]), block(place[a, b])] += np.eye(n)
    return M


def radius(near: Coupling, choice: Choice, lam: float, mu: float, dt: float) -> float:
    """Return the largest absolute eigenvalue of a step."""
    return float(np.abs(np.linalg.eigvals(step_matrix(near, choice, lam, mu, dt))).max())
