"""Runs a scene of test_batch.py on software Vulkan as on a device without double precision; its own process.

`python single_precision_run.py NAME` prints the intermediate code of its kernels where TI_PRINT_IR is set.
"""

import sys
from dataclasses import fields

from test_batch import scene_named

from mpmcli.solver.engine.run import build_run
from mpmcli.solver.machine.backend import Backend, start_backend


class SinglePrecision(Backend):
    """A GPU without double precision."""

    on_cpu = False
    doubles = False


def in_single_precision(backend: Backend) -> SinglePrecision:
    """Return a backend that was started as one of a device without double precision."""
    return SinglePrecision(**{field.name: getattr(backend, field.name) for field in fields(backend)})


if __name__ == "__main__":
    run = build_run(scene_named(sys.argv[1]), in_single_precision(start_backend("vulkan", 1, compile_cache=False)))
    list(run.frames())
