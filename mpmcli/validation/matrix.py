"""The runs of a level: every case at its resolutions, with the default setting and its variants."""

from collections.abc import Iterable
from dataclasses import dataclass

from mpmcli.validation.case import Case, Level
from mpmcli.validation.setting import Setting

# The values of each field of `Setting` that are tried, and their labels.
KNOBS: dict[str, dict[object, str]] = {
    "precision": {"f64": "f64", "f32": "f32"},
    "kernel": {"quadratic": "quadratic kernel", "cubic": "cubic kernel"},
    "transfer": {"apic": "APIC", "pic": "PIC", "aflip": "AFLIP"},
    "walls": {"folded": "folded walls", "zeroed": "zeroed walls"},
    "per_axis": {1: "1 particle per axis", 2: "2 particles per axis", 3: "3 particles per axis"},
    "safety": {value: f"Courant fraction {value:g}" for value in (0.1, 0.2, 0.4, 0.8, 0.95)},
}
DEFAULT = "default"


@dataclass(frozen=True)
class Run:
    """One case at resolution n with one setting."""

    case: str
    n: int
    setting: Setting

    @property
    def name(self) -> str:
        """File name of the result, without suffix."""
        words = [f"{knob}-{value}" for knob, value in self.setting.changed_from(Setting()).items()]
        return "_".join([self.case, f"n{self.n}", *(words or [DEFAULT])])


def label_of(setting: Setting) -> str:
    """Return the label of a setting: its differences from the default one."""
    changed = setting.changed_from(Setting())
    words = [KNOBS[knob].get(value, f"{knob} {value}") for knob, value in changed.items()]
    return ", ".join(words) or DEFAULT


def variants(knob: str) -> list[Setting]:
    """Return the settings that differ from the default one in one field."""
    usual = getattr(Setting(), knob)
    return [Setting(**{knob: value}) for value in KNOBS[knob] if value != usual]


def sweep_resolution(case: Case, level: Level) -> int:
    """Return the resolution at which the Courant fraction is varied, the (lower) median."""
    resolutions = sorted(case.levels[level])
    return resolutions[(len(resolutions) - 1) // 2]


def runs_of(case: Case, level: Level) -> list[Run]:
    """Return the runs of a case at a level, the default setting first, each setting from coarse to fine.

    The level "coarse" has the default setting, and f32 at the finest resolution. Other levels vary every field in
    `case.varies` at every resolution, except for the Courant fraction, which is varied at one resolution.
    """
    resolutions = sorted(case.levels[level])
    runs = [Run(case.name, n, Setting()) for n in resolutions]
    knobs = [knob for knob in KNOBS if knob in case.varies]
    if level == "coarse":
        only = [variant for knob in knobs if knob == "precision" for variant in variants(knob)]
        return runs + [Run(case.name, resolutions[-1], variant) for variant in only]
    for knob in knobs:
        at = [sweep_resolution(case, level)] if knob == "safety" else resolutions
        runs += [Run(case.name, n, variant) for variant in variants(knob) for n in at]
    return runs


def matrix(cases: Iterable[Case], level: Level) -> list[Run]:
    """Return the runs of several cases, case by case."""
    return [run for case in cases for run in runs_of(case, level)]
