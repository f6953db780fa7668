"""Threads that share the work of a run of a batch inside one launch.

The first thread leads: it publishes a phase, and all threads claim parts of it until none is left. Each begins with
those of its own region, which its cache holds, and goes on with those of others. A thread that the system has set aside
delays the others by the part at most that it has claimed.
"""

from mpmcli.quick_taichi import ti
from mpmcli.solver.engine.cpu_phases import CpuPhases

# Words that threads share, of 8 bytes: what is published, the number of a phase, its kind and its parts; then, each on
# a cache line of its own, the parts done, whether the launch is over with the number of threads that work, and of each
# region the parts claimed, behind the number of the phase.
NUMBER, PHASE, PARTS, DONE, OVER, PRESENT, CLAIMED = 0, 1, 2, 8, 16, 17, 24
LINE = 8
# Bits of a claim below the number of the phase, which counts up to MOST_NUMBER: more than a phase has parts.
BITS, MASK, MOST_NUMBER = 31, 0x7FFFFFFF, 0x7FFFFFFF
# Times that a thread looks in vain for a part in its own region before it takes one of another, whose data then move
# from cache to cache.
RESPECT = 150
# Times that a thread looks for a part in vain before it leaves the launch, some milliseconds: the thread that leads has
# been set aside, and waits for this core perhaps.
LOOKS_IN_VAIN = 200_000


@ti.data_oriented
class CpuThreads:
    """What threads tell each other.

    phases: what they work on. regions: of a run, one for each thread that shares it.
    """

    def __init__(self, phases: CpuPhases, runs: int) -> None:
        self.phases, self.regions = phases, phases.regions
        self.stride = CLAIMED + LINE * self.regions
        self.words = ti.field(ti.i64, shape=runs * self.stride)

    @ti.func
    def open(self, w: int):
        """Begin a launch, before any thread works: nothing is published, so that no part can be claimed."""
        word = w * self.stride
        for region in range(self.regions):
            self.words[word + CLAIMED + LINE * region] = MASK
        self.words[word + PARTS] = 0
        self.words[word + DONE] = 0
        self.words[word + OVER] = 0
        self.words[word + PRESENT] = 0

    @ti.func
    def enter(self, w: int):
        """Begin to work."""
        ti.atomic_add(self.words[w * self.stride + PRESENT], 1)

    @ti.func
    def leave(self, w: int):
        """Work no more in this launch: others take all of the region."""
        ti.atomic_add(self.words[w * self.stride + PRESENT], -1)

    @ti.func
    def publish(self, w: int, phase: int):
        """Let all threads work on a phase; none works on another one."""
        word = w * self.stride
        number = (self.words[word + NUMBER] + 1) & MOST_NUMBER
        parts = 0
        for region in range(self.regions):
            parts += self.phases.parts_of(phase, region)
        self.words[word + NUMBER] = number
        self.words[word + PHASE] = phase
        self.words[word + PARTS] = parts
        self.words[word + DONE] = 0
        # The claims must be the last to change. Two atomic operations in a row let no write pass on any processor: what
        # is written before the first one ends before the second one begins (the order of ARM's acquire and release).
        ti.atomic_add(self.words[word + DONE], 0)
        ti.atomic_add(self.words[word + DONE], 0)
        for region in range(self.regions):
            self.words[word + CLAIMED + LINE * region] = number << BITS
        ti.atomic_add(self.words[word + CLAIMED], 0)

    @ti.func
    def finished(self, w: int):
        """Return whether every part of the phase that was published is done."""
        word = w * self.stride
        return ti.atomic_add(self.words[word + DONE], 0) >= self.words[word + PARTS]

    @ti.func
    def close(self, w: int):
        """Let the other threads end."""
        ti.atomic_max(self.words[w * self.stride + OVER], 1)

    @ti.func
    def is_open(self, word: int, region: int, claimed: ti.i64):
        """Return whether a claim is one of a part that nobody has done, of the phase that is published."""
        parts = self.phases.parts_of(ti.cast(self.words[word + PHASE], int), region)
        return claimed >> BITS == self.words[word + NUMBER] and (claimed & MASK) < parts

    @ti.func
    def help(
        self, w: int, t: int, idle: int, numbers: ti.template(), counts: ti.template(), frame_buffer: ti.template()
    ):
        """Let thread t do a part of the phase that is published, if one is left.

        idle: times in a row that it has found none. Returns 1 where it did, 0 where none was left, and -1 where the
        launch is over.
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
                # What is published stays as it is as long as a part that was claimed is not done.
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
