"""Datasets: many trajectories in one directory, opened for reading, and exported for training code."""

import warnings
from pathlib import Path

from mpmcli.dataset.dataset import Dataset, Trajectory, open_dataset


def open(path: Path | str) -> Dataset:
    """Open a dataset as `open_dataset` does, with a warning that names the missing trajectories, if any."""
    dataset = open_dataset(path)
    if dataset.lack:
        warnings.warn(dataset.lack, stacklevel=2)
    return dataset


__all__ = ["Dataset", "Trajectory", "open"]
