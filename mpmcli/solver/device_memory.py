"""Recognises that a device has no memory left, of which Taichi and the drivers tell in words alone."""

WORDS = ("out of memory", "out_of_memory", "failed to allocate", "out_of_device_memory", "bad_alloc")


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error says that memory of the device, or of this machine, could not be allocated."""
    if isinstance(error, MemoryError):
        return True
    said = str(error).lower()
    return isinstance(error, RuntimeError) and any(word in said for word in WORDS)


def out_of_memory_sentence(arch: str, error: BaseException) -> str:
    """Return the sentence for such an error."""
    first = (str(error).strip().splitlines() or [type(error).__name__])[-1].strip().rstrip(".")
    where = "this machine" if arch == "cpu" else f"the {arch} device"
    return (
        f"The memory of {where} does not suffice ({first}): take a larger domain.spacing or fewer particles_per_cell, "
        "or end other programs that use it."
    )
