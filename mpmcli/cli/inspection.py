"""`mpmcli check`, `mpmcli info` and `mpmcli doctor`."""

from pathlib import Path

import click

from mpmcli.cli.options import COUNT, SCENE, json_option, plugin_option, set_option
from mpmcli.cli.streams import print_answer, print_json, print_text
from mpmcli.errors import InputError


@click.command("check", epilog="Example: mpmcli check drop.toml --set domain.spacing=0.01")
@click.argument("path", type=SCENE)
@set_option
@plugin_option
@click.option("--probe", is_flag=True, help="Measure the time of a step by a run of two seconds, and of compilation.")
@click.option("--strict", is_flag=True, help="Treat warnings as errors.")
@click.option("--threads", type=COUNT, help="CPU threads; as many as simulate takes by default.")
@json_option
def check_command(
    path: Path,
    overrides: tuple[str, ...],
    plugins: tuple[Path, ...],
    probe: bool,
    strict: bool,
    threads: int | None,
    as_json: bool,
) -> int:
    """Check a scene (PATH.toml): the stable step and its cause, likely faults, and the cost of the run.

    PATH may also be a result, its directory or particles.vtkhdf: check whether it is stable and complete. Nothing is
    written. The exit code is 1 if there is an error, or with --strict a warning.
    """
    if path.suffix == ".toml":
        from mpmcli.check.scene_check import check_scene
        from mpmcli.materials.registry import load_plugins
        from mpmcli.scene import load_scene

        loaded = load_scene(path, overrides, laws=load_plugins(plugins))
        check = check_scene(loaded, threads=threads)
        # Do not run a scene that does not fit into memory.
        if probe and not any(finding.rule == "memory" for finding in check.findings):
            from mpmcli.check.forecast import probe_scene

            found, plan = probe_scene(loaded, check.forecast.steps, threads=threads)
            check = check_scene(loaded, facts=check.facts, plan=plan, probe=found, threads=threads)
    else:
        given = {"--set": overrides, "--plugin": plugins, "--probe": probe, "--threads": threads}
        for option in (option for option, value in given.items() if value):
            raise InputError(f"{option} is for scenes, and {path} is not one; leave it out.")
        from mpmcli.check.result_check import check_result

        check = check_result(path)
    if as_json:
        print_json({**check.as_dict(), "ok": check.passes(strict=strict)})
    else:
        print_text(check.text())
    return 0 if check.passes(strict=strict) else 1


@click.command("info", epilog="Example: mpmcli info results/drop --verify")
@click.argument("path", type=SCENE)
@set_option
@plugin_option
@click.option("--verify", is_flag=True, help="Read all of a result, a dataset or an export, and compare its checksums.")
@json_option
def info_command(
    path: Path, overrides: tuple[str, ...], plugins: tuple[Path, ...], verify: bool, as_json: bool
) -> int | None:
    """Describe PATH: a scene (.toml), or a result (its directory or particles.vtkhdf).

    With --verify the exit code is 1 if a file has changed since it was written, or is missing.
    """
    if verify:
        if path.suffix == ".toml" or overrides or plugins:
            raise InputError(f"--verify is for results, datasets and exports, and {path} is not one; leave it out.")
        from mpmcli.dataset.dataset import is_dataset
        from mpmcli.dataset.export import is_export, verify_export
        from mpmcli.dataset.report import verify as verify_dataset
        from mpmcli.output.verify import verify_result

        whole = verify_export if is_export(path) else verify_dataset if is_dataset(path) else verify_result
        verification = whole(path)
        print_answer(verification, as_json)
        return 1 if verification.faults else 0
    if path.suffix == ".toml":
        facts = _scene_facts(path, overrides, plugins)
    else:
        if overrides or plugins:
            option = "--set changes" if overrides else "--plugin is for"
            raise InputError(f"{option} scenes, and {path} is not one; leave it out.")
        facts = _result_facts(path)
    if as_json:
        print_json(facts)
        return None
    known = {name: value for name, value in facts.items() if value not in (None, "", [], {})}
    width = max(len(name) for name in known)
    print_text("\n".join(f"{name.replace('_', ' '):<{width}}  {_plain(value)}" for name, value in known.items()))
    return None


def _scene_facts(path: Path, overrides: tuple[str, ...], plugins: tuple[Path, ...]) -> dict:
    """Return the facts of a scene, with the memory that its plan takes, bytes."""
    from mpmcli.materials.registry import load_plugins
    from mpmcli.scene import load_scene
    from mpmcli.solver.engine.plan import make_plan
    from mpmcli.solver.machine.backend import Backend

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


def _result_facts(path: Path) -> dict:
    """Return the facts of a result from its header, record, ledger and error bars."""
    from mpmcli.error_bars.bars import read_bars
    from mpmcli.output import open_result

    result = open_result(path)
    bars = read_bars(result.directory, result.times) or {}
    header, record, ledger = result.header, result.record or {}, result.ledger
    return {
        "title": header.title,
        "kind": result.kind,
        "status": result.status,
        "frames": result.frame_count,
        "frames_expected": record.get("frames_expected"),
        "time_s": [float(result.times[0]), float(result.times[-1])],
        "particles": int(result.particle_counts[-1]),
        "dimension": result.dimension,
        "bodies": list(header.body_names),
        "colliders": list(header.collider_names),
        "contacts": [" - ".join(pair) for pair in header.contacts],
        "materials": [law.name for law in header.laws],
        "fields": ["velocity", *result.field_names],
        "precision": header.precision,
        "backend": record.get("backend") or dict(header.backend) or None,
        "steps": record.get("steps"),
        "step_s": [
            min((row.step_min for row in ledger[1:]), default=0.0),
            max((row.step_max for row in ledger[1:]), default=0.0),
        ],
        "limits": record.get("limits", {}),
        "energy_J": [ledger[0].energy, ledger[-1].energy],
        "mass_kg": ledger[-1].mass,
        "volume_ratio": [min(row.volume_ratio_min for row in ledger), max(row.volume_ratio_max for row in ledger)],
        "headline": bars.get("headline"),
        "error_bars": bars.get("at_end"),
        "timings_s": record.get("timings", {}),
        "failure": (record.get("failure") or {}).get("message"),
        "version": header.version,
    }


def _plain(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_plain(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(_plain(item) for item in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


@click.command("doctor", epilog="Example: mpmcli doctor")
@json_option
def doctor_command(as_json: bool) -> int:
    """Test whether everything that mpmcli needs works on this machine.

    Python, Taichi and its backends, VTK and its window, libraries, disk and memory are tested, each in a separate
    process. Each gets one line, with a remedy for a fault. The exit code is 1 if a required part is broken; a missing
    GPU is not a fault.
    """
    from mpmcli.doctor.examination import CHECKS, examine

    width = max(map(len, CHECKS))
    checks = []
    for name, found in examine():
        checks.append({"name": name, "status": found.status, "detail": found.detail, "remedy": found.remedy})
        if not as_json:
            remedy = f"; {found.remedy}" if found.remedy else ""
            print_text(f"{found.status:<11}  {name:<{width}}  {found.detail}{remedy}")
    faults = [check["name"] for check in checks if check["status"] == "broken"]
    if as_json:
        print_json({"ok": not faults, "checks": checks})
    else:
        verdict = f"not everything that mpmcli needs works: {', '.join(faults)}" if faults else "everything works"
        print_text(f"\n{verdict}")
    return 1 if faults else 0
