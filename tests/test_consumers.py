"""Programs of others read what mpmcli writes: datasets, mlcroissant, WebDataset, Zarr, GNS, NeuralMPM, pvpython.

MPMCLI_CONSUMERS names a directory of environments, as scripts/consumers makes them: `datasets` and `webdataset` with
those packages; `croissant` with mlcroissant and pyarrow; `gns` with numpy and GNS's data_loader.py, which takes from
torch its base class alone; `neuralmpm` with numpy, h5py and the parsers of NeuralMPM, which take tensors from torch.
pvpython is the one on the path. What is absent is skipped.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from command import run_here
from made_dataset import PAUSE, SPLITS, made_dataset, made_trajectory, write_dataset
from made_result import write_made
from made_sweep import COUNT, VERDICTS, made_workers, make_dataset  # noqa: F401

import mpmcli.dataset
from mpmcli.dataset.subsample import SubsampledTrajectory
from mpmcli.output import open_result

INPUTS = 6


def told(program: str | Path, code: str, *arguments: object) -> dict:
    """Run Python code in an interpreter with its own environment, and return the JSON that it prints last."""
    if not shutil.which(program):
        pytest.skip(f"{program} is absent")
    Path("read.py").write_text(code, encoding="utf-8")
    variables = {"PATH": os.environ["PATH"], "HOME": os.getcwd(), "HF_HUB_OFFLINE": "1"}
    words = [str(program), "read.py", *map(str, arguments)]
    outcome = subprocess.run(words, env=variables, capture_output=True, text=True, timeout=300, check=False)
    assert outcome.returncode == 0, outcome.stderr
    return json.loads(outcome.stdout.splitlines()[-1])


def environment(name: str) -> Path:
    """Return the interpreter of an environment."""
    return Path(os.environ.get("MPMCLI_CONSUMERS", "/absent"), name, "bin", "python")


DATASETS = """
import json, sys
from datasets import load_dataset
from huggingface_hub import DatasetCard
(config,) = DatasetCard.load(sys.argv[1] + "/README.md").data.to_dict()["configs"]
splits = {name: table.to_list() for name, table in load_dataset(sys.argv[1]).items()}
print(json.dumps({"card": [one["split"] for one in config["data_files"]], "splits": splits}))
"""


@pytest.mark.usefixtures("made_workers")
def test_load_dataset_has_the_splits_without_the_quarantine() -> None:
    """The numbers, draws and places of the included trajectories, split by split, as the card names them."""
    path = make_dataset("whole").resolve()
    opened, found = mpmcli.dataset.open(path), told(environment("datasets"), DATASETS, path)
    assert sorted(found["card"]) == sorted(found["splits"]) == sorted(opened.splits)
    for split, numbers in opened.splits.items():
        assert [row["number"] for row in found["splits"][split]] == list(numbers)
        assert all(json.loads(row["draws"]) == opened[row["number"]].draws for row in found["splits"][split])
    loaded = {row["number"] for rows in found["splits"].values() for row in rows}
    assert loaded == {*range(COUNT)} - {*VERDICTS} and any((path / "quarantine").iterdir())


PARQUET = """
import json, sys
from datasets import load_dataset
whole, found = load_dataset(sys.argv[1], cache_dir="cache"), {}
for split, rows in load_dataset(sys.argv[1], streaming=True).items():
    found[split] = list(rows)
    assert found[split] == whole[split].to_list()
    for row, arrays in zip(found[split], whole[split].with_format("numpy")):
        assert arrays["position"].tolist() == row["position"] and arrays["position"].dtype == "float32"
print(json.dumps({"splits": found, "position": repr(whole["train"].features["position"])}))
"""


@pytest.mark.parametrize("most", [None, 20], ids=["lists", "arrays"])
def test_load_dataset_reads_parquet_to_the_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int | None
) -> None:
    """Plain, streaming and as arrays of NumPy; numbers of particles that differ, and equal ones."""
    pytest.importorskip("pyarrow")
    monkeypatch.chdir(tmp_path)
    path, options = made_dataset(tmp_path / "set"), ["--max-particles", most] if most else []
    assert run_here("export", path, "--to", "parquet", "-o", tmp_path / "out", *options).status == 0
    found, dataset = told(environment("datasets"), PARQUET, tmp_path / "out"), mpmcli.dataset.open(path)
    assert found["position"].startswith("Array3D(shape=(11, 20, 2)" if most else "List(List(List(")
    for split, numbers in dataset.splits.items():
        assert [row["number"] for row in found["splits"][split]] == list(numbers)
        for row in found["splits"][split]:
            source = SubsampledTrajectory(dataset[row["number"]], most=most)
            assert json.loads(row["draws"]) == source.source.draws
            for name in ("position", "velocity", "pressure", "deformation_gradient"):
                np.testing.assert_array_equal(np.array(row[name], np.float32), source.read(name))
            assert row["time"] == source.times.tolist() and row["body"] == source.label("body").tolist()


CROISSANT = """
import json, sys
import mlcroissant
def records(name, **options):
    # A Dataset reads a record set once.
    found = mlcroissant.Dataset(sys.argv[1]).records(name, **options)
    plain = lambda value: value.decode() if isinstance(value, bytes) else value
    return [{key.rpartition("/")[2]: plain(value) for key, value in one.items()} for one in found]
