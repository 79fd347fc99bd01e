"""Contiguous gaps on a whole sensor with a known field, through the default ladder: what the instrument runs.

A frame of 96 x 128 without a field has one shading mode and cannot show what 45 modes make of a hole. Limits are those
that a person would not notice: PCC at most .01 below the clean frame's (.02 where light is lost for good), a refraction
within three standard deviations or none, and no false message.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from device.recon.reconstructor import Reconstructor
from device.values import Mask, Reconstruction
from services.instrument.hard_cases import defects
from services.instrument.hard_cases.cases import saturated
from services.instrument.hard_cases.frames import Eye, HardFrame
from tests import scenes

EYE = Eye("relaxed eye", "sim", {"sim.seed": 2})
Within = Callable[[float, float], None]
Look = Callable[..., Reconstruction]


@pytest.fixture(scope="module")
def look() -> Look:
    """The default ladder for the head, planned anew only where other pixels are declared bad."""
    made: dict[bytes, Reconstructor] = {}

    def run(frame: HardFrame, bad: Mask | None = None) -> Reconstruction:
        key = b"" if bad is None else bad.tobytes()
        if key not in made:
            calibration = replace(EYE.clean.take.calibration, bad=bad)
            made[key] = Reconstructor(calibration, EYE.clean.take.shape, scenes.PLANNER, scenes.VirtualClock())
        return made[key](frame.raw, simulated=True)

    return run


def score(made: Reconstruction) -> float:
    take = EYE.clean.take
    return take.likeness(take.sampled(made.picture))


@pytest.fixture(scope="module")
def clean(look: Look) -> float:
    made = look(EYE.clean)
    assert made.report.warnings == ()
    return score(made)


def judge(made: Reconstruction, clean: float, limit: float, true: str, within: Within) -> None:
    within(clean - score(made), limit)
    eye = made.report.refraction_dpt
    if eye is not None:
        within(abs(eye["sphere"]) / eye["sd"], 3.0)  # the eye is relaxed
    assert not [words for words in made.report.warnings if not true or true not in words]


@pytest.mark.parametrize(("share", "limit"), [(0.012, 0.01), (0.021, 0.01), (0.043, 0.02)])
def test_saturated_light_costs_only_what_it_hides(
    share: float, limit: float, look: Look, clean: float, within: Within
) -> None:
    judge(look(saturated(share)(EYE)), clean, limit, "too bright", within)


def test_a_clipped_reflex_costs_only_what_it_hides(look: Look, clean: float, within: Within) -> None:
    frame = EYE.clean.with_raw(defects.glare(EYE.clean.raw, EYE.spec.camera, 0.003))
    judge(look(frame), clean, 0.02, "too bright", within)


GAPS = {"columns": defects.dead_columns, "rows": defects.dead_rows, "blob": defects.blob}


@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize("kind", ["declared", "0 DN"])
def test_a_contiguous_gap_is_no_part_of_the_picture(
    gap: str, kind: str, look: Look, clean: float, within: Within
) -> None:
    dead = GAPS[gap](EYE.clean.take.shape)
    frame = EYE.clean.with_raw(defects.read_as(EYE.clean.raw, dead, 0))
    judge(look(frame, dead if kind == "declared" else None), clean, 0.01, "pixel", within)


@pytest.mark.parametrize(("share", "more_dn"), [(0.0001, 1500), (0.001, 1500), (0.01, 300)])
def test_warm_pixels_that_nobody_marked_cost_nothing(
    share: float, more_dn: float, look: Look, clean: float, within: Within
) -> None:
    frame = EYE.clean.with_raw(defects.warm(EYE.clean.raw, EYE.spec.camera, share, more_dn / 4095))
    judge(look(frame), clean, 0.01, "pixel", within)


# Other eyes: the stored PSF is not theirs

HYPEROPIC = Eye("hyperopic eye", "sim", {"sim.seed": 261, "sim.eye.m_dpt": -3.14})


@pytest.fixture(scope="module")
def hyperopic() -> Reconstructor:
    take = HYPEROPIC.clean.take
    return Reconstructor(take.calibration, take.shape, scenes.PLANNER, scenes.VirtualClock())


def test_a_large_saturated_disc_of_a_hyperopic_eye_is_no_structure(hyperopic: Reconstructor, within: Within) -> None:
    """A prior that rises below its band amplified what the edge of the disc leaves there: it lost .07."""
    take = HYPEROPIC.clean.take
    clean, full = (hyperopic(frame.raw) for frame in (HYPEROPIC.clean, saturated(0.043)(HYPEROPIC)))
    within(take.likeness(take.sampled(clean.picture)) - take.likeness(take.sampled(full.picture)), 0.02)


def test_a_scratch_does_not_pull_the_refraction_towards_the_stored_psf(
    hyperopic: Reconstructor, within: Within
) -> None:
    """The gap is filled through the PSF of the last estimate, so the fit is repeated; fitted once it was 7 sd off."""
    rows, cols = np.indices(HYPEROPIC.clean.raw.shape)
    scratched = HYPEROPIC.clean.raw.copy()
    scratched[np.abs(0.8 * (rows - 560) + 0.6 * (cols - 900)) < 6] = 0
    clean, found = (hyperopic(counts).report.refraction_dpt for counts in (HYPEROPIC.clean.raw, scratched))
    assert clean is not None
    assert found is not None
    within(abs(found["sphere"] - clean["sphere"]) / found["sd"], 2.0)
