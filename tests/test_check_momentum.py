"""Momentum that drifts: only where the transfers keep it, and nothing acts."""

import numpy as np
import pytest

from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_state import MomentumCheck
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.header import RunHeader

SCENE = """\
[domain]
size = [2.0, 1.0]
gravity = [0.0, 0.0]
walls = "separate"
[solver]
transfer = "{transfer}"
"""


def header_of(transfer: str) -> RunHeader:
    header = {"dimension": 2, "spacing": 0.05, "origin": [0.0, 0.0], "size": [2.0, 1.0]}
    return RunHeader.read({**header, "scene": SCENE.format(transfer=transfer)})


def row(index: int, spin: float) -> LedgerRow:
    """Return the ledger of one kilogram that turns, 0.1 J."""
    return LedgerRow(
        time=0.1 * index, steps=index and 1, step_min=0.1, step_max=0.1, limit="wave", speed_max=0.5, courant_max=0.1,
        volume_ratio_min=1.0, volume_ratio_max=1.0, mass=1.0, kinetic=0.1, elastic=0.0, potential=0.0,
        linear_momentum=(0.0, 0.0), angular_momentum=(spin,),
    )  # fmt: skip


@pytest.mark.parametrize(("transfer", "found"), [("apic", True), ("aflip", False)])
def test_spin_that_is_lost_is_a_fault_of_apic_alone(transfer: str, found: bool) -> None:
    """A twentieth of sqrt(2 M E) times the diagonal is gone; AFLIP keeps spin to first order."""
    position = np.array([[0.9, 0.5], [1.1, 0.5]])
    velocity = np.array([[0.0, -0.4], [0.0, 0.4]])
    label = np.zeros(2, dtype=np.int32)
    lost = 0.05 * np.sqrt(0.2) * np.hypot(2.0, 1.0)
    findings = FrameFindings()
    check = MomentumCheck(header_of(transfer), findings)
    for k in range(2):
        check.check(Frame(k, 0.1 * k, k, position, velocity, label, label, {}), row(k, 1.0 - k * lost))
    assert check.figures["momentum_frames"] == 1
    assert check.figures["momentum_drift"] == pytest.approx(0.05 if found else 0.0, abs=1e-12)
    assert [finding.rule for finding in findings.found()] == (["momentum"] if found else [])
