"""Compiled kernels and FFT plans without a cache: they take longer, and nothing ends with a traceback."""

import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest

from device.recon.model.compiled import compiled
from device.recon.model.fft_plans import Planner
from services.resources import fft_plans
from tests.project_files import ROOT

SOURCE = "def {name}(x):\n    return x + 1\n"
ALLOCATING = """
import numpy as np

def doubled(x):
    y = np.empty(x.size)
    for i in range(x.size):
        y[i] = 2 * x[i]
    return y
"""
CACHED = """
import sys
sys.path.insert(0, sys.argv[1])
import numpy as np
from device.recon.model.compiled import compiled
from kernel import doubled
print(compiled(doubled)(np.ones(3)).sum(), "numba.typed.typeddict" in sys.modules)
"""
FULL_DISK = """
import resource, sys
sys.path.insert(0, sys.argv[1])
from device.recon.model.compiled import compiled
from kernel import added
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
print(compiled(added)(2))
"""


def test_a_kernel_without_a_folder_for_its_cache_is_compiled() -> None:
    """Numba knows no folder for code without a file, as for a read-only installation of a user without a home."""
    names: dict[str, object] = {}
    exec(SOURCE.format(name="added"), names)
    kernel = names["added"]
    assert callable(kernel)
    assert compiled(kernel)(2) == 3


def test_a_kernel_whose_cache_cannot_be_written_or_read_is_compiled(tmp_path: Path) -> None:
    """First on a full disk, then with a file that a power cut has emptied."""
    (tmp_path / "kernel.py").write_text(SOURCE.format(name="added"))
    words = [sys.executable, "-c", FULL_DISK, str(tmp_path)]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    for _ in range(2):
        done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (0, "3\n"), done.stderr
        assert "not cached" in done.stderr
        index = next((tmp_path / "cache").iterdir()) / "kernel.added-1.py311.nbi"
        index.touch()


def test_a_cached_kernel_is_loaded_without_the_compiler(tmp_path: Path) -> None:
    """A third of a second of every start; the kernel allocates, as Numba prepares its allocator with the compiler."""
    (tmp_path / "kernel.py").write_text(ALLOCATING)
    words = [sys.executable, "-c", CACHED, str(tmp_path)]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    done = [subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True) for _ in range(2)]
    assert [process.stdout for process in done] == ["6.0 True\n", "6.0 False\n"], done[1].stderr


@pytest.mark.parametrize(("kind", "side"), [("a file", 30), ("a folder", 34), ("no text", 38)])
def test_plans_that_cannot_be_read_or_written_are_measured(
    kind: str, side: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "plans"
    if kind == "a file":
        folder.write_text("here")
    else:
        Planner(folder, effort="FFTW_MEASURE").plan((side, 42))
        [wisdom] = folder.iterdir()
        wisdom.unlink()
        wisdom.mkdir() if kind == "a folder" else wisdom.write_bytes(b"\xff")
    with caplog.at_level(logging.WARNING):
        assert Planner(folder, effort="FFTW_MEASURE").plan((side, 46)).space.shape == (side, 46)
    assert "plan" in caplog.text


def test_a_user_without_a_home_keeps_no_plans() -> None:
    words = [sys.executable, "-c", "import services.resources; print(services.resources.fft_plans())"]
    environment = {"PATH": os.environ["PATH"], "HOME": "none"}
    assert subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True).stdout == "None\n"
    assert fft_plans() is not None
