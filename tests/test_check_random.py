"""The step that is safe throughout against the smallest one that a run takes, over random scenes."""

from collections.abc import Callable

import pytest
from random_drives import LAWS, random_scene

from mpmcli.check.facts import SceneFacts
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import Run, build_run, frames_of_all

# The predicted step may be this much larger than the smallest one taken.
OPTIMISTIC = 1.1


def test_safe_throughout_is_not_optimistic(backend_of: Callable) -> None:
    """Five blocks of one law that start deformed, moving, under gravity: in one batch."""
    scenes = [random_scene(seed, driven=False) for seed in range(2, 200, len(LAWS))]
    scenes = [scene for scene in scenes if scene.bodies[0].deformation is not None]
    # Walls of one kind, so that one kernel does.
    scenes = [scene for scene in scenes if scene.domain.walls == scenes[0].domain.walls][:5]
    kinds = [Resolved(scene).kind for scene in scenes]
    kind = kinds[0]
    for more in kinds[1:]:
        kind = kind.joined(more)
    batch = Batch(kind, backend_of("f32", 1), len(scenes))
    smallest = {}
    for k, event in frames_of_all({k: Run(batch, k, scene) for k, scene in enumerate(scenes)}):
        assert not isinstance(event, Exception)
        if event is not None:
            smallest[k] = event[1].step_min
    for k, scene in enumerate(scenes):
        assert SceneFacts(scene).step <= OPTIMISTIC * smallest[k], k


@pytest.mark.slow
def test_200_random_scenes_are_forecast(backend_of: Callable, record_property: Callable) -> None:
    """Every law, starts of any deformation, pulses of 10 us to 10 ms, forces from 3 mm wide: 99 % of 200."""
    above: list[tuple[int, float]] = []
    for seed in range(200):
        if seed % 25 == 0:
            # What was built on the one before is freed.
            backend = backend_of("f32", 1)
        scene = random_scene(seed)
        run = build_run(scene, backend)
        rows = [row for _, row in run.frames()]
        ratio = SceneFacts(scene).step / rows[-1].step_min
        if ratio > OPTIMISTIC:
            above.append((seed, ratio))
    record_property("above", above)
    assert len(above) <= 2, above
