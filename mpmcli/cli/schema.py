"""`mpmcli schema`."""

import click


@click.command("schema")
def command() -> None:
    """Print the JSON Schema of scenes on stdout.

    Editors with TOML support complete and check a scene that begins with `#:schema ./scene.schema.json`.
    """
    import json

    from mpmcli.materials.registry import parameter_models
    from mpmcli.scene import json_schema

    click.echo(json.dumps(json_schema(parameter_models()), indent=2, ensure_ascii=False))
