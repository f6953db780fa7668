"""Threads that share the work of one run inside a launch.

The first thread is the leader: it publishes a phase, and all threads claim parts of it until none is left. Each thread
starts with the parts of its own region, which are in its cache, and continues with those of other regions. A thread
suspended by the operating system delays the others by at most the part that it has claimed.
"""

from mpmcli.quick_taichi import ti
from mpmcli.solver.engine.cpu_phases import CpuPhases

# Shared words of 8 bytes: the published phase (its sequence number, the phase, and its number of parts); then, on
# separate cache lines, the number of finished parts; whether the launch is over, with the number of active threads; and
# for each region the number of claimed parts, with the sequence number in the upper bits.
NUMBER, PHASE, PARTS, DONE, OVER, PRESENT, CLAIMED = 0, 1, 2, 8, 16, 17, 24
LINE = 8
# Bits of a claim below the sequence number, which counts up to MOST_NUMBER; they exceed the parts of any phase.
BITS, MASK, MOST_NUMBER = 31, 0x7FFFFFFF, 0x7FFFFFFF
# Number of unsuccessful searches for a part in its own region before a thread takes a part of another region, whose
# data must move between caches.
RESPECT = 150
# Number of unsuccessful searches (some milliseconds) before a thread leaves the launch, because the leader may be
# suspended and waiting for this core.
LOOKS_IN_VAIN = 200_000


@ti.data_oriented
class CpuThreads:
    """Communication between the threads of a run.

    Attributes:
        phases: phases of the run.
        regions: number of regions of a run, one per thread.
        words: shared words of each run.
    """

    def __init__(self, phases: CpuPhases, runs: int) -> None:
        self.phases, self.regions = phases, phases.regions
        self.stride = CLAIMED + LINE * self.regions
        self.words = ti.field(ti.i64, shape=runs * self.stride)

    @ti.func
    def open(self, w: int):
        """Start a launch, before any thread works: no phase is published, so that no part can be claimed."""
        word = w * self.stride
        for region in range(self.regions):
            self.words[word + CLAIMED + LINE * region] = MASK
        self.words[word + PARTS] = 0
        self.words[word + DONE] = 0
        self.words[word + OVER] = 0
        self.words[word + PRESENT] = 0

    @ti.func
    def enter(self, w: int):
        """Register a thread as active."""
        ti.atomic_add(self.words[w * self.stride + PRESENT], 1)

    @ti.func
    def leave(self, w: int):
        """Unregister a thread; others take the parts of its region."""
        ti.atomic_add(self.words[w * self.stride + PRESENT], -1)

    @ti.func
    def publish(self, w: int, phase: int):
        """Publish a phase to all threads, when no thread works on another phase."""
        word = w * self.stride
        number = (self.words[word + NUMBER] + 1) & MOST_NUMBER
        parts = 0
        for region in range(self.regions):
            parts += self.phases.parts_of(phase, region)
        self.words[word + NUMBER] = number
        self.words[word + PHASE] = phase
        self.words[word + PARTS] = parts
        self.words[word + DONE] = 0
        # The claims must change last. Two consecutive atomic operations are a write barrier on any processor: writes
        # before the first one are complete before the second one starts (acquire and release order of ARM).
        ti.atomic_add(self.words[word + DONE], 0)
        ti.atomic_add(self.words[word + DONE], 0)
        for region in range(self.regions):
            self.words[word + CLAIMED + LINE * region] = number << BITS
        ti.atomic_add(self.words[word + CLAIMED], 0)

    @ti.func
    def finished(self, w: int):
        """Return whether all parts of the published phase are finished."""
        word = w * self.stride
        return ti.atomic_add(self.words[word + DONE], 0) >= self.words[word + PARTS]

    @ti.func
    def close(self, w: int):
        """Let the other threads leave the launch."""
        ti.atomic_max(self.words[w * self.stride + OVER], 1)

    @ti.func
    def is_open(self, word: int, region: int, claimed: ti.i64):
        """Return whether a claim refers to an unclaimed part of the published phase."""
        parts = self.phases.parts_of(ti.cast(self.words[word + PHASE], int), region)
        return claimed >> BITS == self.words[word + NUMBER] and (claimed & MASK) < parts

    @ti.func
    def process_part(
        self, w: int, t: int, idle: int, numbers: ti.template(), counts: ti.template(), frame_buffer: ti.template()
    ):
        """Process one part of the published phase in thread t, if any is left.

        `idle` is the number of preceding unsuccessful searches. Returns 1 if a part was processed, 0 if none was left,
        and -1 if the launch is over.
        """
        word = w * self.stride
        found, turn, region, part = 0, 0, 0, 0
        turns = 1
        if idle >= RESPECT or self.words[word + PRESENT] < self.regions:
            turns = self.regions
        while turn < turns and found == 0:
            region = (t + turn) % self.regions
            place = word + CLAIMED + LINE * region
            if self.is_open(word, region, ti.atomic_add(self.words[place], 0)):
                claimed = ti.atomic_add(self.words[place], 1)
                # The published phase does not change while a claimed part is unfinished.
                if self.is_open(word, region, claimed):
                    found = 1
                    part = ti.cast(claimed & MASK, int)
            turn += 1
        if found == 1:
            self.phases.do(0, w, ti.cast(self.words[word + PHASE], int), region, part, t, numbers, counts, frame_buffer)
            ti.atomic_add(self.words[word + DONE], 1)
        elif ti.atomic_add(self.words[word + OVER], 0) == 1:
            found = -1
        return found