metadata = mlcroissant.Dataset(sys.argv[1]).metadata
rows, position = next(one for one in metadata.record_sets if one.name == "trajectories"), "trajectories/position"
print(json.dumps({
    "errors": sorted(metadata.issues.errors), "warnings": sorted(metadata.issues.warnings),
    "files": {one.id: one.sha256 for one in metadata.file_objects},
    "shape": next(field.array_shape_tuple for field in rows.fields if field.id == position),
    "splits": records("splits"), "rows": records("trajectories"),
    "valid": [one["number"] for one in records("trajectories", filters={"trajectories/split": "valid"})],
}, default=lambda number: number.item()))
"""


def test_mlcroissant_reads_the_rows_of_parquet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every number of every column, splits, checksums; it misses but facts that a dataset of mpmcli does not have."""
    reader = pytest.importorskip("pyarrow.parquet")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mpmcli.dataset.formats.arrays.FILE_BYTES", 1)
    made = [made_trajectory(k, particles=30 - 6 * k, split=split) for k, split in enumerate(SPLITS)]
    # A trajectory without an array has null.
    del made[1].fields["pressure"]
    out = tmp_path / "out"
    assert run_here("export", write_dataset(tmp_path / "set", made), "--to", "parquet", "-o", out).status == 0
    found = told(environment("croissant"), CROISSANT, out / "croissant.json")
    unknown = ("citeAs", "datePublished", "license", "version")
    assert not found["errors"] and len(found["warnings"]) == len(unknown)
    assert all(f'/{name}" is recommended' in one for one, name in zip(found["warnings"], unknown, strict=True))
    sums = dict(line.split()[::-1] for line in (out / "checksums.sha256").read_text().splitlines())
    assert found["files"] == {name: digest for name, digest in sums.items() if name.endswith(".parquet")}
    assert found["shape"] == [11, -1, 2] and found["valid"] == [2]
    assert found["splits"] == [{"name": split} for split in ("train", "valid", "test")]
    tables = {file.name[:5].rstrip("-"): [] for file in out.glob("*.parquet")}
    for file in sorted(out.glob("*.parquet")):
        tables[file.name[:5].rstrip("-")] += reader.read_table(file).to_pylist()
    expected = [row | {"split": split} for split, rows in tables.items() for row in rows]
    by_number = {row["number"]: row for row in found["rows"]}
    assert len(by_number) == len(found["rows"]) == len(SPLITS)
    assert all(by_number[row["number"]] == row for row in expected) and by_number[1]["pressure"] is None


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_zarr_opens_a_group_for_each_trajectory(tmp_path: Path, dtype: type, monkeypatch: pytest.MonkeyPatch) -> None:
    """Consolidated, with all arrays, in chunks of frames, and with attributes as in metadata.json."""
    zarr = pytest.importorskip("zarr")
    # Two chunks of six frames of 30 particles, since 8 of 11 frames are as many as fit, written in blocks of four.
    monkeypatch.setattr("mpmcli.dataset.formats.zarr.CHUNK_BYTES", 8 * 30 * 2 * np.dtype(dtype).itemsize)
    monkeypatch.setattr("mpmcli.dataset.subsample.BLOCK_BYTES", 4 * 30 * 2 * np.dtype(dtype).itemsize)
    path = made_dataset(tmp_path / "set", dtype=dtype)
    assert run_here("export", path, "--to", "zarr", "-o", tmp_path / "out").status == 0
    store, dataset = zarr.open(tmp_path / "out" / "trajectories.zarr", mode="r"), mpmcli.dataset.open(path)
    assert store.metadata.zarr_format == 3 and store.metadata.consolidated_metadata
    assert sorted(store) == [f"{number:06d}" for number in dataset.numbers]
    metadata = json.loads((tmp_path / "out" / "metadata.json").read_text())
    assert dict(store.attrs).items() <= metadata.items() and store.attrs["dt"] == pytest.approx(PAUSE)
    for name, group in store.groups():
        source = dataset[int(name)]
        for array in ("position", "velocity", "pressure", "deformation_gradient", "body", "material"):
            np.testing.assert_array_equal(group[array][:], source.read(array))
            assert group[array].dtype == source.read(array).dtype
        for array, known in (("time", source.times), ("step", source.steps), ("frame", source.frames)):
            np.testing.assert_array_equal(group[array][:], known)
        assert (group.attrs["number"], group.attrs["split"]) == (source.number, source.split)
        assert all(group.attrs[key] == metadata[key][name] for key in ("laws", "bodies", "colliders", "draws"))
    assert store["000000/position"].chunks == (6, 30, 2) and store["000001/deformation_gradient"].chunks[0] == 4


