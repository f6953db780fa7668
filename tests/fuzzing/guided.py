"""Inputs that reach new lines of mpmcli: bytes of one file, damaged by libFuzzer, which atheris calls for Python.

A program of its own, which scripts/fuzz starts: what is to be followed must not be imported before atheris.
"""

import os
import resource
import sys
from collections.abc import Iterator
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
with atheris.instrument_imports(include=["mpmcli.scene", "mpmcli.output", "mpmcli.dataset", "mpmcli.simulation"]):
    from fuzzing import seeds
    from fuzzing.campaign import MOST_BYTES, MOST_SECONDS, OUTPUTS, place
    from fuzzing.outcome import fault_of
    from fuzzing.targets import VTK, Input

CHECK = ("check", "scene.toml", "--no-probe")
# Files of an input that are damaged, and the commands that read it.
GUIDED = {
    "scene-text": (seeds.scenes, ("scene.toml",), (CHECK,)),
    "sweep": (seeds.sweeps, ("sweep.toml",), (("load-sweep", "sweep.toml"),)),
    "mesh": (seeds.meshes, (), (CHECK,)),
    "points": (seeds.points, (), (CHECK,)),
    "checkpoint": (seeds.checkpoints, (), (("checkpoints", "run"),)),
}


def run_guided(target: str, count: int, seed: int, directory: Path, findings: Path) -> None:
    """Run inputs of a target until one has a forbidden outcome, which is kept; does not return.

    Raises:
        KeyError: the target has no guided form.
    """
    made, names, commands = GUIDED[target]
    starts = [(files, name) for files in made() for name in _damaged_files(files, names)]
    known = directory / "known"
    known.mkdir(parents=True)
    for k, (files, name) in enumerate(starts):
        (known / str(k)).write_bytes(k.to_bytes(2) + files[name])
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 1)
    before = None

    def run(data: bytes) -> None:
        nonlocal before
        files, name = starts[int.from_bytes(data[:2]) % len(starts)]
        one = Input(files | {name: data[2:]}, commands)
        os.chdir("/")
        place(one, directory / "input", before)
        before = one.files
        os.chdir(directory / "input")
        for words in commands:
            if fault := fault_of(words):
                kept = findings / f"guided-{target}"
                place(one, kept)
                (kept / "fault.txt").write_text(f"{fault.kind}\n{words}\n{fault.detail}\n", encoding="utf-8")
                raise RuntimeError(fault.kind)

    with atheris.instrument_imports(include=["mpmcli.scene", "mpmcli.output", "mpmcli.dataset"]):
        # Commands import what they need.
        for path in known.iterdir():
            run(path.read_bytes())
    options = [f"-runs={count}", f"-seed={seed}", f"-timeout={MOST_SECONDS:.0f}", f"-rss_limit_mb={_most_megabytes()}"]
    atheris.Setup([sys.argv[0], *options, "-max_len=20000", f"-artifact_prefix={findings}/", str(known)], run)
    atheris.Fuzz()


def _damaged_files(files: seeds.Files, names: tuple[str, ...]) -> Iterator[str]:
    """Yield the files that libFuzzer damages: those named, or all but the scene and what VTK reads."""
    for name in files:
        if name in names or (not names and name != "scene.toml" and not name.endswith((*VTK, *OUTPUTS))):
            yield name


def _most_megabytes() -> int:
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    return used + MOST_BYTES // 2**20


if __name__ == "__main__":
    words = sys.argv[1:]
    run_guided(words[0], int(words[1]), int(words[2]), Path(words[3]), Path(words[4]))
