"""What a scene cannot combine, and what a backend cannot compute."""

from mpmcli.errors import InputError
from mpmcli.scene.contact_table import MOST_FIELDS, ContactTable
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.machine.backend import Backend


def refusals(asked: Resolved, backend: Backend) -> list[str]:
    """Return a sentence for each thing of a scene that is not available beside another, or on a backend."""
    scene, layers, solver = asked.scene, asked.layers, asked.scene.solver
    free, moving = (any(getattr(one, word) for one in scene.colliders) for word in ("free", "driven"))
    total = solver.solids == "total"
    on_gpu, single, here = not backend.on_cpu, not backend.doubles, f"with --arch {backend.arch}"
    # What the scene has, with what it is not available, and the remedy.
    table = {
        ("separating bodies", layers.separate): (
            {
                here: single,
                "with solver.deterministic = true on a GPU": solver.deterministic and on_gpu,
                **{f"with {what}": applies for what, applies in ContactTable(scene).excluded.items() if "=" in what},
                f"for more than {MOST_FIELDS} bodies": layers.count > MOST_FIELDS,
            },
            'change this, or set contact.default = "stick" and omit the pairs',
        ),
        ("colliders with a density", free): (
            {
                here: single,
                "in a domain with periodic walls": any(scene.domain.periodic),
                "with moving walls": bool(scene.domain.wall_velocity),
            },
            "omit their density",
        ),
        ("moving colliders", moving): ({here: single}, "use --arch cpu"),
        ('several bodies with solver.solids = "total"', total and len(scene.sources) > 1): (
            {here: on_gpu},
            "use --arch cpu",
        ),
        ("sparse grids", solver.grid == "sparse"): ({here: on_gpu}, 'use --arch cpu, or solver.grid = "dense"'),
    }
    return [
        f"{what} are not available {reason}; {remedy}."
        for (what, present), (reasons, remedy) in table.items()
        for reason, applies in reasons.items()
        if present and applies
    ]


def require_possible(asked: Resolved, backend: Backend) -> None:
    """Raise an InputError that lists all `refusals` of a scene."""
    if found := refusals(asked, backend):
        raise InputError("\n".join(found))
