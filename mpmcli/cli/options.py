"""Options that several commands share."""

import click

set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Replace a key of the scene, e.g. --set time.end=0.5; the value is TOML. May be repeated.",
)
threads_option = click.option("--threads", type=click.IntRange(min=1), help="CPU threads; all of them by default.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON on stdout.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
