"""Memory of freed arrays: it returns to the system, also where later arrays are still in use."""

import subprocess
import sys

from tests.project_files import ROOT

FREED = """
from pathlib import Path
import numpy as np
from services.instrument.allocator import return_freed_arrays

def resident_mb():
    return int(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0]) / 1024

if {called}:
    return_freed_arrays()
np.ones(1 << 20)  # 8 MB: once freed, glibc keeps arrays of this size in its heap
before = resident_mb()
arrays = [np.ones(1 << 20) for _ in range(20)]
del arrays[:19]
print(round(resident_mb() - before))
"""


def kept_mb(called: bool) -> int:
    words = [sys.executable, "-c", FREED.format(called=called)]
    return int(subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout)


def test_the_memory_of_freed_arrays_returns_to_the_system() -> None:
    assert kept_mb(called=True) < 16, "8 MB are in use"
    assert kept_mb(called=False) > 100, "the default of glibc, without which the call is superfluous"
