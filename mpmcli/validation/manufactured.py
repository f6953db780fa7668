"""A standing wave of any amplitude in an elastic solid, and the body force that makes it exact (manufactured solution).

Along each axis i, with s_i = 1 or -1 (phases 0 and pi of Wallstedt and Guilkey 2008), in a unit square or cube of rest
density rho between slip walls:
    u_i = s_i A sin(k X_i) sin(w t), so that F is diagonal with F_i = 1 + s_i A k cos(k X_i) sin(w t),
    b_i = d2u_i/dt2 - (dP_ii/dX_i) / rho, with dF_i/dX_i = -k^2 u_i.
At t = 0 nothing is displaced.
"""

import math
from dataclasses import dataclass

import numpy as np

AXES = ("X", "Y", "Z")


@dataclass(frozen=True)
class StandingWave:
    """The motion, the force and the stress.

    Attributes:
        law: "neo_hookean" or "fixed_corotated".
        signs: s_i, one per axis that moves.
        half_waves: k / pi: half waves along each axis.
        young, poisson, density: Pa, -, kg/m^3.
        amplitude: A, m.
    """

    law: str
    signs: tuple[int, ...]
    half_waves: int
    young: float
    poisson: float
    density: float = 1.0
    amplitude: float = 0.05

    @property
    def shear_modulus(self) -> float:
        """Return mu, Pa."""
        return self.young / (2 * (1 + self.poisson))

    @property
    def lame_lambda(self) -> float:
        """Return lambda, Pa."""
        return self.young * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson))

    @property
    def frequency(self) -> float:
        """Return w = pi c with c = sqrt(E / rho), rad/s."""
        return math.pi * math.sqrt(self.young / self.density)

    @property
    def period(self) -> float:
        """Return 2 pi / w, s."""
        return 2 * math.pi / self.frequency

    def velocity(self) -> list[str]:
        """Return the initial velocity, m/s, as expressions of a scene, one per axis that moves."""
        peak = self.amplitude * self.frequency
        return [f"{sign * peak!r} * sin({self._wave} * {name})" for sign, name in zip(self.signs, AXES, strict=False)]

    def force(self) -> list[str]:
        """Return b, m/s^2, as expressions of a scene, one per axis that moves."""
        mu, lam = (modulus / self.density for modulus in (self.shear_modulus, self.lame_lambda))
        k2 = (self.half_waves * math.pi) ** 2
        stretches = [self._stretch(i) for i in range(len(self.signs))]
        found = []
        for i, F in enumerate(stretches):
            if self.law == "neo_hookean":
                # P_ii = mu (F_i - 1/F_i) + lambda ln J / F_i
                stiffness = f"{mu!r} * (1 + 1 / {F}**2)"
                if lam:
                    stiffness += f" + {lam!r} * (1 - log({' * '.join(stretches)})) / {F}**2"
            else:
                # P_ii = 2 mu (F_i - 1) + lambda (J - 1) J / F_i, where J / F_i is the product of the others.
                others = " * ".join(f"{stretch}**2" for j, stretch in enumerate(stretches) if j != i)
                stiffness = f"{2 * mu!r} + {lam!r} * {others}" if others else f"{2 * mu + lam!r}"
            found.append(f"{self._moved(i)} * ({k2!r} * ({stiffness}) - {self.frequency**2!r})")
        return found

    def displacement(self, X: np.ndarray, time: float) -> np.ndarray:
        """Return u, (n, d), m, of particles that began at X, (n, d), m: only the axes that move."""
        signs = np.array(self.signs)
        moving = X[:, : len(signs)]
        return signs * self.amplitude * np.sin(self.half_waves * np.pi * moving) * np.sin(self.frequency * time)

    def stretches(self, X: np.ndarray, time: float) -> np.ndarray:
        """Return F_i, (n, 3): 1 along axes that do not move."""
        signs = np.array(self.signs)
        k = self.half_waves * np.pi
        F = np.ones((len(X), 3))
        moving = X[:, : len(signs)]
        F[:, : len(signs)] += signs * self.amplitude * k * np.cos(k * moving) * np.sin(self.frequency * time)
        return F

    def piola_stress(self, X: np.ndarray, time: float) -> np.ndarray:
        """Return the diagonal of the first Piola-Kirchhoff stress, (n, 3), Pa."""
        F = self.stretches(X, time)
        J = F.prod(axis=1)[:, None]
        mu, lam = self.shear_modulus, self.lame_lambda
        if self.law == "neo_hookean":
            return mu * (F - 1 / F) + lam * np.log(J) / F
        return 2 * mu * (F - 1) + lam * (J - 1) * J / F

    def cauchy_stress(self, X: np.ndarray, time: float) -> np.ndarray:
        """Return the diagonal of the Cauchy stress, (n, 3), Pa."""
        F = self.stretches(X, time)
        return self.piola_stress(X, time) * F / F.prod(axis=1)[:, None]

    @property
    def _wave(self) -> str:
        return "pi" if self.half_waves == 1 else f"{self.half_waves} * pi"

    @property
    def _swing(self) -> str:
        return f"sin({self.frequency!r} * t)"

    def _moved(self, i: int) -> str:
        return f"{self.signs[i] * self.amplitude!r} * sin({self._wave} * {AXES[i]}) * {self._swing}"

    def _stretch(self, i: int) -> str:
        sign = "+" if self.signs[i] > 0 else "-"
        # F_i - 1 = s_i A k cos(k X_i) sin(w t), with A k as a multiple of pi.
        slope = self.amplitude * self.half_waves
        return f"(1 {sign} {slope!r} * pi * cos({self._wave} * {AXES[i]}) * {self._swing})"
