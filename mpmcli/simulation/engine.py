"""Chooses what computes a scene by the number of steps that the check forecasts."""

from mpmcli.check.facts import SceneFacts
from mpmcli.check.forecast import expected_steps
from mpmcli.scene import Scene
from mpmcli.solver import engine
from mpmcli.solver.backend import Arch, Backend


def choose_engine(
    scene: Scene, arch: Arch = "auto", threads: int | None = None, *, compile_cache: bool = True
) -> tuple[Backend, bool]:
    """Return the backend for a scene, not started, and whether a batch runs it; see `mpmcli.solver.engine`.

    Raises:
        InputError: the backend cannot be used, or no step of the scene is stable.
    """
    return engine.choose_engine(
        scene, lambda: expected_steps(SceneFacts(scene)), arch, threads, compile_cache=compile_cache
    )
