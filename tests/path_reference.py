"""What a recorded run of `path_run` is compared with: its particles as `mpm_reference` takes them, and its nodes."""

import mpm_reference as reference
import numpy as np

from mpmcli.scene import Scene, sample_bodies

Arrays = dict[str, np.ndarray]


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
