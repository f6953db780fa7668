"""The start of a scene as a result of one frame, for a picture before the run."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mpmcli.frames.frame import STATUS, Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader
from mpmcli.output.result import Result, open_result
from mpmcli.output.store import SegmentStore
from mpmcli.render.settings import Arrow
from mpmcli.scene import Scene, sample_bodies, scene_to_toml
from mpmcli.scene.colliders import Collider, Plane
from mpmcli.scene.expression import evaluate
from mpmcli.scene.schema import Emitter
from mpmcli.scene.sheets import sheets_of

PARALLEL = 0.9  # cosine above which an axis is too near to that of a rotation to be an arm
NOTHING_YET = dict.fromkeys(("kinetic", "elastic", "potential", "mass", "speed_max", "courant_max"), 0.0)


@contextmanager
def result_of_start(scene: Scene) -> Iterator[tuple[Result, tuple[Arrow, ...]]]:
    """Yield the start of a scene as a result, in a directory that is removed afterwards, and what moves in it.

    Of each emitter the first layer is there. Raises InputError as `sample_bodies` does.
    """
    sources, found, d = scene.sources, sample_bodies(scene), scene.dimension
    names = sorted({source.material.law for source in sources})
    counts = [len(one.position) for one in found]
    there, arrows = [], []
    for source, one in zip(sources, found, strict=True):
        shown, velocity = len(one.position), one.velocity.mean(axis=0)
        if isinstance(source, Emitter):
            sheets = sheets_of(source, scene)
            shown, velocity = sheets.size * sheets.per_layer, np.array(source.velocity)
        there.append(np.arange(len(one.position)) < shown)
        arrows.append((one.position[:shown].mean(axis=0), velocity))
    for collider in scene.colliders:
        arrows += _motion_of(collider, d)
    frame = Frame(
        0,
        0.0,
        0,
        np.concatenate([one.position for one in found]).astype(np.float32),
        np.concatenate([np.broadcast_to(one.velocity, one.position.shape) for one in found]).astype(np.float32),
        np.repeat(np.arange(len(sources), dtype=np.int32), counts),
        np.repeat(np.array([names.index(source.material.law) for source in sources], np.int32), counts),
        {STATUS: np.concatenate(there).astype(np.int8)} if scene.comes_and_goes else {},
    )
    zero = (0.0,) * d
    row = LedgerRow(
        0.0, 0, 0.0, 0.0, "", volume_ratio_min=1.0, volume_ratio_max=1.0,
        linear_momentum=zero, angular_momentum=(0.0,) * (1 if d == 2 else 3), **NOTHING_YET,
    )  # fmt: skip
    header = RunHeader.of(
        scene, scene_to_toml(scene), [laws()[name] for name in names], {"precision": scene.solver.precision}
    )
    with TemporaryDirectory() as directory:
        store = SegmentStore(Path(directory), header.stored, colliders=scene.colliders)
        store.write(frame, row)
        store.finish()
        moving = [(place, velocity) for place, velocity in arrows if velocity.any()]
        yield open_result(directory), tuple((tuple(x.tolist()), tuple(v.tolist())) for x, v in moving)


def _motion_of(collider: Collider, d: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return places of a collider and their velocities at the start: its pivot, and its rim where it turns."""
    pivot = collider.motion.pose(0.0)[0]
    if collider.free:
        velocity = np.array(collider.rates[:d])
        spin = np.array([0.0, 0.0, collider.spin[0]] if d == 2 else collider.spin)
    else:
        rates = [evaluate(one, {"t": 0.0}) for one in collider.motion.rates]
        velocity, spin = np.array(rates[:d], np.float64), np.array(collider.motion.axis) * rates[d]
    arrows = [(pivot, velocity)]
    if spin.any() and not isinstance(collider.form, Plane):
        axis = spin / np.linalg.norm(spin)
        along = next(a for a in np.eye(3) if abs(a @ axis) < PARALLEL)
        across = np.cross(axis, np.cross(along, axis))
        across /= np.linalg.norm(across)
        half = 0.5 * float(np.ptp(collider.form.bounds(), axis=0) @ np.abs(across[:d]))
        arm = half * across
        arrows.append((pivot + arm[:d], velocity + np.cross(spin, arm)[:d]))
    return arrows
