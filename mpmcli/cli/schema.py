"""`mpmcli schema`."""

import click

from mpmcli.cli.json_output import print_json


@click.command("schema")
def command() -> None:
    """Print the JSON Schema of scenes on stdout.

    Editors with TOML support complete and check a scene that begins with `#:schema ./scene.schema.json`.
    """
    from mpmcli.materials.registry import parameter_models
    from mpmcli.scene import json_schema

    print_json(json_schema(parameter_models()))
