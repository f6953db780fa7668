"""What the driver of CUDA says of its first device and its memory, and errors that say that no memory is left."""

import ctypes
import os
import sys
from pathlib import Path

CUDA_LIBRARIES = {"linux": "libcuda.so.1", "win32": "nvcuda.dll"}
WORDS = ("out of memory", "out_of_memory", "failed to allocate", "out_of_device_memory", "bad_alloc")

# Taichi addresses fields with 32-bit integers.
LARGEST_INDEX = 2**31 - 1
# Share of the free memory that a run may plan for.
MEMORY_SHARE = 0.8


def has_cuda_device() -> bool:
    """Return whether there is a device: a file in /dev, any one of those of its machine in a container, or as told."""
    if any(Path("/dev").glob("nvidia[0-9]*")) or os.path.exists("/dev/dxg"):
        return True
    count = ctypes.c_int()
    try:
        driver = ctypes.CDLL(CUDA_LIBRARIES[sys.platform])
        return not driver.cuInit(0) and not driver.cuDeviceGetCount(ctypes.byref(count)) and count.value > 0
    except (OSError, KeyError, AttributeError):
        return False


def free_memory(arch: str) -> int | None:
    """Return the bytes that are free on the device that Taichi takes; None where it uses those of the machine."""
    if arch != "cuda":
        return None
    try:
        return _free_cuda_memory(ctypes.CDLL(CUDA_LIBRARIES[sys.platform]))
    except (OSError, KeyError, AttributeError):
        return None


def _free_cuda_memory(driver: ctypes.CDLL) -> int | None:
    """Ask the driver for the first device's; the context is the one that Taichi will use."""
    device, context, free, total = ctypes.c_int(), ctypes.c_void_p(), ctypes.c_size_t(), ctypes.c_size_t()
    if driver.cuInit(0) or driver.cuDeviceGet(ctypes.byref(device), 0):
        return None
    if driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), device):
        return None
    try:
        if driver.cuCtxPushCurrent_v2(context):
            return None
        failed = driver.cuMemGetInfo_v2(ctypes.byref(free), ctypes.byref(total))
        driver.cuCtxPopCurrent_v2(ctypes.byref(context))
        return None if failed else free.value
    finally:
        driver.cuDevicePrimaryCtxRelease_v2(device)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error says that memory of the device, or of this machine, could not be allocated."""
    if isinstance(error, MemoryError):
        return True
    said = str(error).lower()
    return isinstance(error, RuntimeError) and any(word in said for word in WORDS)


def out_of_memory_sentence(arch: str, error: BaseException) -> str:
    first = (str(error).strip().splitlines() or [type(error).__name__])[-1].strip().rstrip(".")
    where = "this machine" if arch == "cpu" else f"the {arch} device"
    return (
        f"The memory of {where} does not suffice ({first}): take a larger domain.spacing or fewer particles_per_cell, "
        "or end other programs that use it."
    )
