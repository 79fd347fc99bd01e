"""Start and memory: one reconstruction as a whole process, and the server after 18 presses of the simulated head.

Start: the commands of README.md; each row is the median of five processes, with kernels and FFT plans as its name says.
The processor time shows a change of the code on a busy machine, too. `before`: an idle machine with two cores, before
imports, kernels and freed memory were cared for.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.bench import timing
from tests.bench.attacks import ROOT, Instrument

TURNS, PRESSES = 5, 18
STARTS = (("compiled kernels and FFT plans", 2.8, 1.5), ("compiled kernels", 3.6, 2.0), ("neither", 13.0, 8.0))
RESIDENT_MB, PEAK_MB = 500.0, 600.0


def lean() -> None:
    """Print both tables."""
    with tempfile.TemporaryDirectory() as folder:
        _starts(Path(folder))
        _memory(Path(folder) / "data")


def _starts(folder: Path) -> None:
    scene = folder / "scene"
    _called(folder, "simulate", "healthy", "-o", str(scene))
    words = ("--psf", str(scene / "psf.tiff"), "--head", "healthy", "-o", str(folder / "picture.png"))
    timing.head("diffuscope reconstruct, whole process, s", "before", "median", "CPU", "limit")
    _called(folder, "reconstruct", str(scene / "raw.tiff"), *words)
    for name, before_s, limit_s in STARTS:
        taken = []
        for turn in range(1 if name == "neither" else TURNS):
            kernels = folder / f"no-kernels-{turn}" if name == "neither" else folder / "kernels"
            plans = folder / "plans" if "plans" in name else folder / f"no-plans-{name}-{turn}"
            taken.append(_called(folder, "reconstruct", str(scene / "raw.tiff"), *words, kernels=kernels, plans=plans))
        median_s, cpu_s = np.median(taken, axis=0)
        timing.row(name, before_s, float(median_s), float(cpu_s), limit=limit_s, value=float(median_s))


def _called(folder: Path, *words: str, kernels: Path | None = None, plans: Path | None = None) -> tuple[float, float]:
    """Return duration and processor time of a command in s, with the cached kernels and FFT plans of two folders."""
    caches = {"NUMBA_CACHE_DIR": kernels or folder / "kernels", "XDG_CACHE_HOME": plans or folder / "plans"}
    command = [str(Path(sys.executable).with_name("diffuscope")), *words]
    begin_s, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {name: str(place) for name, place in caches.items()}
    subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - begin_s, cpu_s


def _memory(data: Path) -> None:
    instrument = Instrument(ROOT, data)
    timing.head(f"memory of the server after {PRESSES} presses, MB", "before", "first", "MB", "limit")
    with instrument.running() as process:
        sizes = []
        for turn in range(PRESSES):
            instrument.ask("POST", "/api/captures", {"eye": ("OD", "OS")[turn % 2]})
            while instrument.ask("GET", "/api/status")["state"] != "aim":
                time.sleep(0.1)
            sizes.append(_size_mb(process.pid))
    (first, _), (resident, peak) = sizes[0], sizes[-1]
    timing.row("resident", 774.0, first, resident, limit=RESIDENT_MB, value=resident)
    timing.row("peak", 909.0, sizes[0][1], peak, limit=PEAK_MB, value=peak)


def _size_mb(process: int) -> tuple[float, float]:
    """Return resident memory of a process now and at its peak."""
    lines = dict(line.split(":", 1) for line in Path(f"/proc/{process}/status").read_text().splitlines())
    resident, peak = (int(lines[name].split()[0]) / 1024 for name in ("VmRSS", "VmHWM"))
    return resident, peak
