"""Universal Scene Description, for Omniverse, Isaac, Houdini and Blender."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.dataset.formats.format import Written
from mpmcli.dataset.formats.vtk import Vtkhdf, stored_frames
from mpmcli.dataset.shard import LABELS, group_name
from mpmcli.dataset.subsample import SubsampledTrajectory
from mpmcli.frames.frame import ACTIVE, STATUS
from mpmcli.output.layout import POSITION
from mpmcli.scene.surface import collider_surface


class Usd(Vtkhdf):
    """A .usdc per trajectory: the particles as Points and each collider as a mesh, curves in 2D, with its pose.

    Lengths are in metres. Up is Y in 2D, and in 3D that of Y and Z along which gravity acts on average, Z without. A
    time code is the number of a frame; particles that wait or have gone are left out; `ids` name them. Scalar fields,
    `body` and `material` are primvars of a vertex.
    """

    files = r"\d{6,}\.usdc"
    package, extra = "pxr", "usd"

    def size(self) -> int:
        return sum(e.particle_count * e.layout.bytes_per_particle * e.frame_count for e in self.trajectories)

    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        """Write a stage per trajectory: metres, seconds, a time code for each frame number."""
        from pxr import Usd as Stage
        from pxr import UsdGeom

        for each in self.trajectories:
            header, codes = each.source.header, each.frames.tolist()
            rate = (codes[-1] - codes[0]) / ((each.times[-1] - each.times[0]) or 1.0) or 1.0
            stage = Stage.Stage.CreateNew(str(directory / f"{group_name(each.source.number)}.usdc"))
            gravity = np.abs(np.zeros(3) if header.mean_gravity is None else header.mean_gravity)
            UsdGeom.SetStageUpAxis(stage, "Y" if header.dimension == 2 or gravity[1] > gravity[2] else "Z")
            UsdGeom.SetStageMetersPerUnit(stage, 1.0)
            stage.SetTimeCodesPerSecond(rate)
            stage.SetFramesPerSecond(rate)
            stage.SetStartTimeCode(codes[0])
            stage.SetEndTimeCode(codes[-1])
            world = UsdGeom.Xform.Define(stage, "/World")
            stage.SetDefaultPrim(world.GetPrim())
            _write_particles(stage, each, codes)
            for k in range(len(each.source.colliders)):
                _write_collider(stage, each, k, codes)
            stage.GetRootLayer().Save()
            tick()
        return {}, []


def _write_particles(stage: Any, trajectory: SubsampledTrajectory, codes: list[int]) -> None:
    """Write positions, velocities, ids and fields of the particles present, at a time code for each frame."""
    from pxr import Sdf, UsdGeom, Vt

    points = UsdGeom.Points.Define(stage, "/World/Particles")
    points.CreateWidthsAttr(Vt.FloatArray([trajectory.spacing or 1.0]))
    points.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    primvars = UsdGeom.PrimvarsAPI(points)
    kinds = {"i": Sdf.ValueTypeNames.IntArray, "f": Sdf.ValueTypeNames.FloatArray}
    for code, (_, _, arrays) in zip(codes, stored_frames(trajectory), strict=True):
        rows = arrays[STATUS] == ACTIVE if STATUS in arrays else slice(None)
        own = {name: np.ascontiguousarray(array[rows]) for name, array in arrays.items() if name != STATUS}
        position, velocity, ids = (own.pop(name) for name in (POSITION, "velocity", "id"))
        points.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(position.astype(np.float32)), code)
        points.GetVelocitiesAttr().Set(Vt.Vec3fArray.FromNumpy(velocity.astype(np.float32)), code)
        points.GetIdsAttr().Set(Vt.Int64Array.FromNumpy(ids.astype(np.int64)), code)
        points.GetExtentAttr().Set(_extent(position), code)
        for name, array in own.items():
            if array.ndim == 1:
                kind = "i" if name in LABELS else "f"
                primvar = primvars.CreatePrimvar(name, kinds[kind], UsdGeom.Tokens.vertex)
                made = Vt.IntArray if kind == "i" else Vt.FloatArray
                primvar.Set(made.FromNumpy(array.astype(np.int32 if kind == "i" else np.float32)), code)


def _write_collider(stage: Any, trajectory: SubsampledTrajectory, k: int, codes: list[int]) -> None:
    """Write the surface of collider k, in 2D its outline, and its pose at each time code if it moves."""
    from pxr import Gf, Tf, UsdGeom, Vt

    header, collider = trajectory.source.header, trajectory.source.colliders[k]
    surface = collider_surface(collider, header.origin, header.upper)
    d, (m, corners) = header.dimension, surface.cells.shape
    path = f"/World/{Tf.MakeValidIdentifier(collider.name)}"
    kind = UsdGeom.Mesh if d == 3 else UsdGeom.BasisCurves
    shape = kind.Define(stage, path)
    x = np.zeros((len(surface.points), 3), np.float32)
    x[:, :d] = surface.points
    if d == 3:
        shape.CreateFaceVertexCountsAttr(Vt.IntArray([corners] * m))
        shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(surface.cells.astype(np.int32).ravel()))
        shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    else:
        x = x[surface.cells.ravel()]
        shape.CreateTypeAttr(UsdGeom.Tokens.linear)
        shape.CreateCurveVertexCountsAttr(Vt.IntArray([corners] * m))
        shape.CreateWidthsAttr(Vt.FloatArray([0.1 * (header.spacing or 1.0)]))
        shape.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(x))
    shape.CreateExtentAttr(_extent(x))
    pose = shape.AddTransformOp()
    times = zip(codes, trajectory.times.tolist(), strict=True) if collider.motion.moves else [(None, 0.0)]
    for code, time in times:
        # USD multiplies rows: a row of the matrix is the image of a unit vector.
        placed = collider.motion.placed(np.vstack([np.zeros(d), np.eye(d)]), time)
        matrix = np.eye(4)
        matrix[3, :d], matrix[:d, :d] = placed[0], placed[1:] - placed[0]
        pose.Set(Gf.Matrix4d(matrix.tolist()), *([] if code is None else [code]))


def _extent(points: np.ndarray) -> Any:
    """Return the corners of the box around points, (n, 3)."""
    from pxr import Vt

    corners = [points.min(axis=0), points.max(axis=0)] if len(points) else np.zeros((2, 3))
    return Vt.Vec3fArray.FromNumpy(np.array(corners, np.float32))