GRAIN = """
import json, sys
import grain, mpmcli.dataset
windows = mpmcli.dataset.open(sys.argv[1]).windows("train", past=3, future=2, fields=["pressure"])
found = grain.MapDataset.source(windows).shuffle(seed=1).to_iter_dataset().mp_prefetch(
    grain.multiprocessing.MultiprocessingOptions(num_workers=2))
if __name__ == "__main__":
    print(json.dumps([{name: array.tolist() for name, array in window.items()} for window in found]))
"""


def test_grain_reads_windows_in_two_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of them, once each."""
    monkeypatch.chdir(tmp_path)
    path = made_dataset(tmp_path / "set")
    windows = mpmcli.dataset.open(path).windows("train", past=3, future=2, fields=["pressure"])
    found = {(one["trajectory"], one["time"][0]): one for one in told(environment("grain"), GRAIN, path)}
    assert len(found) == len(windows) > 10
    for window in windows:
        same = found[int(window["trajectory"]), float(window["time"][0])]
        for name, array in window.items():
            np.testing.assert_array_equal(np.array(same[name], array.dtype), array)


WEBDATASET = """
import json, sys
from webdataset import WebDataset
found = {}
for sample in WebDataset(sys.argv[1], shardshuffle=False).decode():
    arrays = {name: [array.dtype.str, array.tolist()] for name, array in sample["npz"].items()}
    found[sample["__key__"]] = {"arrays": arrays, "facts": sample["json"]}
print(json.dumps(found))
"""


def test_webdataset_reads_its_shards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two shards of a split, as its pattern of braces names them: arrays to the bit, and facts."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mpmcli.dataset.formats.arrays.FILE_BYTES", 1)
    dataset = mpmcli.dataset.open(made_dataset(tmp_path / "set"))
    assert run_here("export", dataset.path, "--to", "webdataset", "-o", tmp_path / "out").status == 0
    shards = "train-{00000..00001}-of-00002.tar"
    found = told(environment("webdataset"), WEBDATASET, tmp_path / "out" / shards)
    assert sorted(found) == [f"{number:06d}" for number in dataset.splits["train"]]
    for name, sample in found.items():
        source = dataset[int(name)]
        for array in ("position", "velocity", "pressure", "deformation_gradient", "body"):
            dtype, values = sample["arrays"][array]
            assert dtype == source.read(array).dtype.str
            np.testing.assert_array_equal(np.array(values, dtype), source.read(array))
        assert sample["arrays"]["time"][1] == source.times.tolist()
        known = {"number": source.number, "split": "train", "draws": source.draws, "laws": ["fluid", "sand"]}
        assert known.items() <= sample["facts"].items()


GNS = """
import json, sys
from types import SimpleNamespace as Name
sys.path.insert(0, sys.argv[1] + "/gns")
sys.modules["torch"] = Name(utils=Name(data=Name(Dataset=object)))
from data_loader import SamplesDataset
data = SamplesDataset(sys.argv[2], int(sys.argv[3]))
(position, kind, *feature, n), label = data[int(sys.argv[4])]
print(json.dumps({"length": len(data), "position": position.tolist(), "kind": kind.tolist(), "n": n,
                  "feature": [one.tolist() for one in feature], "label": label.tolist()}))
