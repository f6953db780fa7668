"""The fit of a damped oscillation against signals that are one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mpmcli.validation.shared import fit_oscillation


@given(
    frequency=st.floats(0.5, 20.0),
    decay=st.floats(-0.01, 0.2),
    phase=st.floats(0.0, 6.28),
    offset=st.floats(-3.0, 3.0),
    guess=st.floats(0.7, 1.4),
)
def test_finds_the_oscillation_that_made_the_signal(
    frequency: float, decay: float, phase: float, offset: float, guess: float
) -> None:
    """Four periods, 24 samples each: frequency and decay to 1e-9, from a guess that is up to 40 % off."""
    times = np.linspace(0.0, 4 * 2 * np.pi / frequency, 97)
    rate = decay * frequency
    found = fit_oscillation(
        times, offset + np.exp(-rate * times) * np.cos(frequency * times + phase), guess * frequency
    )
    assert found.frequency == pytest.approx(frequency, rel=1e-9)
    assert found.decay == pytest.approx(rate, abs=1e-9 * frequency)
    assert found.amplitude == pytest.approx(1.0, rel=1e-8)
    assert found.offset == pytest.approx(offset, abs=1e-8)


def test_finds_none_where_there_is_none() -> None:
    """A signal that is not finite has no oscillation."""
    assert np.isnan(fit_oscillation(np.linspace(0.0, 5.0, 60), np.full(60, np.nan), 2 * np.pi).frequency)
