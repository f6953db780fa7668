"""Options that several commands share."""

from pathlib import Path

import click

set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Replace a key of the scene, e.g. --set time.end=0.5; the value is TOML. May be repeated.",
)
plugin_option = click.option(
    "--plugin",
    "plugins",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FILE",
    help="A Python file that defines LAW, one more constitutive law; its code is run. May be repeated.",
)
threads_option = click.option("--threads", type=click.IntRange(min=1), help="CPU threads; all of them by default.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON on stdout.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
