"""`mpmcli info`."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from mpmcli.cli.options import json_option, plugin_option, set_option
from mpmcli.cli.streams import print_json, print_text

if TYPE_CHECKING:
    from mpmcli.dataset.report import Verification as DatasetVerification
    from mpmcli.output.verify import Verification


@click.command("info")
@click.argument("path", type=click.Path(path_type=Path))
@set_option
@plugin_option
@click.option("--verify", is_flag=True, help="Read all of a result, a dataset or an export, and compare its checksums.")
@json_option
def command(
    path: Path, overrides: tuple[str, ...], plugins: tuple[Path, ...], verify: bool, as_json: bool
) -> int | None:
    """Say what PATH holds: a scene (.toml), or a result (its directory, particles.vtkhdf or particles.pvd).

    With --verify the exit code is 1 if anything has changed since it was written, or is missing.
    """
    from mpmcli.errors import InputError

    if verify:
        if path.suffix == ".toml" or overrides or plugins:
            raise InputError(f"--verify is for results, datasets and exports, and {path} is none; leave it out.")
        found = _verified(path)
        print_json(found.as_dict()) if as_json else print_text(found.text())
        return 1 if found.faults else 0
    if path.suffix == ".toml":
        facts = _of_scene(path, overrides, plugins)
    else:
        if overrides or plugins:
            option = "--set changes" if overrides else "--plugin is for"
            raise InputError(f"{option} scenes, and {path} is none; leave it out.")
        facts = _of_result(path)
    if as_json:
        print_json(facts)
        return None
    known = {name: value for name, value in facts.items() if value not in (None, "", [], {})}
    width = max(len(name) for name in known)
    print_text("\n".join(f"{name.replace('_', ' '):<{width}}  {_plain(value)}" for name, value in known.items()))
    return None


def _verified(path: Path) -> "Verification | DatasetVerification":
    from mpmcli.dataset.dataset import is_dataset
    from mpmcli.dataset.export_directory import is_export, verify_export
    from mpmcli.dataset.report import verify
    from mpmcli.output.verify import verify_result

    if is_export(path):
        return verify_export(path)
    return verify(path) if is_dataset(path) else verify_result(path)


def _of_scene(path: Path, overrides: tuple[str, ...], plugins: tuple[Path, ...]) -> dict:
    from mpmcli.materials.registry import load_plugins
    from mpmcli.scene import load_scene
    from mpmcli.solver.backend import Backend
    from mpmcli.solver.plan import make_plan

    loaded = load_scene(path, overrides, laws=load_plugins(plugins))
    scene = loaded.scene
    plan = make_plan(scene, Backend("cpu", 1, scene.solver.precision, True))
    return {
        "title": scene.title,
        "dimension": scene.dimension,
        "size_m": list(scene.domain.size),
        "spacing_m": scene.domain.spacing,
        "cells": list(scene.domain.cells),
        "end_s": scene.time.end,
        "frames": scene.time.frames + 1,
        "bodies": [
            f"{body.name}: {body.material.law}, {type(body.shape.form).__name__.lower()}" for body in scene.bodies
        ],
        "colliders": [
            f"{collider.name}: {type(collider.form).__name__.lower()}{', moving' if collider.motion.moves else ''}"
            for collider in scene.colliders
        ],
        "particles": plan.particles,
        "bytes_per_particle": plan.bytes_per_particle,
        "device_bytes": plan.device_bytes,
        "fields": list(scene.output.fields),
        "notes": list(loaded.notes),
    }


def _of_result(path: Path) -> dict:
    from mpmcli.output import open_result

    result = open_result(path)
    record = result.record or {}
    last = result.ledger[-1]
    return {
        "title": result.header.title,
        "kind": result.kind,
        "status": result.status,
        "frames": result.frame_count,
        "frames_expected": record.get("frames_expected"),
        "time_s": [float(result.times[0]), float(result.times[-1])],
        "particles": int(result.particle_counts[-1]),
        "dimension": result.dimension,
        "bodies": list(result.header.body_names),
        "colliders": list(result.header.collider_names),
        "materials": [law.name for law in result.header.laws],
        "fields": ["velocity", *result.field_names],
        "precision": result.header.precision,
        "backend": record.get("backend") or dict(result.header.backend) or None,
        "steps": record.get("steps"),
        "step_s": [
            min((row.step_min for row in result.ledger[1:]), default=0.0),
            max((row.step_max for row in result.ledger[1:]), default=0.0),
        ],
        "limits": record.get("limits", {}),
        "energy_J": [result.ledger[0].energy, last.energy],
        "mass_kg": last.mass,
        "volume_ratio": [
            min(row.volume_ratio_min for row in result.ledger),
            max(row.volume_ratio_max for row in result.ledger),
        ],
        "timings_s": record.get("timings", {}),
        "failure": (record.get("failure") or {}).get("message"),
        "version": result.header.version,
    }


def _plain(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_plain(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(_plain(item) for item in value)
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)
