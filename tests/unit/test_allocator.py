"""Memory of freed arrays: it returns to the system, also where later arrays are still in use."""

import subprocess
import sys

import pytest

from tests.project_files import ROOT

FREED = """
from pathlib import Path
import numpy as np
from services.instrument.allocator import return_freed_arrays

def resident_mb():
    return int(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0]) / 1024

if {called}:
    return_freed_arrays()
np.ones({frame})  # once freed, glibc keeps arrays of this size in its heap
before = resident_mb()
arrays = [np.ones({frame}) for _ in range(20)]
del arrays[:19]
print(round(resident_mb() - before))
"""


def kept_mb(frame: str, called: bool) -> int:
    words = [sys.executable, "-c", FREED.format(frame=frame, called=called)]
    return int(subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout)


@pytest.mark.parametrize(("frame", "frame_mb"), [("(1080, 1920), np.float32", 8), ("(1080, 1920), np.uint16", 4)])
def test_the_memory_of_freed_frames_returns_to_the_system(frame: str, frame_mb: int) -> None:
    assert kept_mb(frame, called=True) < 2 * frame_mb, "one frame is in use"
    assert kept_mb(frame, called=False) > 12 * frame_mb, "the default of glibc, without which the call is superfluous"
