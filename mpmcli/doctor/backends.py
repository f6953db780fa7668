"""Examines the backends of Taichi by starting them."""

import importlib.metadata

from mpmcli.doctor.probe_result import ProbeResult
from mpmcli.plain_text import counted


def cpu() -> ProbeResult:
    """Examine the CPU backend, which is required."""
    from mpmcli.solver.trial import try_backend

    started = try_backend("cpu")
    version = importlib.metadata.version("taichi")
    return ProbeResult("ok", f"Taichi {version}, {counted(started.threads, 'thread')}")


def cuda() -> ProbeResult:
    """Examine CUDA, which --arch auto selects on NVIDIA GPUs."""
    return _gpu("cuda")


def vulkan() -> ProbeResult:
    """Examine Vulkan, whose device may be a software renderer."""
    return _gpu("vulkan")


def metal() -> ProbeResult:
    """Examine Metal, which --arch auto selects on Apple GPUs."""
    return _gpu("metal")


def _gpu(arch: str) -> ProbeResult:
    try:
        from mpmcli.solver.trial import backend_is_here, try_backend
    except ImportError as error:
        return ProbeResult("information", f"not tried, since Taichi cannot be loaded ({error})")
    if not backend_is_here(arch):
        return ProbeResult("information", "not here")
    try_backend(arch)
    from mpmcli.doctor.devices import device_names

    devices = device_names(arch)
    names = ", ".join(device.name for device in devices) or "device of unknown name"
    if devices and all(device.is_software for device in devices):
        return ProbeResult("information", f"software only: {names}", "--arch cpu uses the processor directly")
    return ProbeResult("ok", names)
