"""Evaluates the laws for a frame: stress, energy, and the state after plastic flow, as the next step uses it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti

from mpmcli.solver.particle_arrays import ParticleArrays

# Rows and columns of the entries of a symmetric 3 x 3 matrix, in the order of the arrays below; 2D leaves two out.
ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


@dataclass(frozen=True)
class Observation:
    """What one law gives for its n particles, in the solver's order.

    Attributes:
        tau: Kirchhoff stress, (n, 3, 3), Pa; None where it was not requested.
        energy: stored energy per volume at rest, (n,), J/m^3, half a step earlier: where the velocities are.
        deformation: J, (n,), or F, (n, d, d), after plastic flow.
        internal: internal variables after plastic flow, (n,) each, by name.
    """

    tau: np.ndarray | None
    energy: np.ndarray
    deformation: np.ndarray
    internal: dict[str, np.ndarray]


def build_observation(group: ParticleArrays) -> Callable[..., Observation]:
    """Return the observation of a range of particles: a function (dt, first, count) of the last step, s, and the range.

    Its `stress=False` leaves out the stress. Its `stored` are the deformation and the internal variables, (n, k), as
    read from the device. The device's state does not change: the next step applies plastic flow.
    """
    d, law, serial = group.dimension, group.law, group.serial
    kept = [e for e, (i, j) in enumerate(ENTRIES) if d == 3 or {i, j} <= {0, 1} or i == j == 2]
    placed = tuple((column, *ENTRIES[e]) for column, e in enumerate(kept))
    keeps_F = law.deformation == "F"
    inner_count = len(group.internal)

    @ti.kernel
    def observe(
        dt: float,
        first: int,
        with_stress: ti.template(),
        tau: ti.types.ndarray(),
        energy: ti.types.ndarray(),
        state: ti.types.ndarray(),
    ):
        ti.loop_config(serialize=serial)
        for q in range(energy.shape[0]):
            p = first + q
            _, C = group.motion(p)
            constants = group.constants(p)
            # Once for the state half a step back and once for the state: a loop, so that the law is compiled once.
            for k in range(2):
                back = 0.5 * (k - 1) * dt
                stored = group.stored(p)
                if ti.static(keeps_F):
                    stored += back * (C @ stored)
                else:
                    stored *= 1.0 + back * C.trace()
                stress, stress_zz, deformation, inner = law.respond(stored, group.inner(p), C, dt, constants)
                if k == 0:
                    energy[q] = law.energy(deformation, inner, constants)
                else:
                    if ti.static(with_stress):
                        for column, i, j in ti.static(placed):
                            if ti.static(i < d and j < d):
                                tau[q, column] = stress[i, j]
                            else:
                                tau[q, column] = stress_zz
                    if ti.static(law.projects):
                        if ti.static(keeps_F):
                            for i, j in ti.static(ti.ndrange(d, d)):
                                state[q, i * d + j] = deformation[i, j]
                        else:
                            state[q, 0] = deformation
                        for i in ti.static(range(inner_count)):
                            state[q, (d * d if keeps_F else 1) + i] = inner[i]

    def observed(dt: float, first: int, n: int, *, stress: bool, stored: tuple[np.ndarray, np.ndarray]) -> Observation:
        real, width = group.real, d * d if keeps_F else 1
        entries = np.empty((n if stress else 1, len(kept)), real)
        energy = np.empty(n, real)
        state = np.empty((n if law.projects else 1, width + inner_count), real)
        observe(dt, first, stress, entries, energy, state)
        tau = None
        if stress:
            tau = np.zeros((n, 3, 3), real)
            # The sign of a zero depends on how far a kernel was optimised.
            entries += 0.0
            for column, i, j in placed:
                tau[:, i, j] = tau[:, j, i] = entries[:, column]
        if not law.projects:
            deformation, internal = stored[0], list(stored[1].T)
        else:
            internal = list(state[:, width:].T)
            deformation = state[:, :width].reshape(n, d, d) if keeps_F else state[:, 0]
        names = [variable.name for variable in law.internal]
        return Observation(tau, energy, deformation, dict(zip(names, internal, strict=True)))

    return observed
