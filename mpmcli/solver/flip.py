"""FLIP's part of a step: what the nodes held before stress and forces, so that particles can take the change alone.

AFLIP (Fei et al. 2021) adds to APIC's velocity a share of what the transfers would lose of a particle's own,
v <- sum w v_i + flip (v - sum w v_i^before). C, positions and deformations follow the nodes. As positions do, and not
the particle's own velocity, angular momentum is kept to first order in the step only.
"""

import taichi as ti

from mpmcli.solver.transfer import gather


@ti.func
def settle_before(grid: ti.template(), index: int):
    """Turn the momentum from before into velocity, at a node that has mass and no wall near."""
    before = grid.before[index]
    for a in ti.static(range(grid.dimension)):
        before[a] /= grid.nodes[index][grid.dimension]
    grid.before[index] = before


@ti.func
def unseen_velocity(group: ti.template(), p: int, x: ti.template(), grid: ti.template()):
    """Return the share that particle p, at x, keeps of the velocity of its own that the nodes do not see."""
    before, _ = gather(x, grid, grid.before)
    kept = ti.Vector.zero(float, grid.dimension)
    for c in ti.static(range(grid.dimension)):
        kept[c] = grid.scheme.flip * (group.v[p][c] - before[c])
    return kept
