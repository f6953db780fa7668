"""The formats of exports: one file each, loaded on use; docs/architecture.md says how to add one."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpmcli.dataset.formats.format import Format

# Name for --to; module and class; files and their readers, for --help and docs/exports.md, which load no modules.
FORMATS = {
    "lagrangebench": ("lagrangebench.LagrangeBench", "train.h5, valid.h5, test.h5 for LagrangeBench"),
    "gns": ("gns.Gns", "train.npz, valid.npz, test.npz for GNS"),
    "tfrecord": ("tfrecord.TfRecord", "train.tfrecord, valid.tfrecord, test.tfrecord of Learning to simulate"),
    "neuralmpm": ("neuralmpm.NeuralMpm", "train/sim_0.h5 and so on for NeuralMPM"),
    "npz": ("npz.Npz", "a file of plain arrays per trajectory, for NumPy"),
    "parquet": ("parquet.Parquet", "a table per split, README.md and croissant.json, for load_dataset of Hugging Face"),
    "zarr": ("zarr.Zarr", "a store of Zarr 3, a group per trajectory, chunked by frames"),
    "webdataset": ("webdataset.Webdataset", "archives of .npz and .json per split, for WebDataset"),
    "vtkhdf": ("vtk.Vtkhdf", "a result per trajectory, for ParaView and every command of mpmcli"),
    "vtk": ("vtk.Vtk", "a .vtu per frame and a .pvd, for ParaView before 5.12"),
    "usd": ("usd.Usd", "a .usdc per trajectory with colliders as meshes, for Omniverse, Houdini and Blender"),
    "ply": ("ply.Ply", "a file of points per frame, and of colliders as meshes, for Blender, Houdini, trimesh and VTK"),
}


def format_named(name: str) -> "type[Format]":
    """Return the class of a format."""
    module, kind = FORMATS[name][0].split(".")
    return getattr(import_module(f"{__name__}.{module}"), kind)
