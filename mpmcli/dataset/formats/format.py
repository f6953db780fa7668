"""What each format of an export states and does."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

from mpmcli.dataset.subsample import SubsampledTrajectory
from mpmcli.extras import imported

# Entries of a format in metadata.json, and notes for the user.
Written = tuple[dict[str, Any], list[str]]


class Format(ABC):
    """Writes trajectories of one dimension as files of a format.

    Attributes:
        files: pattern of the names of its files.
        package, extra: a package that it needs, and the extra of mpmcli that installs it; None if it needs none.
    """

    files: ClassVar[str]
    package: ClassVar[str | None] = None
    extra: ClassVar[str | None] = None

    def __init__(self, trajectories: Sequence[SubsampledTrajectory], features: tuple[str, ...] | None = None) -> None:
        """Raise an InputError if a package is missing.

        `features` are the material parameters that GNS gets, None for those that differ.
        """
        if self.package and self.extra:
            imported(self.package, self.extra, f"--to {type(self).__name__.lower()}")
        self.trajectories, self._features = trajectories, features

    def check(self) -> None:  # noqa: B027
        """Raise an InputError for trajectories that the format cannot store."""

    @abstractmethod
    def size(self) -> int:
        """Return the bytes of the files before compression."""

    @abstractmethod
    def write(self, directory: Path, tick: Callable[[], None]) -> Written:
        """Write the files, and call `tick` after each trajectory."""
