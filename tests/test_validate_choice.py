"""Which setting a report speaks for."""

from dataclasses import replace

from mpmcli.validation.case import Setting
from mpmcli.validation.comparison import Compared, Ratios, outcome, reason, takes_its_place

CUBIC = Compared(
    Setting(kernel="cubic"),
    error=Ratios({"bar": 0.5, "drop": 1.9}),
    seconds=Ratios({"bar": 1.0, "drop": 1.0}),
    to_equal=Ratios({"bar": 0.4, "drop": 0.9}),
    failed=0,
    runs=4,
)


def test_a_setting_takes_the_place_where_it_is_faster_and_never_much_worse() -> None:
    """Its mean is sqrt(0.4 x 0.9) = 0.6 of the time; its worst error stays below twice that of the default."""
    assert takes_its_place(CUBIC)
    assert "0.6 of the time, and 1.9 times as far off in its worst case, drop: it should be" in reason(CUBIC)
    assert outcome([CUBIC]).endswith("These do: cubic kernel.")


def test_a_setting_does_not_that_is_slower_or_worse_or_fails() -> None:
    worse = replace(CUBIC, error=Ratios({"bar": 0.5, "drop": 2.1}))
    slower = replace(CUBIC, to_equal=Ratios({"bar": 0.9, "drop": 1.0}))
    fails = replace(CUBIC, failed=1)
    unknown = replace(CUBIC, to_equal=None)
    for entry in (worse, slower, fails, unknown):
        assert not takes_its_place(entry)
        assert "should be" not in reason(entry)
    assert "0.6 of the time, but 2.1 times as far off in its worst case, drop." in reason(worse)
    assert "1 of 4 runs failed" in reason(fails) and "no case tells" in reason(unknown)
    assert outcome([worse, slower, fails, unknown]).endswith("None does.")


def test_single_precision_is_what_scenes_take_already() -> None:
    single = replace(CUBIC, setting=Setting(precision="f32"))
    assert "scenes take it" in reason(single)
    assert outcome([single]).endswith("None does.")
