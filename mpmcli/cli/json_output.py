"""What --json prints."""

import json
import math

import click


def print_json(content: object) -> None:
    """Print one JSON document on stdout; what is not finite becomes null, as JSON has no infinity."""
    click.echo(json.dumps(_finite(content), indent=2, ensure_ascii=False, allow_nan=False))


def _finite(value: object) -> object:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
