"""One row of the ledger of a run: events up to a frame, and conserved quantities at it."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from mpmcli.errors import InputError
from mpmcli.scene.problem import hint_at, listed

# Entries per collider, and per pair of bodies that separate.
LOADS = ("collider_force", "collider_torque", "contact_force", "contact_torque")
# Entries per free collider.
RIGID = ("rigid_pose", "rigid_motion")


@dataclass(frozen=True)
class LedgerRow:
    """Health and conserved quantities of a run at one frame, all sums in float64.

    Attributes:
        time: s.
        steps: time steps taken since the previous frame.
        step_min, step_max: smallest and largest step since the previous frame, s (0 at frame 0).
        limit: name of the bound that set the smallest step, "" at frame 0.
        speed_max: largest particle speed, m/s.
        courant_max: largest displacement in one step since the previous frame, in cells: that of the fastest
            node, which no particle exceeds (on a GPU an estimate between measurements).
        volume_ratio_min, volume_ratio_max: range of J = det F.
        mass: kg (kg per metre of depth in 2D, and so for all that follows).
        kinetic: sum m (|v|^2 + h^2/4 |C|^2)/2, J (Jiang et al. 2015: the affine part included).
        elastic: stored energy of every law that has one, J, half a step before `time`, where the velocities are.
        potential: -sum m g.x relative to the origin of the domain, J, half a step before `time`, too.
        linear_momentum: sum m v, kg m/s, one number per axis.
        angular_momentum: sum m x cross v + m h^2/4 axl(C) about the origin of the domain,
            kg m^2/s, one number in 2D and three in 3D.
        volume_error: volume of the cells inside liquids and grains over that of the particles in them, minus 1; 0 if
            hardly any cell is inside. collider_force, collider_torque: on each collider, N, and about its pivot, N m:
            means since the previous frame of the momentum that it took from the material (0 at frame 0); per metre of
            depth in 2D. collider_work: work of colliders with prescribed motion on the material since the previous
            frame, J, summed over steps; None without such, or if not known. contact_force, contact_torque: for each
            pair of bodies of which one has a velocity field of its own, see `ContactTable.pairs`, means of the force on
            the first by the second, N, and about the domain's origin, N m. contact_overlap: deepest overlap of surfaces
            that met since the previous frame, in cells; contact_work: work of contact on what it parts since the
            previous frame, J: negative while its springs take up energy. These two are None if no body separates.
        rigid_pose: centre of each free collider, m, and its angle, rad, or its unit quaternion, the real part first;
            rigid_motion: its velocity, m/s, and its angular velocity, rad/s. Its energies are included in those above,
                its momenta are not. emitted, retired: particles that passed mouths of emitters so far, and that left
                through open faces; emitted_mass, retired_mass: their mass, kg; nozzle_mass: mass that has entered, but
                not passed a mouth, kg. Sums are over the particles present. blocked: particles of emitters that have
                found their place occupied so far. They never enter, unless they are half of a sheet or more, which then
                waits. These six are None if no particle comes or goes.

    Velocities are those of the middle of the last step before `time`.
    """

    time: float
    steps: int
    step_min: float
    step_max: float
    limit: str
    speed_max: float
    courant_max: float
    volume_ratio_min: float
    volume_ratio_max: float
    mass: float
    kinetic: float
    elastic: float
    potential: float
    linear_momentum: tuple[float, ...]
    angular_momentum: tuple[float, ...]
    volume_error: float = 0.0
    collider_force: tuple[tuple[float, ...], ...] = ()
    collider_torque: tuple[tuple[float, ...], ...] = ()
    contact_force: tuple[tuple[float, ...], ...] = ()
    contact_torque: tuple[tuple[float, ...], ...] = ()
    collider_work: float | None = None
    contact_work: float | None = None
    contact_overlap: float | None = None
    rigid_pose: tuple[tuple[float, ...], ...] = ()
    rigid_motion: tuple[tuple[float, ...], ...] = ()
    emitted: int | None = None
    emitted_mass: float | None = None
    nozzle_mass: float | None = None
    retired: int | None = None
    retired_mass: float | None = None
    blocked: int | None = None

    @property
    def energy(self) -> float:
        """Total energy, J."""
        return self.kinetic + self.elastic + self.potential


class Ledger(list[LedgerRow]):
    """The rows of a run, one for each of T frames; `ledger["kinetic"]` is an array over them."""

    def __getitem__(self, key: Any) -> Any:
        """Return a row by its number, or by its name one quantity of all rows, (T, ...); InputError: there is none."""
        if not isinstance(key, str):
            return super().__getitem__(key)
        names = [one.name for one in fields(LedgerRow) if self and getattr(self[0], one.name) not in (None, ())]
        if key not in (*names, "energy"):
            hint = hint_at(key, names, f"it has {listed(names, 'and')}.")
            raise InputError(f'The ledger has no "{key}"; {hint}')
        return np.array([getattr(row, key) for row in self])
