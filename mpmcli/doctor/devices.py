"""Names of GPUs, queried from their drivers, since Taichi does not provide them."""

import ctypes
import sys
from dataclasses import dataclass

from mpmcli.solver.machine.device_memory import CUDA_LIBRARIES

NAME_LENGTH = 256
# VkPhysicalDeviceProperties: offsets of deviceType and deviceName, an upper bound of its size, and the type of a CPU.
VULKAN_TYPE, VULKAN_NAME, VULKAN_SIZE, VULKAN_CPU = 16, 20, 4096, 4
# Words of 8 bytes of VkInstanceCreateInfo.
INSTANCE_INFO_WORDS = 8
VULKAN_LIBRARIES = {"linux": "libvulkan.so.1", "win32": "vulkan-1.dll", "darwin": "libvulkan.1.dylib"}


@dataclass(frozen=True)
class Device:
    """A device: its name, and whether it is emulated by the CPU."""

    name: str
    is_software: bool = False


def device_names(arch: str) -> list[Device]:
    """Return the devices of a backend; empty if the driver cannot be queried."""
    asked = {"cuda": (_cuda, CUDA_LIBRARIES), "vulkan": (_vulkan, VULKAN_LIBRARIES)}
    if arch not in asked:
        return []
    ask, libraries = asked[arch]
    try:
        return ask(ctypes.CDLL(libraries[sys.platform]))
    except (OSError, KeyError, AttributeError):
        return []


def _cuda(driver: ctypes.CDLL) -> list[Device]:
    count, name = ctypes.c_int(), ctypes.create_string_buffer(NAME_LENGTH)
    if driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)):
        return []
    devices = []
    for number in range(count.value):
        handle = ctypes.c_int()
        if driver.cuDeviceGet(ctypes.byref(handle), number) or driver.cuDeviceGetName(name, NAME_LENGTH, handle):
            continue
        devices.append(Device(name.value.decode(errors="replace")))
    return devices


def _vulkan(loader: ctypes.CDLL) -> list[Device]:
    instance, count = ctypes.c_void_p(), ctypes.c_uint32()
    # VkInstanceCreateInfo: sType is 1, and all other members may be zero.
    info = (ctypes.c_uint64 * INSTANCE_INFO_WORDS)(1)
    if loader.vkCreateInstance(ctypes.byref(info), None, ctypes.byref(instance)):
        return []
    loader.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    handles = (ctypes.c_void_p * count.value)()
    loader.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), handles)
    devices = []
    for handle in handles[: count.value]:
        properties = ctypes.create_string_buffer(VULKAN_SIZE)
        loader.vkGetPhysicalDeviceProperties(ctypes.c_void_p(handle), properties)
        kind = int.from_bytes(properties[VULKAN_TYPE : VULKAN_TYPE + 4], sys.byteorder)
        name = properties[VULKAN_NAME : VULKAN_NAME + NAME_LENGTH].split(b"\0")[0].decode(errors="replace")
        devices.append(Device(name, kind == VULKAN_CPU))
    loader.vkDestroyInstance(instance, None)
    return devices
