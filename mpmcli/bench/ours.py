"""The workers of mpmcli: the falling block, and a column of each law."""

from collections import Counter
from dataclasses import replace

import numpy as np

from mpmcli.bench.cases import BULK_MODULUS, CORNER, DENSITY, EDGE, GRAVITY, BenchCase
from mpmcli.errors import RunError
from mpmcli.materials.registry import laws, parameter_models
from mpmcli.scene import BodyParticles, estimate_particles, parse_scene
from mpmcli.scene.material import Knob, MaterialParameters

# Relative error of a step that results from dividing an interval into equal steps.
ROUND_OFF = 1e-6
# Parameters of the column by the names that laws share, so that a new law needs no entry. Strengths are well below the
# stress of the weight (up to 7 kPa) and of the impact (about 20 kPa), so that plastic laws flow.
VALUES = {
    "density": 1000.0,
    "youngs_modulus": 4e5,
    "poissons_ratio": 0.3,
    "bulk_modulus": 4e5,
    "yield_stress": 1e3,
    "consistency": 10.0,
    "friction_angle": 35.0,
}
# Gravity, m/s^2; initial downward speed, m/s; dv_x/dy, 1/s; edges, and height above the floor, in a unit box.
COLUMN_GRAVITY, COLUMN_SPEED, SHEAR = 9.81, 1.0, 10.0
EDGES = {2: (0.75, 0.75), 3: (0.25, 0.5, 0.25)}
CLEARANCE = 1 / 32
# Steps are at most a fifth of the stable step at rest, which leaves room for hardening and impact. There are 4 (2D) and
# 8 (3D) particles per cell, the default of scenes.
COLUMNS = (
    BenchCase(dimension=2, cells=128, particles=36_864, step=4e-5),
    BenchCase(dimension=3, cells=64, particles=65_536, step=1e-4),
)


def falling_block(case: BenchCase, precision: str = "f32") -> tuple[dict, list[BodyParticles]]:
    """Return the block of the peer as the dictionary of a scene file, and its particles, of equal volumes."""
    d = case.dimension
    body = {
        "name": "block",
        "material": {"law": "fluid", "density": DENSITY, "bulk_modulus": BULK_MODULUS},
        "shape": {"box": {"min": [CORNER] * d, "max": [CORNER + EDGE] * d}},
        "velocity": case.velocity().tolist(),
    }
    volume = EDGE**d / case.particles
    particles = BodyParticles(
        name="block",
        position=case.positions(),
        velocity=np.tile(case.velocity(), (case.particles, 1)),
        affine=np.zeros((case.particles, d, d)),
        volume=volume,
        mass=DENSITY * volume,
    )
    return case.scene(body, GRAVITY, precision), [particles]


def column(law: str, case: BenchCase) -> dict:
    """Return the dictionary of a scene file with a column of a law, which lands, shears and collapses."""
    d, edges = case.dimension, EDGES[case.dimension]
    lower = [CLEARANCE if axis == 1 else (1 - edge) / 2 for axis, edge in enumerate(edges)]
    body = {
        "name": law,
        "material": material_of(laws()[law].parameters),
        "shape": {"box": {"min": lower, "max": [c + s for c, s in zip(lower, edges, strict=True)]}},
        "velocity": [0.0, -COLUMN_SPEED, 0.0][:d],
        "velocity_gradient": [[SHEAR if (row, k) == (0, 1) else 0.0 for k in range(d)] for row in range(d)],
        "particles_per_cell": 2**d,
    }
    return case.scene(body, COLUMN_GRAVITY, "f32")


def material_of(model: type[MaterialParameters]) -> dict[str, object]:
    """Return the material of a law: VALUES, else the middle of knobs, else defaults; RunError if there is none."""
    law = model.model_fields["law"].default
    material: dict[str, object] = {"law": law}
    for name, field in model.model_fields.items():
        if name in VALUES:
            material[name] = VALUES[name]
        elif field.is_required() and name != "law":
            knob = next((entry for entry in field.metadata if isinstance(entry, Knob)), None)
            if knob is None:
                raise RunError(f'the law "{law}" needs {name}, which has no knob and no value in the benchmark')
            material[name] = knob.value(0.5)
    return material


class Ours:
    """A run of a scene as `mpmcli simulate` computes it."""

    def __init__(self, data: dict, particles: list[BodyParticles] | None, threads: int, arch: str = "cpu") -> None:
        """Build the scene on the device; `particles`, one entry per body, replace the sampling of the scene."""
        from mpmcli.solver.engine.batch import Batch
        from mpmcli.solver.engine.resolved import Resolved
        from mpmcli.solver.engine.run import Run
        from mpmcli.solver.machine.backend import choose_backend, start
        from mpmcli.solver.machine.costs import useful_threads

        scene = parse_scene(data, laws=parameter_models(), source=data["title"]).scene
        backend = choose_backend(arch, threads, scene.solver.precision, compile_cache=False)
        if backend.on_cpu:
            count = particles[0].count if particles else estimate_particles(scene)
            backend = replace(backend, threads=useful_threads(count, threads))
        start(backend)
        # Compile for automatic steps: with the short steps of a benchmark the kernels would keep motion.
        usual = scene.model_copy(update={"time": scene.time.model_copy(update={"step": "auto"})})
        asked = Resolved(usual, particles).sampled()
        batch = Batch(asked.kind.padded(), backend)
        self.run = Run(batch, 0, scene, asked.particles, force=particles is not None)
        self.threads, self.particles = backend.threads, self.run.particle_count
        self.step = self._smallest = data["time"]["step"]

    def advance(self, count: int) -> int:
        """Take about `count` steps and return their number."""
        steps, smallest = self.run.advance(count)
        self._smallest = min(self._smallest, smallest)
        return steps

    def sync(self) -> None:
        """Do nothing: each launch waits until its steps are done."""

    def positions(self) -> np.ndarray:
        """Return the positions of the particles, (particles, dimension), m, in their initial order."""
        return self.run.frame()[0].position

    def is_sound(self) -> bool:
        """Return whether every particle is in the domain and every step had the length of the case."""
        places = [group.arrays.x.to_numpy() for group in self.run.groups]
        inside = all(bool(((position >= 0) & (position <= 1)).all()) for position in places)
        return inside and self._smallest > (1 - ROUND_OFF) * self.step


def block_of_ours(case: BenchCase, threads: int, arch: str = "cpu", precision: str = "f32") -> Ours:
    """Return the worker of mpmcli for the block of the peer."""
    return Ours(*falling_block(case, precision), threads, arch)


class ProfiledColumn(Ours):
    """The column of a law, with phases that are launched and timed separately."""

    def __init__(self, law: str, case: BenchCase, threads: int) -> None:
        super().__init__(column(law, case), None, threads)
        self.run.batch.profile = Counter()

    def phases(self) -> dict[str, float]:
        """Return the time in each phase of the solver since the last call, s."""
        found = dict(self.run.batch.profile)
        self.run.batch.profile.clear()
        return found
