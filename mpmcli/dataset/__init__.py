"""Datasets: many trajectories in one directory, opened for reading, and exported for training code."""

from mpmcli.dataset.dataset import Dataset, Trajectory
from mpmcli.dataset.dataset import open_dataset as open

__all__ = ["Dataset", "Trajectory", "open"]
