"""Share of the machine that this process may use."""

import os


def usable_processors() -> int:
    """Count the processors that this process may use: all of the machine, unless its CPU affinity is limited."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
