"""Closes the result of a run whose process was ended by force."""

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from mpmcli.output.directory import TakenDirectory, has_frames
from mpmcli.output.durable import temporary_of, write_text
from mpmcli.output.lock import take_lock
from mpmcli.output.owner import time_now
from mpmcli.output.run_record import RECORD, read_record
from mpmcli.output.segments import PACKED


def close_abandoned(directory: Path, made: Sequence[Path], pid: int, signal: str) -> None:
    """Write into run.json that the run was interrupted; without a frame, remove what it has made.

    Args:
        made: the directories that did not exist before the run, outermost first.
        pid: of the process, which has ended; a result of another one is left as it is.
        signal: the name of the signal that asked for the end.

    Raises:
        InputError: another process writes the directory.
        OSError: the disk refuses.
    """
    if not directory.is_dir():
        return
    taken = TakenDirectory(directory, take_lock(directory), tuple(made))
    try:
        record = read_record(directory)
        process = (record or {}).get("process")
        ours = isinstance(process, dict) and process.get("pid") == pid and record["status"] == "running"
        if not has_frames(directory) and (ours or (record is None and made)):
            taken.undo()
        elif ours:
            # The packed file that it wrote beside the segments.
            with suppress(OSError):
                temporary_of(directory / PACKED).unlink(missing_ok=True)
            message = f"the run was interrupted ({signal}) and ended by force; its frames were left unpacked"
            failure = {"message": message, "signal": signal}
            closed = {**record, "status": "interrupted", "ended": time_now(), "failure": failure}
            write_text(directory / RECORD, json.dumps(closed, indent=2, ensure_ascii=False) + "\n")
    finally:
        taken.release()
