"""Evaluates the laws for a frame: stress, energy, and the state after plastic flow, as the next step uses it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti

from mpmcli.solver.frame_arrays import stress_entries
from mpmcli.solver.particle_arrays import ParticleArrays


@dataclass(frozen=True)
class Observation:
    """What one law gives for its n particles, in the solver's order.

    Attributes:
        tau: Kirchhoff stress, (n, k), Pa, see `stress_entries`; None where it was not requested.
        energy: stored energy per volume at rest, (n,), J/m^3, half a step earlier: where the velocities are.
        deformation: J, (n,), or F, (n, d, d), after plastic flow.
        internal: internal variables after plastic flow, (n,) each, by name.
    """

    tau: np.ndarray | None
    energy: np.ndarray
    deformation: np.ndarray
    internal: dict[str, np.ndarray]


@ti.func
def respond_later(group: ti.template(), p: int, later: float, dt: float):
    """Return what the law of particle p gives in the next step, dt (s), if it deforms on for a time `later`, s."""
    _, C = group.motion(p)
    return respond_after(group.law, group.seen(p), group.inner(p), C, later, dt, group.constants(p))


@ti.func
def respond_after(
    law: ti.template(),
    stored: ti.template(),
    inner: ti.template(),
    C: ti.template(),
    later: float,
    dt: float,
    constants: ti.template(),
):
    """Return what `respond_later` does, from what a particle stores."""
    state = stored
    if ti.static(law.deformation == "F"):
        state += later * (C @ stored)
    else:
        state *= 1.0 + later * C.trace()
    return law.respond(state, inner, C, dt, constants)


def build_observation(group: ParticleArrays) -> Callable[..., Observation]:
    """Return the observation of a range of particles: a function (dt, first, count) of the last step, s, and the range.

    Its `stress=False` leaves out the stress. Its `stored` are the deformation and the internal variables, (n, k), as
    read from the device. The device's state does not change: the next step applies plastic flow.
    """
    d, law, serial = group.dimension, group.law, group.serial
    placed = tuple(enumerate(stress_entries(d)))
    keeps_F = law.deformation == "F"
    inner_count = len(group.internal)
    changed = law.projects or group.averaged

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
            # Once for the state half a step back and once for the state: a loop, so that the law is compiled once.
            for k in range(2):
                stress, stress_zz, deformation, inner = respond_later(group, p, 0.5 * (k - 1) * dt, dt)
                if k == 0:
                    energy[q] = law.energy(deformation, inner, group.constants(p))
                else:
                    if ti.static(with_stress):
                        for column, place in ti.static(placed):
                            if ti.static(place[0] < d and place[1] < d):
                                tau[q, column] = stress[place[0], place[1]]
                            else:
                                tau[q, column] = stress_zz
                    if ti.static(changed):
                        if ti.static(keeps_F):
                            for i, j in ti.static(ti.ndrange(d, d)):
                                state[q, i * d + j] = deformation[i, j]
                        else:
                            state[q, 0] = deformation
                        for i in ti.static(range(inner_count)):
                            state[q, (d * d if keeps_F else 1) + i] = inner[i]

    def observed(dt: float, first: int, n: int, *, stress: bool, stored: tuple[np.ndarray, np.ndarray]) -> Observation:
        real, width = group.real, d * d if keeps_F else 1
        entries = np.empty((n if stress else 1, len(placed)), real)
        energy = np.empty(n, real)
        state = np.empty((n if changed else 1, width + inner_count), real)
        observe(dt, first, stress, entries, energy, state)
        if not changed:
            deformation, internal = stored[0], list(stored[1].T)
        else:
            internal = list(state[:, width:].T)
            deformation = state[:, :width].reshape(n, d, d) if keeps_F else state[:, 0]
        names = [variable.name for variable in law.internal]
        return Observation(entries if stress else None, energy, deformation, dict(zip(names, internal, strict=True)))

    return observed
