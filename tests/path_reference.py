"""What a recorded run of `path_run` is compared with: its particles as `mpm_reference` takes them, and its nodes."""

import mpm_reference as reference
import numpy as np
import path_run
from rounding import OF_A_STEP

from mpmcli.scene import Scene, sample_bodies
from mpmcli.solver.transfer.splines import PAD

Arrays = dict[str, np.ndarray]
# Round-off of a step relative to the largest value of each array.
TOLERANCE = {"f32": OF_A_STEP, "f64": 1e-12}


def reference_groups(scene: Scene, arrays: Arrays, k: int) -> list[reference.Particles]:
    """Return the stored state before step k as the reference takes it, the groups in the solver's order."""
    groups = []
    for law in sorted({body.material.law for body in scene.bodies}):
        bodies = [(b, s) for b, s in zip(scene.bodies, sample_bodies(scene), strict=True) if b.material.law == law]
        counts = [sample.count for _, sample in bodies]

        def per_particle(values: list[float], counts: list[int] = counts) -> np.ndarray:
            return np.repeat(values, counts)

        materials = [body.material for body, _ in bodies]
        if law == "fluid":
            stress = reference.fluid_stress(per_particle([m.bulk_modulus for m in materials]), scene.dimension)
        else:
            E = per_particle([m.youngs_modulus for m in materials])
            nu = per_particle([m.poissons_ratio for m in materials])
            stress = reference.neo_hookean_stress(E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu)))
        x, v, C, deformation = (
            arrays[f"{k}_{law}_{name}"].astype(np.float64) for name in ("x", "v", "C", "deformation")
        )
        if law == "fluid":
            # The step begins by forgetting what a fluid without suction was opened by.
            deformation = np.minimum(
                deformation, per_particle([1.0 if m.tension_cutoff else np.inf for m in materials])
            )
        mass = per_particle([sample.mass for _, sample in bodies])
        volume = per_particle([sample.volume for _, sample in bodies])
        kept = per_particle(arrays[f"{k}_{law}_kept"].tolist())
        groups.append(reference.Particles(x, v, C, deformation, mass, volume, stress, kept))
    return groups


def check_nodes(
    nodes: np.ndarray, momentum: np.ndarray, mass: np.ndarray, velocity: np.ndarray, fall: np.ndarray, tolerance: float
) -> None:
    """Compare the momentum and the mass that P2G left, where no wall folds, and every node's velocity.

    `fall` is what gravity has added to the velocity in the step.
    """
    free = np.zeros(mass.shape, bool)
    away = 2 * reference.MARGIN + 1
    free[tuple(slice(away, -away) for _ in mass.shape)] = True
    loaded = free & (mass > 0)
    scattered = nodes[loaded][:, -1:] * (nodes[loaded][:, :-1].astype(np.float64) - fall)
    assert np.abs(nodes[loaded][:, -1] - mass[loaded]).max() < tolerance * mass.max()
    assert np.abs(scattered - momentum[loaded]).max() < tolerance * np.abs(momentum).max()
    # The velocity of a node with next to no mass is a quotient of round-off: weigh it by its mass.
    weight = mass / mass.max()
    moving = np.abs(velocity).max()
    at = mass > 0
    assert (weight[at][:, None] * np.abs(nodes[at][:, :-1] - velocity[at])).max() < tolerance * moving


# Paths that agree to the last bit start a step from the same state, and need its answer only once.
_answers: dict[bytes, tuple[np.ndarray, np.ndarray, np.ndarray, list[reference.Particles]]] = {}


def reference_step(
    groups: list[reference.Particles], box: reference.Box, dt: float, kick: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[reference.Particles]]:
    """Return node momentum, mass and velocity, and the particles after the step."""
    key = b"".join(a.tobytes() for g in groups for a in (g.x, g.v, g.C, g.deformation, np.asarray(g.kept)))
    key += box.kernel.encode()
    if key not in _answers:
        momentum, mass = reference.scatter(groups, box, kick)
        velocity, before = reference.update_both(momentum, mass, *reference.scatter_kept(groups, box), box, kick)
        _answers[key] = (momentum, mass, velocity, reference.gather(groups, velocity, box, dt, before, kick))
    return _answers[key]


def check_steps(scene: Scene, arrays: Arrays, tolerance: float) -> None:
    """Compare the nodes and the particles of every recorded step with the reference."""
    gravity = np.array(scene.domain.gravity)
    faces = scene.domain.walls.faces(scene.dimension)
    box = reference.Box(scene.domain.cells, scene.domain.spacing, gravity, faces, kernel=scene.solver.kernel)
    laws = sorted({body.material.law for body in scene.bodies})
    inside = tuple(slice(PAD - reference.MARGIN, PAD + n + 1 + reference.MARGIN) for n in box.cells)
    for k in range(path_run.RECORDED):
        groups = reference_groups(scene, arrays, k)
        # Leapfrog: the first step brings the velocities to its middle, every further one to the next middle.
        kick = path_run.STEP * (0.5 if k == 0 else 1.0)
        momentum, mass, velocity, expected = reference_step(groups, box, path_run.STEP, kick)
        fastest = np.abs(velocity).max()
        for law, group in zip(laws, expected, strict=True):
            # C is (4/h) times differences of velocities, so their round-off is its measure.
            scales = {"x": group.x.max(), "v": fastest, "C": 4 / box.spacing * fastest, "deformation": 1.0}
            for name, scale in scales.items():
                error = np.abs(arrays[f"{k + 1}_{law}_{name}"] - getattr(group, name)).max() / scale
                assert error < tolerance, f"step {k}, {law} {name}: {error:.2e}"
        nodes = arrays[f"{k}_nodes"][inside]
        check_nodes(nodes, momentum, mass, velocity, kick * box.gravity, tolerance)
