"""What a scene may say of how it is computed: the table [solver]."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, ValidationInfo

from mpmcli.scene.quantity import Flag, Table, flaw

# Poisson's ratio above which bodies lock without `f_bar`: a bent beam of four cells is 5 % too stiff at 0.45, 13 % at
# 0.49.
NEARLY_INCOMPRESSIBLE = 0.45
# Default of FLIP's share in AFLIP: a twentieth of the loss of APIC.
USUAL_FLIP = 0.95


def _only_with_aflip(flip: float | None, info: ValidationInfo) -> float | None:
    """Fill in the share of FLIP where there is one, and refuse it where there is none."""
    # An invalid transfer has a message of its own, and is absent from the data.
    transfer = info.data.get("transfer", "aflip")
    if flip is not None and transfer != "aflip":
        raise flaw(f'is the share of FLIP in transfer = "aflip"; with transfer = "{transfer}" leave it out')
    return USUAL_FLIP if flip is None and transfer == "aflip" else flip


class SolverSettings(Table):
    """How the scene is computed. What is not chosen is not in the compiled step."""

    precision: Annotated[
        Literal["f32", "f64"], Field(description="Floating-point numbers of the solver: 32 or 64 bits.")
    ] = "f32"
    kernel: Annotated[
        Literal["quadratic", "cubic"],
        Field(
            description='B-spline between particles and nodes. "quadratic" reaches 3 nodes per axis. "cubic" reaches '
            "4: smoother, and stable at steps 1.15 times as long, but waves are 1.4 times further off and lose twice "
            "as much in a step, for 16/9 of the work on nodes in 2D, 64/27 in 3D."
        ),
    ] = "quadratic"
    transfer: Annotated[
        Literal["apic", "pic", "aflip"],
        Field(
            description='What particles hand to the nodes and take back. "apic": velocity and its gradient, which '
            'keeps angular momentum exactly. "pic": the velocity alone; the dissipative reference, at 0.71 of the '
            'step. "aflip": APIC with FLIP\'s velocities: waves and splashes lose far less, fast rotation more, and '
            "angular momentum is kept to first order in the step only; twice the memory of the grid, and some noise."
        ),
    ] = "apic"
    flip: Annotated[
        float | None,
        Field(
            strict=True,
            ge=0,
            le=1,
            description='With transfer = "aflip": share of a particle\'s velocity that is its own, changed by what '
            "changes the nodes; the rest is APIC's, which damps what the grid does not see. 0 is APIC, 1 damps "
            f"nothing. Default: {USUAL_FLIP:g}.",
        ),
        AfterValidator(_only_with_aflip),
        Field(validate_default=True),
    ] = None
    solids: Annotated[
        Literal["updated", "total"],
        Field(
            description='Grid of elastic solids. "updated": that of all materials. "total": of their state at rest '
            "(total Lagrangian): more accurate, without tears; for scenes of one elastic law, whose bodies begin apart."
        ),
    ] = "updated"
    f_bar: Annotated[
        Flag | Literal["auto"],
        Field(
            description="Whether particles of a cell share their change of volume (F-bar), so that material that "
            'hardly changes its volume does not lock. "auto": those of laws of which a body has a Poisson\'s ratio of '
            f"more than {NEARLY_INCOMPRESSIBLE:g}, and does not flow."
        ),
    ] = "auto"
    walls: Annotated[
        Literal["folded", "zeroed"],
        Field(
            description='How walls act. "folded" mirrors what lies behind them: second-order accurate. "zeroed" sets '
            "the velocity of nodes on and behind them to zero, as is usual: first-order, to compare with."
        ),
    ] = "folded"
    grid: Annotated[
        Literal["auto", "dense", "sparse"],
        Field(
            description='Nodes of the background grid. "dense": all of the domain. "sparse": those near particles, in '
            'blocks, on the CPU; for large domains that are nearly empty. "auto": sparse where a domain has at least '
            "8 million cells and material fills at most a twentieth of them."
        ),
    ] = "auto"
    deterministic: Annotated[
        Flag,
        Field(
            description="Whether a GPU adds in fixed point, so that two runs have the same bytes. On the CPU they have "
            "them in any case, and nothing changes."
        ),
    ] = False
