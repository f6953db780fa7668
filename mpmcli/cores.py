"""The processor cores that this process may use."""

import math
import os
from pathlib import Path

# Where Linux tells what share of the processor a container may use: quota and period, in one file or in two.
QUOTAS = (
    ("/sys/fs/cgroup/cpu.max",),
    ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"),
)


def available_cores() -> int:
    """Return how many cores this process may use, fewer than the machine has where it is confined to some.

    A container's share of the processor counts in whole cores, rounded up.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for files in QUOTAS:
        try:
            quota, period = " ".join(Path(file).read_text(encoding="ascii") for file in files).split()
            # "max" or -1 where there is no limit.
            if int(quota) > 0:
                cores = min(cores, math.ceil(int(quota) / int(period)))
        except (OSError, ValueError):
            continue
    return cores