"""


@pytest.mark.parametrize("viscosity", [0.0, 0.5], ids=["alike", "a feature"])
def test_gns_reads_samples_with_its_own_loader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, viscosity: float
) -> None:
    """The last sample: inputs and label are those of the trajectory; a viscosity that differs is a feature."""
    monkeypatch.chdir(tmp_path)
    made = [made_trajectory(k, viscosity=viscosity * k, split=split) for k, split in enumerate(SPLITS)]
    path = write_dataset(tmp_path / "set", made)
    assert run_here("export", path, "--to", "gns", "-o", tmp_path / "out").status == 0
    positions = [mpmcli.dataset.open(path)[k].position for k in (0, 1)]
    length = sum(len(one) - INPUTS for one in positions)
    python = environment("gns")
    found = told(python, GNS, python.parents[1], tmp_path / "out" / "train.npz", INPUTS, length - 1)
    assert found["length"] == length and found["n"] == positions[1].shape[1]
    np.testing.assert_array_equal(np.array(found["label"], np.float32), positions[1][-1])
    inputs = positions[1][-1 - INPUTS : -1].transpose(1, 0, 2)
    np.testing.assert_array_equal(np.array(found["position"], np.float32), inputs)
    first = np.asarray(made[1].body) == 0
    assert found["kind"] == np.where(first, 5, 6).tolist()
    assert found["feature"] == ([np.where(first, viscosity, 0.0).tolist()] if viscosity else [])


NEURALMPM = """
import json, sys
from types import SimpleNamespace as Name
import numpy as np
class Tensor(np.ndarray):
    def long(self):
        return self.astype(np.int64)
def tensor(function):
    return lambda *args, **options: function(*args, **options).view(Tensor)
def cat(parts, dim=None, axis=None):
    return np.concatenate(parts, dim if axis is None else axis)
made = {"tensor": np.array, "cat": cat, "zeros": np.zeros, "ones": np.ones, "arange": np.arange}
sys.modules["torch"] = Name(float32=np.float32, **{name: tensor(made[name]) for name in made})
sys.modules["neuralmpm.pipelines"] = Name(visualisation=None)
sys.path.insert(0, sys.argv[1])
from neuralmpm.data.parsers.nmpm_parser import NMPMParser
metadata = json.load(open(sys.argv[2] + "/metadata.json"))
NMPMParser.get_num_types = lambda self: metadata["num_types"]
parser = NMPMParser(sys.argv[2], metadata["dim"], metadata["dt"], *zip(*metadata["bounds"]))
found = [parser.parse(int(k), split=sys.argv[3]) for k in sys.argv[4:]]
print(json.dumps([{name: array.tolist() for name, array in one.items()} for one in found]))
"""


@pytest.mark.parametrize("walls", ["none", "all"])
def test_neuralmpm_parses_trajectories_with_its_own_parser(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, walls: str
) -> None:
    """Positions and displacements of each particle, those on walls first; types; gravity, which differs."""
    monkeypatch.chdir(tmp_path)
    made, out = [made_trajectory(k) for k in range(2)], tmp_path / "out"
    made[1].header["scene"] = made[1].header["scene"].replace("gravity = [-1.0, -1.0]", "gravity = [0.0, -2.0]")
    path = write_dataset(tmp_path / "set", made)
    assert run_here("export", path, "--to", "neuralmpm", "-o", out, "--walls", walls).status == 0
    python = environment("neuralmpm")
    found = told(python, NEURALMPM, python.parents[1], out, "train", 0, 1)
    assert [one["grav"] for one in found] == [[-1.0, -1.0], [0.0, -2.0]]
    for one, source in zip(found, made, strict=True):
        types, state = np.array(one["types"]), np.array(one["sim"], np.float32)
        own = types > 0
        assert (walls == "all") == (not own.all()) and (not own[0]) == (walls == "all")
        assert types[own].tolist() == (1 + source.material).tolist()
        np.testing.assert_array_equal(state[:, own, :2], source.position[1:])
        np.testing.assert_array_equal(state[:, own, 2:], np.diff(source.position, axis=0))
        assert not state[:, ~own, 2:].any()


PARAVIEW = """
import json, sys
from paraview import servermanager
from paraview.simple import OpenDataFile, UpdatePipeline
reader, found = OpenDataFile(sys.argv[1]), []
for time in reader.TimestepValues:
    UpdatePipeline(time=time, proxy=reader)
    blocks = servermanager.Fetch(reader)
    piece = blocks.GetBlock(0) if hasattr(blocks, "GetBlock") else blocks
    points = [piece.GetPoint(i) for i in range(piece.GetNumberOfPoints())]
    found.append({"time": time, "points": points})
print(json.dumps(found))
"""


def test_pvpython_reads_every_frame_of_the_vtk_export(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_made(tmp_path / "run", dimension=3)
    assert run_here("export", path, "--to", "vtk", "-o", tmp_path / "out").status == 0
    found, frames = told("pvpython", PARAVIEW, tmp_path / "out" / "000000.pvd"), list(open_result(path).frames())
    assert [one["time"] for one in found] == pytest.approx([frame.time for frame in frames])
    for one, frame in zip(found, frames, strict=True):
        np.testing.assert_array_equal(np.array(one["points"], np.float32), frame.position)
