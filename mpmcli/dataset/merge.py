"""Joins the parts of a dataset that `mpmcli sweep --shard` has computed."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mpmcli.dataset.folder import (
    PROGRAM,
    Manifest,
    Row,
    copy_sources,
    is_beginning,
    require_empty,
    require_same_program,
)
from mpmcli.dataset.report import CARD, Status, status_of, verify, write_card
from mpmcli.dataset.shard import BASE, CERTIFICATES, IMAGES, QUARANTINE, SHARDS, SWEEP
from mpmcli.errors import InputError
from mpmcli.output.durable import require_free_space, sealed, write_text, writing
from mpmcli.output.lock import take_lock


def merge(parts: Sequence[Path], target: Path) -> Status:
    """Merge complete parts of one sweep into one dataset, or go on with a merge of the same parts that was killed.

    InputError, nothing written: a part or the target is unsuitable.
    """
    facts = [Manifest(part).facts() for part in parts]
    rows = [row for part in parts for row in Manifest(part).rows()]
    first = next((vars(row) for row in rows if row.verdict != "failed"), facts[0])
    for part, its in zip(parts, facts, strict=True):
        require_same_program(part, its, Manifest(part).rows(), {name: first[name] for name in PROGRAM if name in first})
        if {**its, "part": None} != {**facts[0], "part": None}:
            raise InputError(f"{part} has another sweep, other files or another version of mpmcli than {parts[0]}.")
    count = facts[0]["part"][1]
    there = sorted(its["part"][0] for its in facts)
    # A part beyond the last shard is empty and cannot be computed.
    shards = -(-facts[0]["count"] // facts[0]["per_shard"])
    needed = list(range(1, min(count, shards) + 1))
    if there != needed:
        missing = sorted(set(needed) - set(there))
        what = f"part {missing[0]}/{count} is missing" if missing else "a part is given twice"
        raise InputError(f"{what}: give each of the {len(needed)} parts once.")
    for part in parts:
        if faults := verify(part).faults:
            raise InputError(f"{part} cannot be merged: {faults[0]}")
    manifest, told = Manifest(target), {**facts[0], "part": [1, 1]}
    files = {
        target / file.relative_to(part): file
        for part in parts
        for names in (f"{SHARDS}/*.h5", f"{QUARANTINE}/*.h5", f"{CERTIFICATES}/*.json", f"{IMAGES}/*/**/*.*")
        for file in sorted(part.glob(names))
        if not (target / file.relative_to(part)).exists()
    }
    if manifest.path.exists() and not files and (target / CARD).exists():
        require_empty(target)
    _require_target(manifest, told, rows)
    target.mkdir(parents=True, exist_ok=True)
    with take_lock(target):
        _require_target(manifest, told, rows, locked=True)
        size = sum(file.stat().st_size for file in files.values())
        require_free_space(target, size, "the merged dataset", "the parts are kept", several=True)
        # The manifest comes first, so that a killed merge is recognised by the files that it lacks.
        if not manifest.path.exists():
            manifest.create(told)
        manifest.put(rows)
        with writing(target, "the parts are kept"):
            for copy, file in files.items():
                copy.parent.mkdir(parents=True, exist_ok=True)
                with sealed(copy, file.stat().st_size) as temporary:
                    shutil.copyfile(file, temporary)
            for name in (SWEEP, BASE):
                write_text(target / name, (parts[0] / name).read_text(encoding="utf-8"))
            copy_sources({name: parts[0] / name for name in facts[0].get("files", ())}, target)
        write_card(target)
    return status_of(target)


def _require_target(manifest: Manifest, facts: dict[str, Any], rows: Sequence[Row], *, locked: bool = False) -> None:
    """Refuse a directory that is neither empty nor holds a part of the merged dataset."""
    target = manifest.path.parent
    if not manifest.path.exists() and not is_beginning(target):
        require_empty(target, locked=locked)
    elif manifest.path.exists() and not (
        {**manifest.facts(), **facts} == manifest.facts() and {*manifest.rows()} <= {*rows}
    ):
        raise InputError(f"{target} holds another dataset: give another directory with -o.")
