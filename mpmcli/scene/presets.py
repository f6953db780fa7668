"""Materials by the name of the thing: a law and its parameters in SI units, each with its source, from presets.toml."""

import tomllib
from dataclasses import dataclass
from importlib.resources import files
from typing import Literal, NamedTuple


class Value(NamedTuple):
    """A parameter of a preset, and where its value comes from."""

    value: float | bool | Literal["auto"]
    source: str


@dataclass(frozen=True)
class Preset:
    """One material: its law, what it looks like when it moves, and parameters; others have the law's default."""

    law: str
    shows: str
    values: dict[str, Value]

    @property
    def parameters(self) -> dict[str, float | bool | Literal["auto"]]:
        return {name: value for name, (value, _) in self.values.items()}


_TABLES = tomllib.loads(files("mpmcli.scene").joinpath("presets.toml").read_text(encoding="utf-8"))
PRESETS = {
    name: Preset(table.pop("law"), table.pop("shows"), {key: Value(*value) for key, value in table.items()})
    for name, table in _TABLES.items()
}
