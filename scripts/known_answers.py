"""What the example scenes should give, and how far a result is from it, one function per scene.

Each takes an opened result and returns one phrase for the table of README.md.
"""

import math

import numpy as np

from mpmcli.output.result import Result

# Martin and Moyce (1952), n^2 = 2, a = 2.25 in, digitised from their figure 3: T = n t sqrt(g / a), Z = front / a.
MARTIN_MOYCE = (
    (0.832, 1.217), (1.219, 1.474), (1.997, 2.292), (2.547, 2.995), (3.345, 4.134), (4.034, 4.944), (4.418, 5.881),
)  # fmt: skip
# How much later than assumed the column may have been free to move, in T: the gate takes its time.
GATE = 0.3


def dam_break_2d(result: Result) -> str:
    """Compare the front Z(T) with the experiment, as it is and shifted by the largest delay that a gate may cause."""
    gravity, width = 9.81, 1.0
    # A particle stands for h/2 of the row along the floor.
    front = np.array([frame.position[:, 0].max() for frame in result.frames([])]) + result.header["spacing"] / 4
    T = math.sqrt(2 * gravity / width) * result.times
    T_exp, Z_exp = np.array([row for row in MARTIN_MOYCE if 1.0 <= row[0] <= 4.0]).T

    def error(shift: float) -> float:
        return 100 * float(np.mean(np.abs(np.interp(T_exp - shift, T, front / width) - Z_exp) / Z_exp))

    return (
        f"front ahead of the experiment by {error(0.0):.1f} % on average (T from 1 to 4, no shift of time; "
        f"{error(GATE):.1f} % with T shifted by {GATE})"
    )


def dam_break_3d(result: Result) -> str:
    """Say when the front has come within half a cell of the far wall, in units of sqrt(H / g)."""
    gravity, height = 9.81, 0.3
    front = np.array([frame.position[:, 0].max() for frame in result.frames([])])
    wall = result.header["origin"][0] + result.header["size"][0] - result.header["spacing"] / 2
    k = int(np.argmax(front >= wall))
    time = np.interp(wall, front[k - 1 : k + 1], result.times[k - 1 : k + 1])
    return f"front at the far wall at t √(g/H) = {time * math.sqrt(gravity / height):.2f}; experiments 2.4 to 2.6"


def elliptical_drop_2d(result: Result) -> str:
    """Compare every particle with the affine motion x = diag(a, 1/a) X of the incompressible drop at A0 t = 0.76."""
    k = int(np.argmin(np.abs(result.times - 0.76)))
    a = half_axis(float(result.times[k]))
    start, position = (result.frame(i, []).position.astype(np.float64) for i in (0, k))
    axes = 2 * np.sqrt(np.mean(position**2, axis=0)) / (2 * np.sqrt(np.mean(start**2, axis=0)))
    rms = math.sqrt(np.mean(np.sum((position - start * [a, 1 / a]) ** 2, axis=1)))
    return (
        f"half axes {percent(axes[0] / a - 1)} and {percent(axes[1] * a - 1)}, "
        f"RMS {rms:.1e} R, at A0 t = {result.times[k]:.2f}"
    )


def half_axis(time: float, steps: int = 1000) -> float:
    """Return the half axis a(t) of the drop, R = A0 = 1: da/dt = -a sqrt(2 / (a^2 + a^-2)), by Runge-Kutta 4."""

    def rate(a: float) -> float:
        return -a * math.sqrt(2 / (a**2 + a**-2))

    a, dt = 1.0, time / steps
    for _ in range(steps):
        k1 = rate(a)
        k2 = rate(a + dt / 2 * k1)
        k3 = rate(a + dt / 2 * k2)
        k4 = rate(a + dt * k3)
        a += dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return a


def jelly_drop(result: Result) -> str:
    """Compare the fall of the centre of mass with g t^2 / 2, at the last frame before any cell touches the floor."""
    gravity, reach = 9.81, 2 * result.header["spacing"]
    heights = []
    for frame in result.frames([]):
        if frame.position[:, -1].min() - result.header["origin"][-1] < reach:
            break
        heights.append(frame.position[:, -1].mean(dtype=np.float64))
    time = float(result.times[len(heights) - 1])
    error = (heights[0] - heights[-1]) / (gravity * time**2 / 2) - 1
    return f"fall of the centre of mass {percent(error)} of g t²/2 off at t = {time:.2f} s"


def percent(error: float) -> str:
    """Write a relative error; what rounds to zero has no minus sign."""
    return f"{round(100 * error, 2) + 0.0:+.2f} %"


KNOWN_ANSWERS = {
    "dam_break_2d": dam_break_2d,
    "dam_break_3d": dam_break_3d,
    "elliptical_drop_2d": elliptical_drop_2d,
    "jelly_drop_2d": jelly_drop,
    "jelly_drop_3d": jelly_drop,
}
