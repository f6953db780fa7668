"""Export of a dataset to what learners, numpy and ParaView read."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from mpmcli.dataset import export_gns, export_lagrangebench, export_npz, export_vtkhdf
from mpmcli.dataset.dataset import Dataset
from mpmcli.dataset.export_directory import METADATA, check_export_directory, new_directory, seal_export
from mpmcli.dataset.facts import common_facts
from mpmcli.dataset.shard import SPLITS
from mpmcli.dataset.thinned import SEED, ThinnedTrajectory
from mpmcli.dataset.walls import Walls
from mpmcli.errors import InputError, RunError
from mpmcli.output.durable import require_free_space
from mpmcli.plain_json import finite_json
from mpmcli.plain_text import counted, size_text

# Each module has check, size and write.
FORMATS: dict[str, ModuleType] = {
    "lagrangebench": export_lagrangebench,
    "gns": export_gns,
    "npz": export_npz,
    "vtkhdf": export_vtkhdf,
}


@dataclass(frozen=True)
class ExportSettings:
    """What is exported, and where to.

    Attributes:
        form: a key of FORMATS.
        directory: made, or replaced if it is empty or, with `overwrite`, an earlier export.
        trajectory: number of the one to export, all if None.
        stride: every how many frames one is taken.
        max_particles: of each trajectory, None for all.
        walls: which have particles; wall_spacing: between these, m, None for that of the particles.
    """

    form: str
    directory: Path
    trajectory: int | None = None
    stride: int = 1
    max_particles: int | None = None
    overwrite: bool = False
    walls: Walls = "none"
    wall_spacing: float | None = None


@dataclass(frozen=True)
class ExportSummary:
    """What was written.

    Attributes:
        trajectories: how many, by split.
        frames, particles: most of a trajectory.
        bytes: of all files.
        notes: what the user should know of it.
    """

    directory: str
    form: str
    files: list[str]
    trajectories: dict[str, int]
    frames: int
    particles: int
    bytes: int
    notes: list[str]

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self)

    def text(self) -> str:
        """Return it as a line of text."""
        count = sum(self.trajectories.values())
        splits = ", ".join(f"{split} {number}" for split, number in self.trajectories.items() if number)
        noun = "trajectory" if count == 1 else "trajectories"
        return (
            f"{self.directory}: {count} {noun} ({splits}) of up to {counted(self.frames, 'frame')} and "
            f"{counted(self.particles, 'particle')}, {size_text(self.bytes)} as {self.form}"
        )


def export(
    dataset: Dataset, settings: ExportSettings, watch: Callable[[int], None] = lambda done: None
) -> ExportSummary:
    """Write a directory with a dataset in another format, and metadata.json; all of it, or nothing.

    Args:
        watch: called with the number of trajectories written, after each one.

    Raises:
        InputError: the directory is in use, there is no such trajectory, or the format cannot hold the dataset; nothing
            was written.
        RunError: the disk is full or refuses; nothing was left.
    """
    directory, form = Path(settings.directory), FORMATS[settings.form]
    check_export_directory(directory, settings.overwrite)
    numbers: Sequence[int] = dataset.numbers if settings.trajectory is None else [settings.trajectory]
    chosen = [
        ThinnedTrajectory(
            dataset[number], settings.stride, settings.max_particles, settings.walls, settings.wall_spacing
        )
        for number in numbers
    ]
    for each in chosen:
        if each.particle_count == 0 or each.frame_count == 0:
            raise InputError(f"trajectory {each.source.number} of {dataset.path} is empty: there is nothing to export.")
    metadata = common_facts(chosen, settings.stride)
    if any(each.particle_count < each.source.particle_count for each in chosen):
        metadata["particle_seed"] = SEED
    form.check(chosen)
    for each in chosen:
        _require_sound_walls(each)
    there = next(parent for parent in directory.resolve().parents if parent.exists())
    what, kept = f"the export to {directory}", "nothing was written"
    require_free_space(there, form.size(chosen), what, kept, several=True)
    if settings.walls != "none":
        metadata["wall_spacing"] = max(each.walls.spacing for each in chosen)
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        watch(done)

    try:
        with new_directory(directory, settings.overwrite) as temporary:
            more, notes = form.write(temporary, chosen, tick)
            text = json.dumps(finite_json(metadata | more), indent=2, allow_nan=False) + "\n"
            (temporary / METADATA).write_text(text, encoding="utf-8", newline="\n")
            seal_export(temporary)
            files = {path.name: path.stat().st_size for path in sorted(temporary.iterdir())}
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RunError(f"{directory} could not be written ({reason}); nothing of it was left.") from error
    return ExportSummary(
        directory=str(directory),
        form=settings.form,
        files=list(files),
        trajectories={split: metadata[f"num_trajs_{split}"] for split in SPLITS},
        frames=max(each.frame_count for each in chosen),
        particles=metadata["num_particles_max"],
        bytes=sum(files.values()),
        notes=notes,
    )


def _require_sound_walls(trajectory: ThinnedTrajectory) -> None:
    """Refuse walls that are not known, and more particles on them than fit into memory.

    Raises:
        InputError: so.
    """
    walls, number = trajectory.walls, trajectory.source.number
    if walls.walls == "none":
        return
    lost = set(walls.header.collider_names) - {collider.name for collider in walls.colliders}
    if lost:
        raise InputError(f'the collider "{min(lost)}" of trajectory {number} cannot be read: leave --walls out.')
