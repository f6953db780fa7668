"""Datasets: many trajectories in one directory, opened for reading, and exported for training code."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mpmcli.dataset.dataset import Dataset, Trajectory


def open(path: "Path | str") -> "Dataset":
    """Open a dataset as `open_dataset` does, with a warning that names the missing trajectories, if any."""
    from mpmcli.dataset.dataset import open_dataset

    dataset = open_dataset(path)
    if dataset.lack:
        warnings.warn(dataset.lack, stacklevel=2)
    return dataset


def __getattr__(name: str) -> Any:
    """Load a class on use: the command line reads names of formats from this package."""
    if name not in __all__:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    from mpmcli.dataset import dataset

    return getattr(dataset, name)


__all__ = ["Dataset", "Trajectory", "open"]
