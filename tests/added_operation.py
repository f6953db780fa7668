"""An operation on particles and a field of them, see docs/architecture.md: each keeps its largest rate of strain."""

from mpmcli.boundaries.feature import Feature, Phase
from mpmcli.quick_taichi import ti
from mpmcli.solver.particles.columns import ParticleField, fields_of
from mpmcli.solver.particles.loop import Operation, Pass


@ti.func
def raised(_at: ti.template(), _p: int, _dt: float, C: ti.template(), marked: float):
    """Return the larger of the norm of the rate of strain of a particle, 1/s, and that which it kept."""
    return ti.max((0.5 * (C + C.transpose())).norm(), marked)


def fields_with_mark(group: object) -> tuple[ParticleField, ...]:
    """Return the fields of particles, and one for the largest rate of strain, 1/s."""
    return (*fields_of(group), ParticleField("marked", "marked", ()))


class Marker(Feature):
    """Marks particles with their largest rate of strain, 1/s."""

    def phases(self, **_how: bool) -> tuple[Phase, ...]:
        keep = Pass(raised, {"marked": ()}, in_lanes=True)
        mark = Operation(reads=("C", "marked"), passes=(keep,), writes=("marked",))
        return (Phase("mark", "particles", "gather", body=mark),)
