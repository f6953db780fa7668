"""The format of DeepMind's "Learning to simulate", from which GNS comes, and which PhysicsNeMo reads."""

from collections.abc import Callable, Sequence
from pathlib import Path

from mpmcli.dataset.formats.format import Written
from mpmcli.dataset.formats.gns import Gns
from mpmcli.dataset.subsample import SubsampledTrajectory


class TfRecord(Gns):
    """train.tfrecord, valid.tfrecord and test.tfrecord: a tf.SequenceExample for each trajectory.

    Source: github.com/google-deepmind/deepmind-research, learning_to_simulate/reading_utils.py. The context has `key`,
    int64, and `particle_type`, the bytes of (N,) int64; the feature list `position` has for each frame the bytes of
    (N, d) float32. `sequence_length` does not count the last frame. Types are those of `Gns`.
    """

    files = r"(train|valid|test)\.tfrecord"
    name, suffix = "Learning to simulate", ".tfrecord"
    package = extra = "tfrecord"

    def __init__(self, trajectories: Sequence[SubsampledTrajectory], features: tuple[str, ...] | None = None) -> None:
        """Its loader takes no material parameters: `features` are none."""
        super().__init__(trajectories, ())

    def facts(self) -> Written:
        return {"sequence_length": self.trajectories[0].frame_count - 1}, []

    def write_split(self, path: Path, chosen: Sequence[SubsampledTrajectory], tick: Callable[[], None]) -> None:
        from tfrecord.writer import TFRecordWriter

        writer = TFRecordWriter(str(path))
        try:
            for k, each in enumerate(chosen):
                context = {"key": (k, "int"), "particle_type": (self.particle_types(each).tobytes(), "byte")}
                frames = [frame.astype("<f4").tobytes() for block in each.whole_blocks() for frame in block]
                writer.write(context, {"position": (frames, "byte")})
                tick()
        finally:
            writer.close()
