"""What a part is: tasks, each of which measures one row, and the time that the part may take."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module

# How large the measurements are: for a test, for a device that the CPU emulates, for a GPU.
SCALES = ("tiny", "small", "full")


@dataclass(frozen=True)
class Setup:
    """What a part is measured with.

    Attributes:
        arch: of the device, "cuda", "vulkan" or "cpu".
        scale: one of SCALES.
    """

    arch: str
    scale: str

    def sized(self, tiny: object, small: object, full: object) -> object:
        """Return the value of the scale."""
        return {"tiny": tiny, "small": small, "full": full}[self.scale]


@dataclass(frozen=True)
class Task:
    """One row of a part.

    Attributes:
        key: its name, unique in the part.
        measure: (seconds left) -> the row, which JSON can hold; {"skipped": "a reason"} where it cannot be measured.
        prepare: begins what other processes can do meanwhile; called for all tasks before the first is measured.
    """

    key: str
    measure: Callable[[float], dict]
    prepare: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class Part:
    """A part.

    Attributes:
        name: of the part, its module and its file.
        title: heading in the report.
        seconds: that it may take before the parts after it had their turn.
    """

    name: str
    title: str
    seconds: float

    def tasks(self, setup: Setup) -> Sequence[Task]:
        """Return the tasks, those that are worth most first."""
        return import_module(f"gpu_parts.{self.name}").tasks(setup)

    def section(self, rows: dict[str, dict]) -> str:
        """Return the rows as Markdown."""
        return import_module(f"gpu_parts.{self.name}").section(rows)


# In the order in which they are worth most; the largest runs come last. With the report they are eight files, the most
# that some services bring back.
PARTS = (
    Part("environment", "Environment", 40),
    Part("tests", "Tests marked gpu", 150),
    Part("agreement", "Agreement with the CPU", 110),
    Part("limits", "Limits of the device", 60),
    Part("bench", "Speed", 180),
    Part("datasets", "Small runs at once", 90),
    Part("largest", "Largest runs", 200),
)
