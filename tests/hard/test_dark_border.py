"""Dark borders of a small pupil, a lid or an uneven lamp: the refraction finds the lit disc, and is as good as without.

20 eyes of -4 to 4 dpt on two sensors are lit to 0.93 of the field, sharply or softly; further ones to 0.85 and 0.97, by
a pupil beside the axis, and with a lid.
"""

import numpy as np
import pytest

from device.clock import VirtualClock
from device.recon.reconstructor import Reconstructor
from device.values import Report
from tests import scenes
from tests.hard.frames import Eye, Shade, above_dark

FIELD_DEG = 33.4
EYES = 20
MAX_RMS_DPT, MAX_REFUSED = 0.15, 2
MAX_SDS, USUAL_SDS, MAX_UNUSUAL = 5.0, 3.0, 1  # none beyond the first, few beyond the second
PEAK_E = {"sim": 15000.0, "imx296": 8000.0}


def lit(share: float, soft_deg: float, right_deg: float = 0.0) -> Shade:
    """Return the shade of a disc with light in `share` of the field, with its centre `right_deg` off the axis."""
    radius_deg = share * FIELD_DEG / 2
    return lambda right, down: np.clip((radius_deg - np.hypot(right - right_deg, down)) / soft_deg + 0.5, 0, 1)


def report(head: str, m_dpt: float, seed: int, shade: Shade | None) -> Report:
    """Return the report of a bright frame of a drawn eye."""
    changes = {"sim.eye.m_dpt": m_dpt, "sim.seed": seed, "sim.peak_e": PEAK_E[head]}
    frame = Eye(head, head, changes, 2).frame(shade=shade)
    calibration = frame.simulated.staged.calibration
    return Reconstructor(calibration, frame.raw.shape, scenes.PLANNER, VirtualClock(), timed=False)(frame.raw).report


def errors(reports: dict[float, Report]) -> tuple[list[float], list[float]]:
    """Return error in dpt, and error over its standard deviation, of the reports (by M) with a refraction."""
    errors_dpt, sds = [], []
    for m_dpt, made in reports.items():
        eye = made.refraction_dpt or {}
        sphere_dpt, sd_dpt = eye.get("sphere"), eye.get("sd")
        if isinstance(sphere_dpt, float) and isinstance(sd_dpt, float):
            errors_dpt.append(sphere_dpt + m_dpt)
            sds.append((sphere_dpt + m_dpt) / sd_dpt)
    return errors_dpt, sds


def test_a_dark_border_costs_no_refraction() -> None:
    eyes = {}
    for k, m_dpt in enumerate(np.linspace(-4, 4, EYES).tolist()):
        eyes[m_dpt] = report(("sim", "imx296")[k % 2], m_dpt, k + 1, lit(0.93, (0.02, 0.5)[k // 2 % 2]))
    errors_dpt, sds = errors(eyes)
    assert EYES - len(errors_dpt) <= MAX_REFUSED
    assert np.sqrt(np.mean(np.square(errors_dpt))) <= MAX_RMS_DPT
    assert np.max(np.abs(sds)) <= MAX_SDS
    assert np.count_nonzero(np.abs(sds) > USUAL_SDS) <= MAX_UNUSUAL
    assert not any("PSF" in warning for made in eyes.values() for warning in made.warnings)


@pytest.mark.parametrize("head", ["sim", "imx296"])
@pytest.mark.parametrize(
    "shade",
    [None, lit(0.97, 0.3), lit(0.85, 0.5), lit(0.9, 0.5, 1.5), above_dark(-12.0)],
    ids=["full", "0.97", "0.85", "pupil", "lid"],
)
def test_other_borders(head: str, shade: Shade | None) -> None:
    eyes = {m_dpt: report(head, m_dpt, 31, shade) for m_dpt in (-4.0, 1.5)}
    errors_dpt, sds = errors(eyes)
    assert len(errors_dpt) == len(eyes)
    assert np.max(np.abs(errors_dpt)) <= MAX_RMS_DPT
    assert np.max(np.abs(sds)) <= USUAL_SDS
