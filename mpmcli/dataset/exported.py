"""Reads the trajectories of an export, of any format that mpmcli writes, and GNS and LagrangeBench files of others."""

import io
import json
import pickle
import re
import struct
import tarfile
import zipfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpmcli.dataset.shard import SPLITS, group_name
from mpmcli.errors import InputError
from mpmcli.extras import imported
from mpmcli.frames.frame import ACTIVE, STATUS

# Formats by the names of their files; _ is a split, and of a series only the first file counts.
FILES = {r"_\.(npz|tfrecord)": "gns", r"_\.h5": "lagrangebench", "_": "neuralmpm", r"_-.*\.tar": "webdataset"}
FILES |= {r"trajectories\.zarr": "zarr", r"_-.*\.parquet": "parquet", r"\d{6,}\.(npz|vtkhdf|usdc)": "numbered"}
FILES |= {r"\d{6,}\.pvd": "series", r"\d{6,}.0+\.ply": "series"}
NUMBERED = ("numbered", "series", "webdataset", "zarr")


class _Arrays(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Return what makes an array; UnpicklingError: anything else, as files of others are data and never run."""
        if module.split(".")[0] == "numpy" and name in ("_reconstruct", "ndarray", "dtype", "scalar", "_frombuffer"):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is no array")


def _read(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name and the arrays of each trajectory in a file or a store."""
    if path.suffix == ".npz" and path.stem in SPLITS:
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                with archive.open(name) as file:
                    np.lib.format.read_magic(file)
                    np.lib.format.read_array_header_1_0(file)
                    entries = _Arrays(file).load()
                # One trajectory under its name, or all under gns_data.
                for k, entry in enumerate([entries] if getattr(entries[0], "ndim", 1) == 3 else entries):
                    kind = np.resize(entry[1], entry[0].shape[1] if np.ndim(entry[1]) == 0 else len(entry[1]))
                    yield name.removesuffix(".npy") + f"[{k}]" * (k > 0), {"position": entry[0], "kind": kind}
    elif path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as file:
            yield path.stem, dict(file)
    elif path.suffix == ".h5":
        with h5py.File(path) as file:
            for name in file:
                yield name, {"position": file[name]["position"][:], "kind": file[name]["particle_type"][:]}
    elif path.suffix == ".tar":
        with tarfile.open(path) as archive:
            for member in archive:
                if member.name.endswith(".npz") and (content := archive.extractfile(member)):
                    with np.load(io.BytesIO(content.read()), allow_pickle=False) as file:
                        yield member.name.removesuffix(".npz"), dict(file)
    elif path.suffix == ".zarr":
        for name, group in sorted(imported("zarr", "zarr", "dataset audit").open_group(path, mode="r").groups()):
            yield name, {key: array[...] for key, array in group.arrays()}
    elif path.suffix == ".parquet":
        table = imported("pyarrow.parquet", "huggingface", "dataset audit").ParquetFile(path)
        for batch in table.iter_batches(batch_size=1):
            row = {name: column[0] for name, column in zip(batch.schema.names, batch.columns, strict=True)}
            arrays = {name: _unnested(one) for name, one in row.items() if hasattr(one, "values") and one.is_valid}
            yield str(row["number"]), arrays
    elif path.suffix == ".vtkhdf":
        with h5py.File(path) as file:
            points, frames = file["VTKHDF"], len(file["VTKHDF/Steps/Values"])
            arrays = {"position": points["Points"], **points["PointData"]}
            yield path.stem, {name: one[:].reshape(frames, -1, *one.shape[1:]) for name, one in arrays.items()}
    elif path.suffix in (".pvd", ".ply"):
        name, suffix = path.stem.split("_")[0], path.suffix.replace("pvd", "vtu")
        yield name, _stacked([_of_mesh(each) for each in sorted(path.parent.glob(f"{name}_[0-9]*{suffix}"))])
    elif path.suffix == ".usdc":
        stage = imported("pxr.Usd", "usd", "dataset audit").Stage.Open(str(path))
        points, frames = stage.GetPrimAtPath("/World/Particles"), []
        labels = [name for name in points.GetPropertyNames() if name.startswith("primvars:")]
        keys = {"position": "points", "velocity": "velocities", "id": "ids"} | {name[9:]: name for name in labels}
        for code in points.GetAttribute("points").GetTimeSamples():
            frames.append({key: np.array(points.GetAttribute(name).Get(code)) for key, name in keys.items()})
        yield path.stem, _stacked(frames)
    elif path.suffix == ".tfrecord":
        types = imported("tfrecord.example_pb2", "tfrecord", "dataset audit")
        with path.open("rb") as file:
            while head := file.read(12):
                example = types.SequenceExample.FromString(file.read(struct.unpack("<Q", head[:8])[0]))
                file.seek(4, io.SEEK_CUR)
                kind = np.frombuffer(example.context.feature["particle_type"].bytes_list.value[0], np.int64)
                frames = [f.bytes_list.value[0] for f in example.feature_lists.feature_list["position"].feature]
                x = np.frombuffer(b"".join(frames), np.float32).reshape(len(frames), len(kind), -1)
                yield str(example.context.feature["key"].int64_list.value[0]), {"position": x, "kind": kind}
    else:
        for sim in sorted(path.glob("sim_*.h5"), key=lambda p: int(p.stem[4:])):
            with h5py.File(sim) as file:
                known = {key: file[key][:] for key in ("boundary", "grav") if key in file}
                yield sim.stem, known | {"position": file["particles"][:], "kind": file["types"][:]}


def _unnested(row: Any) -> np.ndarray:
    """Return the array of nested lists of pyarrow."""
    values, shape = row.values, [len(row)]
    while hasattr(values, "flatten") and hasattr(values.type, "value_type"):
        inner = values.flatten()
        shape, values = [*shape, len(inner) // max(len(values), 1)], inner
    return values.to_numpy(zero_copy_only=False).reshape(shape)


def _of_mesh(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of one frame in a .vtu or a .ply; `meshio.read` would end the process on a damaged one."""
    from meshio import ply, vtu

    mesh = (ply if path.suffix == ".ply" else vtu).read(path)
    found = {"position": mesh.points, **mesh.point_data}
    if {"vx", "vy", "vz"} <= found.keys():
        found["velocity"] = np.stack([found.pop(name) for name in ("vx", "vy", "vz")], axis=1)
    return found


def _stacked(frames: list[dict[str, np.ndarray]]) -> dict[str, Any]:
    """Return arrays, (T, N, ...), and labels, (N,), from those of the particles that are there, which `id` names."""
    count = 1 + max(int(frame["id"].max(initial=-1)) for frame in frames)
    found: dict[str, np.ndarray] = {STATUS: np.full((len(frames), count), ACTIVE + 1)}
    for t, frame in enumerate(frames):
        rows = frame["id"].astype(int)
        for name, array in ({STATUS: np.full(len(rows), ACTIVE)} | frame).items():
            label = array.dtype.kind in "iu" and name != STATUS
            shape = (*([] if label else [len(frames)]), count, *array.shape[1:])
            whole = found.setdefault(name, np.zeros(shape, array.dtype))
            (whole if label else whole[t])[rows] = array
    return found


def trajectories(directory: Path) -> Iterator[tuple[str, str, str, dict[str, Any], dict[str, Any], dict[str, Any]]]:
    """Yield name, split, format, arrays, facts and own facts of the trajectories of an export, one at a time.

    Raises:
        InputError: it is none, or a file cannot be read.
    """
    path, form = directory / "metadata.json", "JSON"
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
        meta |= meta.get("train", {})
        numbers, count = meta.get("trajectories") or {}, Counter[str]()
        files = {path: form for names, form in FILES.items() for path in sorted(directory.iterdir())
                 if re.fullmatch(names.replace("_", "(train|valid|test)"), path.name)}  # fmt: skip
        for path, form in files.items():
            for name, arrays in _read(path):
                split = re.split(r"\W", path.name)[0]
                if form in NUMBERED:
                    number = int(name)
                    split = next((each for each in SPLITS if number in numbers.get(each, ())), "train")
                else:
                    number = dict(enumerate(numbers.get(split, ()))).get(count[split], -1)
                count[split] += 1
                # Files for ParaView and Blender have three components.
                d = min(arrays["position"].shape[2], meta.get("dim") or 3)
                arrays |= {key: arrays[key][..., :d] for key in ("position", "velocity") if key in arrays}
                group = group_name(number)
                own = {key: facts[group] for key, facts in meta.items() if isinstance(facts, dict) and group in facts}
                if arrays["position"].dtype.kind != "f" or (meta.get("bounds") and np.shape(meta["bounds"]) != (d, 2)):
                    raise ValueError(f"{name} has no positions as floats, or bounds are not a pair per component")
                yield (f"{path.name}/{name}", split, form, arrays, meta, own)
    except InputError:
        raise
    except Exception as error:
        # Whatever a reader of another package raises: the file is not what its name says.
        raise InputError(f"{path} cannot be read as {form} of an export ({error}).") from error
    if not files:
        raise InputError(f"{directory} holds no trajectories in a format that mpmcli export writes.")
