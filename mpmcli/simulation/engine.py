"""Chooses what computes a scene by the number of steps that the check forecasts."""

from mpmcli.check.facts import SceneFacts
from mpmcli.check.forecast import expected_steps
from mpmcli.scene import Scene
from mpmcli.solver.engine import build
from mpmcli.solver.machine.backend import Arch, Backend


def backend_for(
    scene: Scene, arch: Arch = "auto", threads: int | None = None, *, compile_cache: bool = True
) -> Backend:
    """Return the backend for a scene, not started; InputError: it cannot be used, or no step is stable."""
    return build.backend_for(
        scene, lambda: expected_steps(SceneFacts(scene)), arch, threads, compile_cache=compile_cache
    )
