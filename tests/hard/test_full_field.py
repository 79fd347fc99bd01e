"""Contiguous gaps on a whole sensor with a known field, through the default ladder: what the instrument runs.

A frame of 96 x 128 without a field has one shading mode and cannot show what 45 modes make of a hole. Limits are those
that a person would not notice: PCC at most .01 below the clean frame's (.02 where light is lost for good), a refraction
within three standard deviations or none, and no false message.
"""

from collections.abc import Callable
from dataclasses import replace

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
