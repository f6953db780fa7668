"""Names of the files of a dataset."""

from mpmcli.dataset.shard import group_name

SWEEP, BASE = "sweep.toml", "base.toml"
SHARDS, PENDING, QUARANTINE = "shards", "pending", "quarantine"


def file_name(number: int) -> str:
    """Return the name of the file of a single trajectory, before it is in a shard or in quarantine."""
    return f"{group_name(number)}.h5"
