"""What the example scenes should give, and how far a result is from it, one function per scene.

Each takes an opened result and returns one phrase for the table of docs/scenes.md.
"""

import math

import numpy as np

from mpmcli.output.result import Result
from mpmcli.validation.cases.dam_break import FILM, IMPACT, N_SQUARED, impact, mean_error, measured, water_height
from mpmcli.validation.cases.dam_break import measured_gauges as gauges
from mpmcli.validation.cases.elliptical_drop import half_axis

# How much later than assumed the column may have been free to move, in T: the gate takes its time.
GATE = 0.3


def dam_break_2d(result: Result) -> str:
    """Compare the front Z(T) with the experiment, as it is and shifted by the largest delay that a gate may cause."""
    gravity, width = 9.81, 1.0
    # A particle stands for h/2 of the row along the floor.
    front = np.array([frame.position[:, 0].max() for frame in result.frames([])]) + result.header.spacing / 4
    T = math.sqrt(N_SQUARED * gravity / width) * result.times
    larger = measured("front")[0]
    as_it_is, shifted = (100 * mean_error(larger, T, front / width, shift) for shift in (0.0, GATE))
    return (
        f"front ahead of the experiment by {as_it_is:.1f} % on average (T from 1 to 4, no shift of time; "
        f"{shifted:.1f} % with T shifted by {GATE})"
    )


def dam_break_3d(result: Result) -> str:
    """Say when the front has come within half a cell of the far wall, in units of sqrt(H / g)."""
    gravity, height = 9.81, 0.3
    front = np.array([frame.position[:, 0].max() for frame in result.frames([])])
    wall = result.header.upper[0] - result.header.spacing / 2
    k = int(np.argmax(front >= wall))
    time = np.interp(wall, front[k - 1 : k + 1], result.times[k - 1 : k + 1])
    return f"front at the far wall at t √(g/H) = {time * math.sqrt(gravity / height):.2f}; experiments 2.4 to 2.6"


def dam_break_obstacle_3d(result: Result) -> str:
    """Say when the front of 99.9 % of the water is at the box, and compare heights with those of three gauges."""
    water = result.header.bodies[0]
    places = [frame.position.astype(np.float64) for frame in result.frames([])]
    volume = result.ledger[0].mass / water.density / len(places[0])
    time = impact(result.times, np.array([np.quantile(place[:, 0], FILM) for place in places]))
    errors = []
    for name in ("H2", "H3", "H4"):
        gauge = gauges()[name]
        heights = np.array([water_height(place, gauge.x, volume) for place in places])
        errors.append(f"{100 * gauge.mean_error(result.times, heights, 1.1):.0f}")
    return (
        f"front at the box at t = {time:.2f} s, measured {IMPACT:.2f}; heights at the gauges H2, H3 and H4 "
        f"{', '.join(errors[:-1])} and {errors[-1]} % off on average, up to 1.1 s"
    )


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


def falling(result: Result) -> str:
    """Compare the fall of the centre of mass with g t^2 / 2, at the last frame before any cell touches the floor."""
    gravity, reach = 9.81, 2 * result.header.spacing
    heights = []
    for frame in result.frames([]):
        if frame.position[:, -1].min() - result.header.origin[-1] < reach:
            break
        heights.append(frame.position[:, -1].mean(dtype=np.float64))
    time = float(result.times[len(heights) - 1])
    error = (heights[0] - heights[-1]) / (gravity * time**2 / 2) - 1
    return f"fall of the centre of mass {percent(error)} of g t²/2 off at t = {time:.2f} s"


def block_slide_2d(result: Result) -> str:
    """Compare how far the block slides with v^2 / (2 mu g)."""
    place = [frame.position[:, 0].mean(dtype=np.float64) for frame in result.frames([])]
    distance, expected = place[-1] - place[0], 2.0**2 / (2 * 0.4 * 9.81)
    return f"slides {distance:.3f} m, {percent(distance / expected - 1)} off v²/(2 μ g)"


