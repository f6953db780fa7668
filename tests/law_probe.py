"""What tests ask of a law: its response and its energy, as the kernels compute them, of many states at once."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from mpmcli.materials.law import Law
from mpmcli.materials.registry import laws
from mpmcli.scene.material import MaterialParameters

EPSILON = {"f64": 2.3e-16, "f32": 1.2e-7}


@dataclass(frozen=True)
class Response:
    """n answers: tau (n, 3, 3), with tau_zz in its place in 2D; the state after plastic flow; energy (n,), float64."""

    tau: np.ndarray
    deformation: np.ndarray
    internal: np.ndarray
    energy: np.ndarray


class LawProbe:
    """One law on a running backend; needs `backend_of("f64")` or f32 first, and dies with that backend.

    The kernel is compiled once per probe: keep one per law and parameters, and give it many states.
    """

    def __init__(self, law: type[Law], parameters: MaterialParameters, dimension: int) -> None:
        self.law = law([parameters], dimension)
        self.dimension = d = dimension
        constants = self.law.constants(parameters)
        real = np.float64 if ti.lang.impl.current_cfg().default_fp == ti.f64 else np.float32
        self._real = real
        table = ti.Vector.field(len(constants), float, shape=())
        table.from_numpy(np.array(constants, real))
        bound_law, keeps_F, names = self.law, self.law.deformation == "F", len(self.law.internal)

        @ti.kernel
        def run(
            deformation: ti.types.ndarray(),
            internal: ti.types.ndarray(),
            gradient: ti.types.ndarray(),
            dt: float,
            out: ti.types.ndarray(),
        ):
            for p in range(out.shape[0]):
                C = ti.Matrix.zero(float, d, d)
                for i, j in ti.static(ti.ndrange(d, d)):
                    C[i, j] = gradient[p, i, j]
                variables = ti.Vector.zero(float, ti.static(max(names, 1)))
                for i in ti.static(range(names)):
                    variables[i] = internal[p, i]
                if ti.static(keeps_F):
                    F = ti.Matrix.zero(float, d, d)
                    for i, j in ti.static(ti.ndrange(d, d)):
                        F[i, j] = deformation[p, i, j]
                    tau, tau_zz, new, inner = bound_law.respond(F, variables, C, dt, table[None])
                    for i, j in ti.static(ti.ndrange(d, d)):
                        out[p, i * 3 + j] = tau[i, j]
                        out[p, 9 + i * d + j] = new[i, j]
                    out[p, 18] = tau_zz
                    out[p, 19] = bound_law.energy(new, inner, table[None])
                    for i in ti.static(range(names)):
                        out[p, 20 + i] = inner[i]
                else:
                    J = deformation[p, 0, 0]
                    tau, tau_zz, new, inner = bound_law.respond(J, variables, C, dt, table[None])
                    for i, j in ti.static(ti.ndrange(d, d)):
                        out[p, i * 3 + j] = tau[i, j]
                    out[p, 9] = new
                    out[p, 18] = tau_zz
                    out[p, 19] = bound_law.energy(new, inner, table[None])
                    for i in ti.static(range(names)):
                        out[p, 20 + i] = inner[i]

        self._run = run

    def at_rest(self, count: int) -> np.ndarray:
        """Return the internal variables of `count` particles at rest, (count, number of variables)."""
        return np.tile([variable.at_rest for variable in self.law.internal], (count, 1)).reshape(count, -1)

    def __call__(
        self, F: np.ndarray, internal: np.ndarray | None = None, C: np.ndarray | None = None, dt: float = 1e-3
    ) -> Response:
        """Return the response to states F (n, d, d), of which a law that keeps J gets det F.

        `internal` is (n, number of internal variables), at rest where None or left out; C is (n, d, d), 0 where None.
        """
        n, d = len(F), self.dimension
        given = np.zeros((n, 0)) if internal is None else internal
        internal = np.hstack([given, self.at_rest(n)[:, given.shape[1] :]])
        keeps_F = self.law.deformation == "F"
        given = F if keeps_F else np.linalg.det(F)[:, None, None]
        padded = np.zeros((n, max(internal.shape[1], 1)))
        padded[:, : internal.shape[1]] = internal
        out = np.zeros((n, 20 + max(internal.shape[1], 1)), self._real)
        gradient = np.zeros((n, d, d)) if C is None else C
        self._run(*(np.ascontiguousarray(a, self._real) for a in (given, padded, gradient)), dt, out)
        values = out.astype(np.float64)
        tau = values[:, :9].reshape(n, 3, 3).copy()
        if d == 2:
            tau[:, 2, 2] = values[:, 18]
        deformation = values[:, 9 : 9 + d * d].reshape(n, d, d) if keeps_F else values[:, 9]
        return Response(tau, deformation, values[:, 20 : 20 + internal.shape[1]], values[:, 19])


class Probes:
    """Probes of one precision, one for each dimension and parameters, compiled when first asked for."""

    def __init__(self, parameters: Callable[..., MaterialParameters], precision: str = "f64") -> None:
        self.epsilon = EPSILON[precision]
        self.real = np.float64 if precision == "f64" else np.float32
        self._parameters, self._made = parameters, {}

    def __call__(self, d: int, *which: Any, **changes: Any) -> LawProbe:
        """Return the probe of the parameters that belong to the other arguments."""
        key = (d, *which, *sorted(changes.items()))
        if key not in self._made:
            parameters = self._parameters(*which, **changes)
            self._made[key] = LawProbe(laws()[parameters.law], parameters, d)
        return self._made[key]


def rotations(random: np.random.Generator, count: int, d: int) -> np.ndarray:
    """Return random rotations (n, d, d), by QR decompositions."""
    Q, R = np.linalg.qr(random.normal(size=(count, d, d)))
    Q = Q * np.sign(np.einsum("nii->ni", R))[:, None, :]
    Q[:, :, 0] *= np.sign(np.linalg.det(Q))[:, None]
    return Q


def stretched(stretches: np.ndarray, seed: int | np.random.Generator = 1) -> np.ndarray:
    """Return F (n, d, d) of random principal axes with these signed stretches (n, d)."""
    random = np.random.default_rng(seed)
    n, d = stretches.shape
    axes = (rotations(random, n, d), rotations(random, n, d).transpose(0, 2, 1))
    return axes[0] * stretches[:, None, :] @ axes[1]


def wild(d: int) -> np.ndarray:
    """Return crushed, torn, flat, vanished, inverted and badly sheared states (n, d, d)."""
    sheared = np.eye(d)
    sheared[0, 1] = 10.0
    flat = np.diag([0.0, 1.0, 1.0][:d])
    mirrored = np.diag([-1.0, 1.0, 1.0][:d])
    shapes = [sheared, flat, flat @ sheared, mirrored, 0.5 * mirrored, sheared @ mirrored, np.zeros((d, d))]
    return np.array([size * np.eye(d) for size in (0.01, 1e-6, 1.05, 3.0, 100.0, 1e9)] + shapes)


def assert_finite(*answers: Response) -> None:
    """Fail where anything of an answer is not finite."""
    for answer in answers:
        for values in (answer.tau, answer.deformation, answer.internal, answer.energy):
            assert np.isfinite(values).all()
