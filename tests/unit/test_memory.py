"""Memory that the server keeps: arrays that two parts need, once; packages that no press needs, not at all."""

import subprocess
import sys
import tracemalloc

from device.clock import SystemClock
from device.recon.assessment.psf_match_any_refraction import PsfMatchTest
from device.recon.burst import BurstJoiner
from device.recon.estimation.refraction.estimator import RefractionEstimator
from tests import changed_heads
from tests.changed_heads import calibrated, caustic_of_eye, dark, frame_through
from tests.project_files import ROOT
from tests.scenes import PLANNER

SHAPE = changed_heads.world().shape


def test_the_test_of_the_psf_shares_the_otf_of_the_refraction() -> None:
    """The oversampled OTF alone takes 10 MB at this size, the spectra of the field's modes as much."""
    estimator = RefractionEstimator(calibrated(), SHAPE, PLANNER, 0)
    tracemalloc.start()
    try:
        psf_check = PsfMatchTest(estimator)
        held_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert psf_check(frame_through(caustic_of_eye(0.0), 1, 1.0, 1), dark()) is not None
    assert held_bytes < 8e6


def test_a_frame_that_waits_for_its_burst_takes_five_bytes_a_pixel() -> None:
    joiner = BurstJoiner(calibrated(), SHAPE, PLANNER, SystemClock())
    seen = joiner.see(frame_through(caustic_of_eye(0.0), 1, 1.0, 1), dark())
    assert seen.light_dn.nbytes + seen.good.nbytes == 5 * SHAPE[0] * SHAPE[1]


def test_the_server_starts_without_the_package_of_a_calibration() -> None:
    """scipy.optimize takes 22 MB and a sixth of a second of each start."""
    asks = "import sys, services.http.server; print('scipy.optimize' in sys.modules, 'scipy.fft' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", asks], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "False True\n"


def test_a_command_does_not_search_what_it_imported_for_garbage() -> None:
    """Collections during a reconstruction would search the 200 000 objects of its packages each time."""
    asks = "import atexit, gc, sys; sys.argv[1:] = ['--version']; atexit.register(lambda: print(gc.get_freeze_count()))"
    words = [sys.executable, "-c", f"{asks}; from services.cli import main; main()"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    assert int(done.stdout.splitlines()[-1]) > 50_000