def stack_2d(result: Result) -> str:
    """Compare the flight of the ball with its parabola, and say how far the blocks of the tower end apart."""
    frame = next(frame for frame in result.frames([]) if frame.time >= 0.22)
    ball = frame.position[frame.body == 5].mean(axis=0, dtype=np.float64)
    flown = np.array([4.0, 2.0]) * frame.time - [0.0, 9.81 * frame.time**2 / 2]
    error = np.abs(ball - [0.4, 0.6] - flown).max() / np.linalg.norm(flown)
    last = result.frame(len(result.times) - 1)
    places = [last.position[last.body == k, 0].mean(dtype=np.float64) for k in range(5)]
    return f"flight of the ball {percent(error)} off; the blocks end {max(places) - min(places):.2f} m apart"


def rafts_2d(result: Result) -> str:
    """Compare what carries the bodies that float in the last second with their weights."""
    force = np.mean([np.array(row.collider_force)[:3, 1] for row in result.ledger[-30:]], axis=0)
    shares = force / [9.81 * collider.moments.mass for collider in result.colliders[:3]]
    return f"what carries those that float, over their weights: {', '.join(f'{share:.3f}' for share in shares)}"


def paddle_wheel_2d(result: Result) -> str:
    """Compare the mean torque of the water in the second half, less what speeds the wheel up, with the brake's."""
    first, *rows = result.ledger[len(result.ledger) // 2 :]
    (inertia,) = result.colliders[0].moments.inertia.ravel()
    gained = inertia * (rows[-1].rigid_motion[0][2] - first.rigid_motion[0][2]) / (rows[-1].time - first.time)
    torque = np.mean([row.collider_torque[0] for row in rows])
    return f"mean torque of the water {torque - gained:.1f} N m, that of the brake 60 N m"


def crater_3d(result: Result) -> str:
    """Compare how deep the ball lies in the end with what balls dropped into grains do."""
    rows, ball, bed = result.ledger, result.colliders[0], 0.12
    heights = [row.rigid_pose[0][2] - 0.05 - bed for row in (rows[0], rows[-1])]
    fallen = 2.5**2 / (2 * 9.81) + heights[0] - heights[1]
    # The tangent of the angle of repose is the sine of the friction angle.
    asked = 0.14 / math.sin(math.radians(35)) * math.sqrt(ball.density / 1600) * 0.1 ** (2 / 3) * fallen ** (1 / 3)
    return f"ball {-heights[1]:.4f} m deep; balls dropped into grains (Uehara et al. 2003) {asked:.4f}"


def billiard_2d(result: Result) -> str:
    """Say how far the momentum is off before a ball is at a cushion."""
    low, high = (corner + side * result.header.spacing for corner, side in ((0.0, 1), (result.header.upper, -1)))
    errors, first = [], np.array(result.ledger[0].linear_momentum)
    for frame, row in zip(result.frames([]), result.ledger, strict=True):
        if (frame.position < low).any() or (frame.position > high).any():
            break
        errors.append(np.abs(np.array(row.linear_momentum) - first).max() / first.max())
    return f"momentum {max(errors):.0e} off until a ball is at a cushion, at t = {frame.time:.2f} s"


def soft_grains_2d(result: Result) -> str:
    """Say how far the momentum is off, relative to the sum of the momenta of the grains."""
    first, frame = np.array(result.ledger[0].linear_momentum), result.frame(0)
    drift = max(np.abs(np.array(row.linear_momentum) - first).max() for row in result.ledger)
    speed = np.linalg.norm(frame.velocity, axis=1).mean()
    return f"momentum {drift / (result.ledger[0].mass * speed):.0e} off"


def rolling_3d(result: Result) -> str:
    """Compare how far the balls come with 5/7 g sin a t^2 / 2 and g sin a t^2 / 2."""
    first, last = result.frame(0), result.frame(len(result.times) - 1)
    said = []
    for k, share in enumerate((5 / 7, 1.0)):
        way = [frame.position[frame.body == k, 0].mean(dtype=np.float64) for frame in (first, last)]
        expected = share * 2.539 * last.time**2 / 2
        said.append(percent((way[1] - way[0]) / expected - 1))
    return f"way of a rigid ball that rolls {said[0]} off, of one that slides {said[1]}"


def couette_2d(result: Result) -> str:
    """Compare the velocity with the series at four times: see `mpmcli.validation.cases.channel`."""
    width, speed, viscosity, n = 0.1, 0.1, 0.01, np.arange(1, 100)
    errors = []
    for k in (5, 10, 25, 100):
        frame, row = result.frame(k), result.ledger[k]
        y = frame.position[:, 1].astype(np.float64) / width
        fading = np.exp(-viscosity * (n * np.pi / width) ** 2 * (row.time - row.step_max / 2))
        exact = speed * (y + np.sin(y[:, None] * n * np.pi) @ (2 / (n * np.pi) * (-1.0) ** n * fading))
        errors.append(float(np.sqrt(((frame.velocity[:, 0] - exact) ** 2).mean())) / speed)
    said = ", ".join(f"{error:.1e}" for error in errors)
    return f"RMS of the velocity off the series {said} U at 0.05, 0.1, 0.25 and 1 s"


def rubber_bounce_2d(result: Result) -> str:
    """Say how high the centre of the ball comes after each bounce, beside how it falls."""
    radius = 0.15
    height = np.array([frame.position[:, 1].mean(dtype=np.float64) for frame in result.frames([])]) - radius
    tops = [k for k in range(1, len(height) - 1) if height[k - 1] < height[k] >= height[k + 1]]
    shares = ", ".join(f"{100 * height[k] / height[0]:.0f}" for k in tops)
    return f"{falling(result)}; bounces to {shares} % of the height"


def snowball_wall(result: Result) -> str:
    """Compare the flight with v t + g t^2 / 2 up to the wall, and say how much of the snow ends on the wall."""
    spacing, wall = result.header.spacing, result.header.upper[0]
    first = result.frame(0, [])
    start, velocity = (array.mean(axis=0, dtype=np.float64) for array in (first.position, first.velocity))
    k = 0
    while result.frame(k + 1, []).position[:, 0].max() < wall - 2 * spacing:
        k += 1
    time = float(result.times[k])
    fall = np.zeros(result.dimension)
    fall[-1] = 9.81 * time**2 / 2
    flight = result.frame(k, []).position.mean(axis=0, dtype=np.float64) - start
    error = np.linalg.norm(flight - (velocity * time - fall)) / np.linalg.norm(flight)
    # The patch on the wall is thinner than a quarter of the ball.
    stays = np.mean(result.frame(result.frame_count - 1, []).position[:, 0] > wall - 0.025)
    return f"flight to the wall {percent(error)} off; {100 * stays:.0f} % of the snow ends on the wall"


def sand_column_2d(result: Result) -> str:
    """Compare run-out and height with Lube et al. (2005), and with the band of experiments and continuum models."""
    front, height = heap(result, np.zeros(1), 0.2)
    return (
        f"run-out {front:.2f} L0, height {height:.2f} L0; experiments 2.4 and 1.32, "
        "with continuum models 2.4 to 3.6 and 0.8 to 1.7"
    )


def sand_column_3d(result: Result) -> str:
    """Compare run-out and height with Lajeunesse et al. (2004) and Lube et al. (2004)."""
    front, height = heap(result, np.array([0.32, 0.32]), 0.1)
    return f"run-out {front:.2f} R0, height {height:.2f} R0; experiments 1.0 to 1.24 and 0.74 to 0.88"


def heap(result: Result, axis: np.ndarray, length: float) -> tuple[float, float]:
    """Return how far a heap has run out of a column of half width `length`, 99 % of it, and its height, in lengths."""
    position = result.frame(result.frame_count - 1, []).position
    reach = result.header.spacing / 4
    distance = np.linalg.norm(position[:, :-1] - axis, axis=1)
    return (float(np.quantile(distance, 0.99)) + reach) / length - 1, (float(position[:, -1].max()) + reach) / length


def lava_slope_2d(result: Result) -> str:
    """Compare the thickness of the middle third of the layer with yield_stress / (density g sin(slope))."""
    lava = material(result)
    downhill = abs(result.header.gravity[0])
    position = result.frame(result.frame_count - 1, []).position[:, 0]
    low, high = position.min(), position.max()
    third = (high - low) / 3
    area = result.ledger[0].mass / lava["density"]
    thickness = area * np.mean((position > low + third) & (position < high - third)) / third
    known = lava["yield_stress"] / (lava["density"] * downhill)
    return (
        f"final layer {100 * thickness:.1f} cm thick, {percent(thickness / known - 1)} off "
        f"yield_stress / (density g sin(slope)) = {100 * known:.1f} cm"
    )


def mud_slump_2d(result: Result) -> str:
    """Compare the half width of the heap with that of the parabola h^2 = 2 yield_stress (L - |x|) / (density g)."""
    mud = material(result)
    position = result.frame(result.frame_count - 1, []).position
    half_width = (np.ptp(position[:, 0]) + result.header.spacing / 2) / 2
    height = position[:, 1].max() + result.header.spacing / 4
    length = mud["yield_stress"] / (mud["density"] * 9.81)
    area = result.ledger[0].mass / mud["density"]
    known = (0.75 * area / math.sqrt(2 * length)) ** (2 / 3)
    return (
        f"half width {100 * half_width:.1f} cm, height {100 * height:.1f} cm; "
        f"a thin heap at rest {100 * known:.1f} and {100 * math.sqrt(2 * length * known):.1f}"
    )


def clay_drop_2d(result: Result) -> str:
    """Say how much of the energy that went is plastic work, and how much the height changes once all is at rest."""
    k = result.frame_count // 2
    heights = [result.frame(i, []).position[:, 1].max() for i in (k, result.frame_count - 1)]
    change = percent(heights[1] / heights[0] - 1)
    return f"{plastic_share(result)}; height {change} in the second half of the time"


def metal_impact_2d(result: Result) -> str:
    """Compare the final length with the formulas of Taylor (1948) and of Wilkins and Guinan (1973).

    Both take one flow stress: here the mean over the plastic strain of the whole rod, times 2/sqrt(3) in plane strain.
    """
    metal, speed = material(result), 200.0
    reach = result.header.spacing / 2
    first, last = (np.ptp(result.frame(k, []).position[:, 1]) + reach for k in (0, result.frame_count - 1))
    strain = result.frame(result.frame_count - 1).fields["plastic_strain"].astype(np.float64)
    flow_stress = 2 / math.sqrt(3) * plastic_work(metal, strain).sum() / strain.sum()
    load = metal["density"] * speed**2 / flow_stress
    # Wilkins and Guinan: the plastic front stays where it is, at 0.12 of the length.
    wilkins = 0.12 + 0.88 * math.exp(-load / 2)
    return (
        f"{plastic_share(result)}; final length {last / first:.3f} L0, by the formulas for its mean flow stress, "
        f"{flow_stress / 1e6:.0f} MPa, {taylor_length(load):.3f} (Taylor) and {wilkins:.3f} (Wilkins and Guinan)"
    )


def taylor_length(load: float, steps: int = 1000) -> float:
    """Return the final length over the first of a rigid, perfectly plastic rod, load = density v^2 / yield stress.

    At the plastic front the section grows from 1 to 1/(1 - e), with density v^2 / yield stress = e^2 / (1 - e).
    The part that is still rigid is slowed down by the yield stress, and loses a length dx, of which (1 - e) dx is
    left, with d ln x = (2 - e) / (2 (1 - e)^2) de.
    """
    highest = (math.sqrt(load**2 + 4 * load) - load) / 2
    rigid, left = 1.0, 0.0
    for k in range(steps, 0, -1):
        e = highest * (k - 0.5) / steps
        shorter = rigid * math.exp(-(2 - e) / (2 * (1 - e) ** 2) * highest / steps)
        left += (1 - e) * (rigid - shorter)
        rigid = shorter
    return rigid + left


def plastic_share(result: Result) -> str:
    """Say how much of the energy that went is plastic work."""
    frame = result.frame(result.frame_count - 1)
    strain = frame.fields["plastic_strain"].astype(np.float64)
    bodies = result.header.bodies
    # All bodies have one density and as many particles per cell, so that every particle has the same volume.
    volume = result.ledger[0].mass / bodies[0].density / len(strain)
    work = sum(volume * plastic_work(body.material, strain[frame.body == k]).sum() for k, body in enumerate(bodies))
    went = result.ledger[0].energy - result.ledger[-1].energy
    return f"{100 * work / went:.1f} % of the energy that went is plastic work"


def plastic_work(metal: dict, strain: np.ndarray) -> np.ndarray:
    """Return the work per volume of a plastic strain, J/m^3."""
    return metal["yield_stress"] * strain + metal["hardening_modulus"] * strain**2 / 2


def material(result: Result) -> dict:
    """Return the parameters of the first body, every default and knob filled in."""
    return result.header.bodies[0].material


def stirred_tank_2d(result: Result) -> str:
    """Compare the centre of mass with linear theory for a tank that is shaken by A sin(w t) at its lowest frequency.

    By linear potential theory the first mode, eta = q cos(pi x / L), begins at rest and obeys
    q'' + w^2 q = -(4 L w^2 / (g pi^2)) A sin(w t), and the centre of mass lies -(2 L / (pi^2 d)) q off the middle.
    """
    length, depth, gravity, shaking, w = 1.0, 0.4, 9.81, 0.3, 5.12
    off = np.array([frame.position[:, 0].mean(dtype=np.float64) for frame in result.frames([])]) - length / 2
    t = result.times
    swing = (np.sin(w * t) - w * t * np.cos(w * t)) / (2 * w**2)
    theory = (2 * length / (np.pi**2 * depth)) * (4 * length * w**2 * shaking / (gravity * np.pi**2)) * swing
    return (
        f"swings {off @ theory / (theory @ theory):.2f} times as far as linear theory, "
        f"correlation {np.corrcoef(off, theory)[0, 1]:.3f}"
    )


def fountain_2d(result: Result) -> str:
    """Compare the way up of the jet's middle with v_y^2 / (2 g), and what came out with the area times the speed."""
    (along, up), gravity, mouth, width, density = (1.0, 4.0), 9.81, 0.21, 0.1, 1000.0
    k = int(np.argmin(np.abs(result.times - 0.6)))
    frame = result.present_frame(k, [])
    jet = frame.position[frame.body == 1]
    # The parabola is widest around its middle: of its upper edge and its lower edge there, both are as far off.
    near = np.abs(jet[:, 0] - (0.4 + along * up / gravity)) < 0.02
    rise = 0.5 * float(jet[near, 1].max() + jet[near, 1].min()) - mouth
    last = result.ledger[-1]
    flow = last.emitted_mass / (density * width * float(np.hypot(along, up)) * last.time) - 1
    return (
        f"rises {rise:.3f} m, {percent(rise / (up**2 / (2 * gravity)) - 1)} off v_y²/(2 g); "
        f"flow {percent(flow)} off area times speed"
    )


def kept_out(result: Result) -> str:
    """Say how deep the deepest particle of all frames lies in a collider, in cells."""
    deepest = max(
        float(-collider.signed_distance(frame.position.astype(np.float64), frame.time).min())
        for frame in result.frames([])
        for collider in result.colliders
    )
    return f"deepest particle {max(0.0, deepest) / result.header.spacing:.2f} cells inside of a collider"


def percent(error: float) -> str:
    """Write a relative error; what rounds to zero has no minus sign."""
    return f"{round(100 * error, 2) + 0.0:+.2f} %"


KNOWN_ANSWERS = {
    "dam_break_2d": dam_break_2d,
    "dam_break_3d": dam_break_3d,
    "dam_break_obstacle_3d": dam_break_obstacle_3d,
    "elliptical_drop_2d": elliptical_drop_2d,
    "fountain_2d": fountain_2d,
    "honey_coil_2d": falling,
    "lava_slope_2d": lava_slope_2d,
    "mud_slump_2d": mud_slump_2d,
    "jelly_drop_2d": falling,
    "jelly_drop_3d": falling,
    "jelly_stack_3d": falling,
    "mesh_drop_3d": falling,
    "block_slide_2d": block_slide_2d,
    "couette_2d": couette_2d,
    "rubber_bounce_2d": rubber_bounce_2d,
    "stack_2d": stack_2d,
    "rolling_3d": rolling_3d,
    "billiard_2d": billiard_2d,
    "soft_grains_2d": soft_grains_2d,
    "snowball_wall_2d": snowball_wall,
    "snowball_wall_3d": snowball_wall,
    "sand_column_2d": sand_column_2d,
    "sand_column_3d": sand_column_3d,
    "clay_drop_2d": clay_drop_2d,
    "metal_impact_2d": metal_impact_2d,
    "mixed_2d": falling,
    "stirred_tank_2d": stirred_tank_2d,
    "shaken_tank_2d": kept_out,
    "mixer_2d": kept_out,
    "hourglass_2d": kept_out,
    "sand_obstacles_2d": kept_out,
    "silo_3d": kept_out,
    "rafts_2d": rafts_2d,
    "paddle_wheel_2d": paddle_wheel_2d,
    "crater_3d": crater_3d,
}
