"""Padding of arrays for VTK, the ledger as a table; and the frames that the other output tests write."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.output.layout import FrameLayout, ledger_columns, ledger_rows

# Fields by name: shape per particle as a function of d.
FIELDS = {
    "density": lambda d: (), "pressure": lambda d: (), "acceleration": lambda d: (d,),
    "deformation_gradient": lambda d: (d, d), "stress": lambda d: (d * d,), "five": lambda d: (5,),
}  # fmt: skip


def make_frame(index: int, n: int, d: int, dtype: str = "float32", fields=("density", "pressure")) -> Frame:
    """A frame of random bits (NaN, infinities and -0.0 among them), the same for the same arguments."""
    rng = np.random.default_rng([index, n, d])

    def bits(*shape: int) -> np.ndarray:
        size = np.dtype(dtype).itemsize
        return rng.integers(0, 256, (*shape, size), dtype=np.uint8).view(dtype).reshape(shape)

    return Frame(
        index=index,
        time=0.1 * index,
        step=7 * index,
        position=bits(n, d),
        velocity=bits(n, d),
        body=rng.integers(0, 3, n, dtype=np.int32),
        material=rng.integers(0, 2, n, dtype=np.int32),
        fields={name: bits(n, *FIELDS[name](d)) for name in fields},
    )


def make_row(index: int, d: int) -> LedgerRow:
    numbers = np.random.default_rng(index).standard_normal(16)
    limit = "" if index == 0 else f"sound speed in säule {index}"
    momenta = tuple(numbers[9 : 9 + d].tolist()), tuple(numbers[12 : 12 + 2 * d - 3].tolist())
    return LedgerRow(0.1 * index, 7, *numbers[:2].tolist(), limit, *numbers[:8].tolist(), *momenta)


def assert_same_frame(read: Frame, written: Frame) -> None:
    """Equal in every type, shape and bit."""
    assert (read.index, read.time, read.step) == (written.index, written.time, written.step)
    assert set(read.fields) == set(written.fields)
    pairs = [(getattr(read, name), getattr(written, name)) for name in ("position", "velocity", "body", "material")]
    pairs += [(read.fields[name], written.fields[name]) for name in written.fields]
    for a, b in pairs:
        assert a.dtype == b.dtype and a.shape == b.shape
        assert a.tobytes() == b.tobytes()


@settings(deadline=None)
@given(
    n=st.integers(0, 20),
    d=st.sampled_from([2, 3]),
    dtype=st.sampled_from(["float32", "float64"]),
    fields=st.sets(st.sampled_from(sorted(FIELDS))),
)
def test_padding_is_undone_bit_for_bit(n, d, dtype, fields):
    frame = make_frame(3, n, d, dtype, sorted(fields))
    layout = FrameLayout.from_dict(FrameLayout.of(frame).to_dict())
    stored = dict(layout.stored(frame))
    assert stored["Points"].shape == (n, 3) and stored["velocity"].shape == (n, 3)
    assert stored["id"].tolist() == list(range(n))
    for name in {"deformation_gradient", "stress"} & fields:
        assert stored[name].shape == (n, 9)
    assert sum(array.nbytes for array in stored.values()) == n * layout.bytes_per_particle
    assert_same_frame(layout.frame(frame.index, frame.time, frame.step, stored), frame)


def test_a_plane_deformation_gradient_is_padded_to_plane_strain():
    frame = make_frame(0, 2, 2, fields=("deformation_gradient", "stress"))
    frame.fields["deformation_gradient"][0] = [[1, 2], [3, 4]]
    frame.fields["stress"][0] = [1, 2, 3, 4]
    stored = dict(FrameLayout.of(frame).stored(frame))
    assert stored["deformation_gradient"][0].tolist() == [1, 2, 0, 3, 4, 0, 0, 0, 1]
    assert stored["stress"][0].tolist() == [1, 2, 0, 3, 4, 0, 0, 0, 0]


@pytest.mark.parametrize("fields", [
    {"a.b": np.zeros(4, np.float32)}, {"a/b": np.zeros(4, np.float32)}, {"velocity": np.zeros((4, 2), np.float32)},
    {"flag": np.zeros(4, bool)}, {"half": np.zeros(4, np.float16)}, {"short": np.zeros(3, np.float32)},
    {"cube": np.zeros((4, 2, 3), np.float32)},
])  # fmt: skip
def test_arrays_that_a_file_cannot_hold_are_refused(fields):
    with pytest.raises(ValueError, match=next(iter(fields))):
        FrameLayout.of(Frame(**{**vars(make_frame(0, 4, 2)), "fields": fields}))


def test_a_frame_with_other_arrays_than_the_first_is_refused():
    layout = FrameLayout.of(make_frame(0, 4, 2))
    for other in (make_frame(1, 4, 3), make_frame(1, 4, 2, "float64"), make_frame(1, 4, 2, fields=())):
        with pytest.raises(ValueError, match="frame 1"):
            list(layout.stored(other))


@pytest.mark.parametrize("d", [2, 3])
def test_the_ledger_survives_columns(d):
    rows = [make_row(k, d) for k in range(5)]
    assert ledger_rows(ledger_columns(rows)) == rows
    assert ledger_columns(rows)["angular_momentum"].shape == (5, 1 if d == 2 else 3)
