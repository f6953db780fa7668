"""What readers of files raise where the content contradicts itself."""

from mpmcli.errors import InputError

# Of h5py, numpy, JSON and TOML. InputError is ours: a reader has found what is wrong.
DAMAGE = (
    *(InputError, OSError, RuntimeError, ValueError, KeyError, IndexError, TypeError, AttributeError),
    *(OverflowError, RecursionError, MemoryError),
)


def first_line(error: Exception) -> str:
    """Return the first line of what an exception says, without a period at its end, or its type."""
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
