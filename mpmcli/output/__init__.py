"""Frames on disk: stores that write them, results that read them, and the record of a run."""

from mpmcli.output.directory import check_directory
from mpmcli.output.result import Result, open_result
from mpmcli.output.run_record import RunRecord, read_record
from mpmcli.output.store import SegmentStore

__all__ = ["Result", "RunRecord", "SegmentStore", "check_directory", "open_result", "read_record"]
