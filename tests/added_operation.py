"""An operation on particles in one file, as docs/architecture.md says: each remembers its largest rate of strain."""

from mpmcli.boundaries.feature import Feature, Phase
from mpmcli.quick_taichi import ti
from mpmcli.solver.particles.loop import Operation, Pass


@ti.func
def strain_rate(_at: ti.template(), _p: int, _dt: float, C: ti.template()):
    """Return the norm of the rate of strain of a particle, 1/s."""
    return (0.5 * (C + C.transpose())).norm()


@ti.func
def remember(at: ti.template(), p: int, _dt: float, rate: float):
    """Keep the largest rate of a particle, by its id, because sorts move particles."""
    own = at.w * ti.static(at.features.marker.count) + at.group.id[p]
    at.features.marker.largest[own] = ti.max(at.features.marker.largest[own], rate)


@ti.data_oriented
class Marker(Feature):
    """The largest rate of strain of `count` particles per run, 1/s."""

    def __init__(self, runs: int, count: int) -> None:
        self.count, self.largest = count, ti.field(float, shape=runs * count)

    def phases(self, **_how: bool) -> tuple[Phase, ...]:
        passes = (Pass(strain_rate, {"rate": ()}, in_lanes=True), Pass(remember))
        return (Phase("mark", "particles", "gather", body=Operation(reads=("C",), passes=passes)),)
