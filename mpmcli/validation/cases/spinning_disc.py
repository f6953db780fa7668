"""A rotating elastic disc, stretched by centrifugal forces: energy, angle and angular momentum after ten turns."""

import math

import numpy as np

from mpmcli.scene import Scene
from mpmcli.validation.case import Case, Frames, Tables, case_text
from mpmcli.validation.shared import ball, body, elastic, field, problem

RADIUS, YOUNG, POISSON, DENSITY, SPIN = 0.5, 1e6, 0.3, 1000.0, 5.0
TURNS, FRAMES_PER_TURN = 10, 8
# Half of the domain, m.
HALF = 0.75
# u_r = k ((3 - 2 nu) R^2 - r^2) r, k in 1/m^2, in plane strain.
STRETCH = (1 + POISSON) * (1 - 2 * POISSON) * DENSITY * SPIN**2 / (8 * YOUNG * (1 - POISSON))


class SpinningDisc(Case):
    """APIC transfers a rigid rotation, an affine motion, exactly; the stress holds the disc together and does no work.

    The initial F is I plus the gradient of the plane-strain displacement at the initial positions.
    """

    text = case_text("spinning_disc")
    name, title, group = "spinning_disc", "Spinning elastic disc", "invariants"
    varies = ("precision", "kernel", "transfer", "per_axis")
    levels = {"coarse": (4, 8), "default": (4, 8, 16), "fine": (4, 8, 16, 32)}  # noqa: RUF012
    measures = (
        text.measure("energy loss", lambda n: 1.4 * (9e-4 / n + 3e-5)),
        text.measure("angle error", lambda n: 1.4 * (7.8e-4 / n + 5e-6)),
        text.measure("angular momentum", 1e-13),
    )

    def tables(self, n: int) -> Tables:
        """Return a disc of n cells of radius that begins with the deformation of steady rotation."""
        k, R = STRETCH, RADIUS
        radial = f"1 + {k!r} * ({(3 - 2 * POISSON) * R**2!r} - X**2 - Y**2"
        cross = f"{-2 * k!r} * X * Y"
        disc = body(
            "disc",
            elastic("neo_hookean", DENSITY, YOUNG, POISSON),
            ball([0.0, 0.0], RADIUS),
            velocity_gradient=[[0.0, -SPIN], [SPIN, 0.0]],
            deformation=[[f"{radial} - 2 * X**2)", cross], [cross, f"{radial} - 2 * Y**2)"]],
        )
        domain = {"origin": [-HALF, -HALF], "size": [2 * HALF, 2 * HALF], "spacing": RADIUS / n}
        return problem(domain, (TURNS * 2 * math.pi / SPIN, TURNS * FRAMES_PER_TURN), "initial_position", [disc])

    def measure(self, n: int, scene: Scene, frames: Frames) -> dict[str, float]:
        """Return the energy lost, the error of the angle turned, and the change of angular momentum."""
        kinetic, momentum, turned, last = [], [], 0.0, 0.0
        for frame, row in frames:
            X = field(frame, "initial_position")
            x = frame.position.astype(np.float64)
            angle = math.atan2(float((X[:, 0] * x[:, 1] - X[:, 1] * x[:, 0]).sum()), float((X * x).sum()))
            turned += (angle - last) % (2 * math.pi) if frame.index else 0.0
            last = angle
            kinetic.append(row.kinetic)
            momentum.append(row.angular_momentum[0])
        return {
            "energy loss": 1 - kinetic[-1] / kinetic[0],
            "angle error": turned / (SPIN * frame.time) - 1,
            "angular momentum": momentum[-1] / momentum[0] - 1,
        }
