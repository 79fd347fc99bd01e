"""What the report of a corrected frame holds: its corrections, and the duration of the solutions beside the picture."""

from dataclasses import replace

import numpy as np

from device.clock import VirtualClock
from device.recon.corrections import Solution
from device.recon.frame_run import Asked, EyePsf, FrameRun
from device.recon.stage import Recipe
from tests import scenes

SHAPE = (96, 128)


def solution(solve_s: float) -> Solution:
    make = scenes.reconstructor(scenes.calibration(scenes.speckle(SHAPE)), SHAPE, Recipe("gradient"))
    counts = np.random.default_rng(0).integers(500, 1500, SHAPE).astype(np.uint16)
    asked = Asked(None, simulated=True, rounds=None, quick=False, eye_psf=EyePsf.STORED)
    made = make(counts)
    made = replace(made, report=replace(made.report, seconds={"solve": solve_s}))
    return Solution(FrameRun(make.stages[0], make.defects, VirtualClock(), asked, counts), made)


def test_solutions_that_are_not_used_are_in_the_duration() -> None:
    whole, steady, worse, spotless = (solution(seconds) for seconds in (1.0, 2.0, 4.0, 8.0))
    found = whole.choice(steady, [steady]).with_correction("flicker", 0.05)
    found = found.choice(found, [worse])
    found = found.choice(spotless, [spotless]).with_correction("spots", 0.01, "Clean the sensor.")
    report = found.picture.report
    assert report.seconds == {"solve": 8.0, "correct": 7.0}
    assert (report.quality["flicker"], report.quality["spots"]) == (0.05, 0.01)
    assert report.warnings[-1] == "Clean the sensor."


def test_a_frame_without_corrections_keeps_its_report() -> None:
    whole = solution(1.0)
    assert whole.choice(whole, []).picture.report == whole.made.report
