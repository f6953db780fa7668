"""mpmcli: reproducible particle datasets with the Material Point Method."""

import os

__version__ = "0.1.0"

# Taichi greets on standard output when it is imported, which belongs to JSON here.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
# And it aborts where batch systems leave HOME unset.
os.environ.setdefault("HOME", os.path.expanduser("~"))
