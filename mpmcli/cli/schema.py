"""`mpmcli schema`."""

from pathlib import Path

import click

from mpmcli.cli.options import plugin_option
from mpmcli.cli.streams import print_json


@click.command("schema")
@plugin_option
def command(plugins: tuple[Path, ...]) -> None:
    """Print the JSON Schema of scenes on stdout.

    Editors with TOML support complete and check a scene that begins with `#:schema ./scene.schema.json`.
    """
    from mpmcli.materials.registry import load_plugins
    from mpmcli.scene import json_schema

    print_json(json_schema(load_plugins(plugins)))
