"""`mpmcli new`, `mpmcli materials` and `mpmcli schema`."""

import inspect
import sys
from collections.abc import Sequence
from pathlib import Path
from shutil import copyfile
from typing import Any

import click

from mpmcli.cli.options import json_option, output_option, plugin_option
from mpmcli.cli.streams import print_json, print_note, print_text
from mpmcli.errors import InputError

# Width of the text, in columns, if stdout is not a terminal.
WIDTH = 140


@click.command("new", epilog="Example: mpmcli new dam_break_2d -o dam.toml")
@click.argument("name", required=False)
@output_option("File to write; <NAME>.toml in the working directory by default.", "FILE.toml")
@json_option
def new_command(name: str | None, output: Path | None, as_json: bool) -> None:
    """List the example scenes, or copy the one called NAME for editing.

    `mpmcli simulate NAME` runs one as it is.
    """
    from mpmcli.scene.examples import caption, examples, files_of, title
    from mpmcli.scene.problem import hint_at

    known = examples()
    if name is None:
        if as_json:
            print_json({key: {"title": title(path), "shows": caption(path)} for key, path in known.items()})
        else:
            width = max(map(len, known))
            print_text("\n".join(f"{key:<{width}}  {title(path)}" for key, path in known.items()))
        return
    if name not in known:
        raise InputError(f'there is no example "{name}"; {hint_at(name, list(known), "mpmcli new lists them")}')
    source, target = known[name], output or Path(f"{name}.toml")
    copies = {target: source} | {target.parent / file: source.parent / file for file in files_of(source)}
    for path in copies:
        if path.exists():
            raise InputError(f"{path} is there already; give another place with -o.")
    for path, original in copies.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            copyfile(original, path)
        except OSError as error:
            raise InputError(f"{path} could not be written ({error.strerror}); give another place with -o.") from error
    if as_json:
        print_json({"path": str(target), "files": [str(path) for path in copies], "shows": caption(source)})
    else:
        print_note(f"{title(source)}: {caption(source)}\nTo run it: mpmcli simulate {target}")
        print_text(str(target))


@click.command("materials", epilog="Example: mpmcli materials sand")
@click.argument("name", required=False)
@plugin_option
@json_option
def materials_command(name: str | None, plugins: tuple[Path, ...], as_json: bool) -> None:
    """List the laws and presets of materials, or show the one called NAME.

    Parameters are listed with units, ranges and defaults, presets with their sources, and knobs with the
    values that they set.
    """
    from mpmcli.materials.registry import laws, load_plugins
    from mpmcli.scene.expand import PRESETS, available_presets, law_facts, preset_facts
    from mpmcli.scene.problem import hint_at, listed, quoted, rigid_hint

    models = load_plugins(plugins)
    known, presets = laws(), available_presets(models)
    if name is not None and name not in known and name not in presets:
        there = f"{rigid_hint(name)}there are {listed(quoted([*sorted(known), *presets]), 'and')}"
        raise InputError(f'there is no law or preset "{name}"; {hint_at(name, [*known, *presets], there)}')
    facts: dict[str, list[dict[str, Any]]] = {
        "laws": [
            {"summary": _summary(known[law]), **law_facts(known[law].parameters)}
            for law in sorted(known)
            if name in (None, law)
        ],
        "presets": [
            preset_facts(preset, known[PRESETS[preset].law].parameters) for preset in presets if name in (None, preset)
        ],
    }
    if as_json:
        print_json(facts)
    else:
        _print(facts, in_full=name is not None)


@click.command("schema", epilog="Example: mpmcli schema > scene.schema.json")
@plugin_option
def schema_command(plugins: tuple[Path, ...]) -> None:
    """Print the JSON Schema of scenes on stdout.

    Editors with TOML support complete and check a scene that begins with `#:schema ./scene.schema.json`.
    """
    from mpmcli.materials.registry import load_plugins
    from mpmcli.scene import json_schema

    print_json(json_schema(load_plugins(plugins)))


def _summary(law: type) -> str:
    """Return the first line of the docstring of a law's module, or of its class."""
    module = sys.modules.get(law.__module__)
    text = getattr(module, "__doc__", None) or inspect.getdoc(law) or ""
    return next(iter(text.strip().splitlines()), "").rstrip(".")


def _print(facts: dict[str, list[dict[str, Any]]], in_full: bool) -> None:
    """Print tables of presets and laws; `in_full` those of each preset with values, sources and knobs."""
    if facts["presets"] and not in_full:
        _show('Presets: material = "honey", or { preset = "honey", thickness = 0.7, density = 1400 }')
        _say_table(["preset", "law", "what it shows"], [[p["name"], p["law"], p["shows"]] for p in facts["presets"]])
        _show("\nLaws: material = { law = ..., with these parameters, or a knob in place of one }")
    for law in facts["laws"]:
        _show(f"\n{law['name']}: {law['summary']}")
        rows = [
            [
                p["name"],
                p["unit"],
                p["range"],
                "needed" if p["default"] is None else _plain(p["default"]),
                p["description"],
            ]
            for p in law["parameters"]
        ]
        rows += [[f"{k['name']} (knob)", "", "0 to 1", "", _knob_text(k)] for k in law["knobs"]]
        _say_table(["parameter", "unit", "range", "default", "meaning"], rows)
        for field in law["fields"]:
            where = "" if len(field["dimensions"]) == 2 else f" ({field['dimensions'][0]}D only)"
            _show(f"output field {field['name']}{where}: {field['description']}")
    for preset in facts["presets"] if in_full else []:
        _show(f"\npreset {preset['name']}, of the law {preset['law']}: {preset['shows']}")
        rows = [[v["name"], _plain(v["value"]), v["unit"], v["source"]] for v in preset["values"]]
        _say_table(["parameter", "value", "unit", "source"], rows)
        positions = ["" if k["position"] is None else f"{k['position']:.2g}" for k in preset["knobs"]]
        knobs = [[k["name"], position, _knob_text(k)] for k, position in zip(preset["knobs"], positions, strict=True)]
        if knobs:
            _say_table(["knob", "position", "meaning"], knobs)


def _knob_text(knob: dict[str, Any]) -> str:
    ends = f"{knob['low']:g} to {knob['high']:g} {knob['unit']}".rstrip()
    return f"Sets {knob['sets']}: {ends}, {knob['scale']}; {knob['meaning']}."


def _plain(value: object) -> str:
    from mpmcli.scene.problem import written

    return f"{value:g}" if isinstance(value, float) else written(value)


def _say_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="")
    for column in head[:-1]:
        table.add_column(column, no_wrap=True)
    table.add_column(head[-1])
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    _show(table)


def _show(content: object) -> None:
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = WIDTH
    with console.capture() as captured:
        console.print(content, markup=False)
    # Tables are padded to the full width.
    print_text("\n".join(line.rstrip() for line in captured.get().removesuffix("\n").split("\n")))
