"""Sand that is tossed and lands (docs/hard-cases.md, H16). How it collapses and shears is in the validation cases."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scenes import GRAVITY, block, scene

from mpmcli.scene import sample_bodies
from mpmcli.solver.solver import Solver

DENSITY = 1600.0


@pytest.mark.parametrize("correction", [True, False], ids=["corrected", "uncorrected"])
def test_tossed_sand_gains_volume_unless_corrected(
    backend_of: Callable, correction: bool, record_property: Callable
) -> None:
    """Thrown up by v = 2 cos^2(2 pi x / W) y / H m/s and landed, sand fills as much as before: < 5 % more (H16).

    Without volume correction (Tampubolon et al. 2017) every parting of grains stays in it: > 10 %. Volume is twice the
    mean height of the deposit, level between walls, times its width.
    """
    cells, H = 8, 0.2
    h = H / cells
    width = 2 * H
    sand = {
        "law": "sand",
        "density": DENSITY,
        "youngs_modulus": 5e5,
        "friction_angle": 30.0,
        "volume_correction": correction,
    }
    asked = scene(
        [2 * cells, 3 * cells],
        h,
        [block("sand", sand, [0, 0], [width, H])],
        0.75,
        frames=3,
        gravity=[0, -GRAVITY],
        walls={"default": "slip", "y_min": "stick"},
        fields=["velocity", "volume_ratio"],
    )
    sample = sample_bodies(asked)[0]
    x, y = sample.position.T
    throw = 2 * np.cos(2 * np.pi * x / width) ** 2 * y / H
    solver = Solver(asked, backend_of("f32"), [replace(sample, velocity=np.stack([0 * x, throw], 1))])
    frames = [frame for frame, _ in solver.frames()]
    heights = np.array([frame.position[:, 1].astype(np.float64).mean() for frame in frames])
    gain = heights[-1] / heights[0] - 1
    record_property("volume gained", float(gain))
    record_property("volume gained, mean of J", float(frames[-1].fields["volume_ratio"].mean() - 1))
    assert heights.max() > 1.02 * heights[0]
    assert np.abs(frames[-1].velocity).max() < 0.05
    if correction:
        assert abs(gain) < 0.05
    else:
        assert gain > 0.10
