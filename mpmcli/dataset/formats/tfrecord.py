"""The format of DeepMind's "Learning to simulate", from which GNS comes, and which PhysicsNeMo reads."""

import struct
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
        """Write a SequenceExample per trajectory, with equal bytes in every process."""
        from tfrecord import example_pb2 as types
        from tfrecord.writer import TFRecordWriter

        def feature(value: bytes) -> types.Feature:
            return types.Feature(bytes_list=types.BytesList(value=[value]))

        with open(path, "wb") as file:
            for k, each in enumerate(chosen):
                key = types.Feature(int64_list=types.Int64List(value=[k]))
                context = {"key": key, "particle_type": feature(self.particle_types(each).tobytes())}
                frames = [feature(frame.astype("<f4").tobytes()) for block in each.whole_blocks() for frame in block]
                lists = types.FeatureLists(feature_list={"position": types.FeatureList(feature=frames)})
                example = types.SequenceExample(context=types.Features(feature=context), feature_lists=lists)
                # TFRecordWriter.write has keys in an order that differs from one process to the next.
                record = example.SerializeToString(deterministic=True)
                for piece in (struct.pack("<Q", len(record)), record):
                    file.write(piece)
                    file.write(TFRecordWriter.masked_crc(piece))
                tick()
