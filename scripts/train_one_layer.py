#!/usr/bin/env python
"""Trains one linear layer on a dataset of `mpmcli sweep`, as an example of loading it into PyTorch.

The layer predicts the displacement of a particle over the next frame from its last displacements. PyTorch is not among
the dependencies of mpmcli; without it, the script says so and ends.
"""

import argparse
from collections.abc import Sequence

import numpy as np

import mpmcli.dataset

# Displacements that the prediction is made from, as in GNS and LagrangeBench.
HISTORY = 5


class Windows:
    """Windows of consecutive frames, a map-style dataset as torch.utils.data.DataLoader takes it.

    Item k is (past, next): the displacements (N, HISTORY, d) and (N, d) float32, m, of all N particles of a trajectory.
    """

    def __init__(self, dataset: mpmcli.dataset.Dataset, numbers: Sequence[int]) -> None:
        self._dataset = dataset
        self._places = [
            (number, first) for number in numbers for first in range(dataset[number].frame_count - HISTORY - 1)
        ]

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        number, first = self._places[k]
        # Only these frames are read.
        position = self._dataset[number].read("position", slice(first, first + HISTORY + 2))
        displacement = np.diff(position.astype(np.float64), axis=0).astype(np.float32)
        return displacement[:-1].transpose(1, 0, 2).copy(), displacement[-1]


def train(windows: Windows, steps: int) -> list[float]:
    """Fit the layer with one window a step, and return the mean squared error of each, in units of its variance."""
    import torch
    from torch.utils.data import DataLoader

    torch.manual_seed(0)
    past, _ = windows[0]
    dimension = past.shape[-1]
    # Each axis is predicted alike, from its own displacements.
    layer = torch.nn.Linear(HISTORY, 1, bias=False)
    optimizer = torch.optim.Adam(layer.parameters(), lr=0.05)
    # Trajectories have different numbers of particles: one window is one batch.
    loader = DataLoader(windows, batch_size=None, shuffle=True)
    errors: list[float] = []
    while len(errors) < steps:
        for past, following in loader:
            scale = past.std() + 1e-12
            predicted = layer(past.transpose(1, 2) / scale).reshape(-1, dimension)
            loss = torch.mean((predicted - following / scale) ** 2)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            errors.append(loss.item())
            if len(errors) == steps:
                break
    return errors


def main() -> None:
    """Train on the training split."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", help="directory of the dataset")
    parser.add_argument("--steps", type=int, default=100)
    arguments = parser.parse_args()
    dataset = mpmcli.dataset.open(arguments.dataset)
    windows = Windows(dataset, dataset.splits["train"] or dataset.numbers)
    print(f"{len(windows)} windows of {HISTORY + 2} frames")
    try:
        errors = train(windows, arguments.steps)
    except ModuleNotFoundError:
        print("PyTorch is not installed here: nothing is trained.")
        return
    print(f"mean squared error: {errors[0]:.4g} at first, {errors[-1]:.4g} after {len(errors)} steps")


if __name__ == "__main__":
    main()
