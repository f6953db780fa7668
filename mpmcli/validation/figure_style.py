"""Colours and markers of settings, the same in every figure."""

from dataclasses import dataclass
from typing import Any

from mpmcli.validation.setting import Setting


@dataclass(frozen=True)
class Style:
    """Line and marker style of a setting. The colours suit colour-blind readers."""

    color: str
    marker: str
    size: float = 6.0
    width: float = 1.3
    dashes: tuple[float, ...] = ()
    filled: bool = True
    above: int = 3

    def keywords(self) -> dict[str, Any]:
        """Return keyword arguments for matplotlib's `plot`."""
        return {
            "color": self.color,
            "marker": self.marker,
            "markersize": self.size,
            "linewidth": self.width,
            "linestyle": (0, self.dashes) if self.dashes else "-",
            "markerfacecolor": self.color if self.filled else "white",
            "markeredgecolor": self.color,
            "markeredgewidth": 1.3,
            "zorder": self.above,
        }


DEFAULT = Style("#000000", "o", size=6.5, width=2.2, above=5)
# Single precision usually coincides with double, so it is dashed with open markers.
STYLES: dict[tuple[str, object], Style] = {
    ("precision", "f32"): Style("#0072b2", "s", size=9.5, dashes=(3.0, 2.0), filled=False, above=4),
    ("kernel", "quadratic"): Style("#117733", "<"),
    ("kernel", "cubic"): Style("#009e73", "^", size=7.0),
    ("transfer", "apic"): Style("#882255", ">"),
    ("transfer", "pic"): Style("#d55e00", "v", size=7.0),
    ("transfer", "aflip"): Style("#e69f00", "D", size=5.5),
    ("walls", "folded"): Style("#999933", "h"),
    ("walls", "zeroed"): Style("#cc79a7", "p", size=7.5),
    ("per_axis", 1): Style("#56b4e9", "<", size=7.0),
    ("per_axis", 2): Style("#332288", "8"),
    ("per_axis", 3): Style("#5e3c99", ">", size=7.0),
}
# Style of the series over the Courant fraction.
SWEEP = Style("#777777", "d", size=5.5, width=1.0, dashes=(1.0, 1.5), above=2)
OTHER = Style("#aaaaaa", ".")


def style_of(setting: Setting) -> Style:
    """Return the style of a setting."""
    changed = setting.changed_from(Setting())
    if not changed:
        return DEFAULT
    if set(changed) == {"safety"}:
        return SWEEP
    return STYLES.get(next(iter(changed.items())), OTHER) if len(changed) == 1 else OTHER
