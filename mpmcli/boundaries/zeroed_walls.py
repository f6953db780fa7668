"""The walls of the domain in the usual way: velocities of nodes on and behind them are set to zero.

It is first-order accurate, where the folded walls of `boundaries.walls` are second-order (verification: 0.1), and there
to be compared with.
"""

from collections.abc import Sequence

import taichi as ti


@ti.data_oriented
class ZeroedWalls:
    """All faces of the domain, as `walls.Walls`: slip and separate stop the normal velocity, stick all of it.

    A separating face stops only what moves into it. None of them has to know first what presses on it.
    """

    separating = ()

    def __init__(self, faces: Sequence[tuple[str, str]], first: int, cells: Sequence[int], shape: Sequence[int]):
        self.dimension = len(faces)
        self.faces = tuple(tuple(pair) for pair in faces)
        self.first = first
        self.last = tuple(first + n for n in cells)
        self.shape = tuple(shape)

    @ti.func
    def near(self, node: ti.template()):
        """Return whether the node is on or behind any wall."""
        stopped = False
        for a in ti.static(range(self.dimension)):
            stopped = stopped or node[a] <= self.first or node[a] >= self.last[a]
        return stopped

    @ti.func
    def update(self, grid: ti.template(), node: ti.template(), gravity_step: ti.template()):
        """Turn momentum into velocity, with gravity and the walls, at a node that is near one; return True: it did.

        What nodes hold from before stress and forces is not stopped: FLIP's change is that by the wall, too.
        """
        d = ti.static(self.dimension)
        index = grid.linear_index(node)
        value = grid.nodes[index]
        mass = value[d]
        if mass > 0:
            for a in ti.static(range(d)):
                value[a] = value[a] / mass + gravity_step[a]
            for a in ti.static(range(d)):
                if node[a] <= self.first:
                    value = self.stopped(value, a, 0)
                if node[a] >= self.last[a]:
                    value = self.stopped(value, a, 1)
            grid.nodes[index] = value
            if ti.static(grid.scheme.keeps_before):
                grid.before[index] = grid.before[index] / mass
        return True

    @ti.func
    def stopped(self, velocity: ti.template(), axis: ti.template(), side: ti.template()):
        """Return the velocity at a node on or behind the lower (side 0) or the upper (1) face of an axis."""
        result = velocity
        for c in ti.static(range(self.dimension)):
            if ti.static(self.faces[axis][side] == "stick" or (self.faces[axis][side] == "slip" and c == axis)):
                result[c] = 0.0
            elif ti.static(c == axis):
                outward = velocity[c] if ti.static(side == 1) else -velocity[c]
                if outward > 0:
                    result[c] = 0.0
        return result
