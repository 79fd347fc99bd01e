"""Trial lenses before an eye: vergences against traced rays, fit and limits, and the offset from head to report."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from device.calibration.archive import Archive, Provenance
from device.calibration.trial_lenses import (
    TRIAL_LENSES,
    LensReading,
    TrialLensFit,
    fit_trial_lenses,
    refuse_beyond_limits,
)
from device.clock import SystemClock, VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.errors import CalibrationRefused, SpecError
from device.optics.trial_lens import EMMETROPIC, PowerVector, TrialLens, correction_behind
from device.recon.estimation.refraction.correction import corrected
from device.recon.estimation.refraction.estimator import Cylinder, Refraction
from device.recon.estimation.refraction.field import FieldEdge
from device.recon.estimation.refraction.notation import report_of, sphere_cylinder
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.sim.simulated_calibration import simulated_calibration
from device.values import Calibration, Psf, RefractionOffset, Sensor
from services.instrument.trial_lens_measurement import LensBench, alignment_remedy, keep_offset
from services.workshop.check_head import with_archive
from services.workshop.trial_lens_check import calibrate_with_lenses, table
from tests import scenes
from tests.scenes import speckle
from tests.simulated import coarse, exposed_counts, small_head_toml, with_keys, world

SIM = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"
VERTEX_MM = 12.0
SDS = PowerVector(0.05, 0.03, 0.03)
WHO = Provenance("DS-7", datetime.now(UTC), "a test", "0.1.0", figures=(("prnu", 0.004),))


@pytest.mark.parametrize("lens", [*TRIAL_LENSES, TrialLens(3.0, -1.5, 75.0)])
@pytest.mark.parametrize("eye", [PowerVector(), PowerVector(-2.0, 0.5, -0.3)])
def test_lens_and_eye_together_have_the_vergence_of_traced_rays(lens: TrialLens, eye: PowerVector) -> None:
    """Paraxial rays with a height and an angle: they leave the pupil, cross the lens, and are drawn back."""
    heights_m = np.array([[1e-3, 0.0, 7e-4], [0.0, 1e-3, -4e-4]])
    angles = eye.matrix @ heights_m  # an eye that needs +1 dpt lets light diverge
    at_lens_m = heights_m + VERTEX_MM / 1000 * angles
    bent = angles - lens.power.matrix @ at_lens_m
    back_m = at_lens_m - VERTEX_MM / 1000 * bent
    seen = correction_behind(lens, VERTEX_MM, eye).matrix
    assert seen @ back_m == pytest.approx(bent, abs=1e-12)


def test_a_lens_has_the_power_vector_of_its_prescription() -> None:
    lens = TrialLens(-1.25, -2.0, 30.0)
    assert sphere_cylinder(*lens.power) == pytest.approx(lens)
    assert correction_behind(TrialLens(5.0), VERTEX_MM).m_dpt == pytest.approx(-5 / 1.06)
    assert correction_behind(TrialLens(-5.0), VERTEX_MM).m_dpt == pytest.approx(5 / 0.94)


def readings(
    off: PowerVector = EMMETROPIC,
    slope: float = 1.0,
    turned_deg: float = 0.0,
    stronger_dpt: float = 0.0,
    seed: int | None = None,
) -> list[LensReading]:
    """Return the readings of a head with these errors; with a seed, with noise of the stated sds."""
    draw = np.random.default_rng(seed)
    found = []
    for lens in TRIAL_LENSES:
        shown = lens
        if lens.cylinder_dpt:
            shown = TrialLens(stronger_dpt / 2, lens.cylinder_dpt - stronger_dpt, lens.axis_deg + turned_deg)
        m, j0, j45 = correction_behind(shown, VERTEX_MM)
        noise = draw.normal(0, SDS) if seed is not None else np.zeros(3)
        values = np.array([slope * m, j0, j45]) + off + noise
        found.append(LensReading(lens, PowerVector(*values.tolist()), SDS))
    return found


def test_the_fit_finds_offset_slope_and_axis_of_a_head() -> None:
    fit = fit_trial_lenses(readings(PowerVector(0.3, -0.1, 0.05), slope=1.03, turned_deg=4.0), VERTEX_MM)
    off = fit.offset
    assert (off.m_dpt, off.j0_dpt, off.j45_dpt) == pytest.approx((0.3, -0.1, 0.05), abs=1e-9)
    assert fit.slope == pytest.approx(1.03)
    assert fit.axis_error_deg == pytest.approx(4.0, abs=1e-6)
    assert fit.cylinder_error_dpt == pytest.approx(0.0, abs=1e-6)
    refuse_beyond_limits(fit)


def test_the_sds_of_the_fit_hold_its_errors() -> None:
    fits = [fit_trial_lenses(readings(PowerVector(0.1, 0.0, -0.1), seed=seed), VERTEX_MM) for seed in range(300)]
    off = np.array([(fit.offset.m_dpt - 0.1, fit.offset.j0_dpt, fit.offset.j45_dpt + 0.1) for fit in fits])
    sds = np.array([(fit.offset.m_sd_dpt, fit.offset.j0_sd_dpt, fit.offset.j45_sd_dpt) for fit in fits])
    rms = np.sqrt(((off / sds) ** 2).mean(axis=0))
    assert (rms < 1.1).all()  # 1.04 is one sd of an rms of 300
    assert (rms[1:] > 0.8).all()  # 0.93 on average: the sd grows with the scatter and never shrinks
    assert rms[0] > 0.5, "lenses and distance are exact here, and their tolerance is in the sd of M"


def failing(fit: TrialLensFit) -> list[str]:
    return [finding.name for finding in fit.findings if finding.fails]


@pytest.mark.parametrize(
    ("errors", "name", "message"),
    [
        ({"off": PowerVector(0.6)}, "offset", r"off by \+0\.60 dpt \(at most 0\.50 dpt\)"),
        ({"off": PowerVector(0.0, -0.3)}, "offset_j0", r"J0 is off by -0\.30 dpt"),
        ({"off": PowerVector(0.0, 0.0, 0.3)}, "offset_j45", r"J45 is off by \+0\.30 dpt"),
        ({"slope": 0.93}, "slope", r"changes by -7\.0% more than the lenses \(at most 5\.0%\)"),
        ({"turned_deg": -8.0}, "axis", r"reads -8\.0 degrees more"),
        ({"turned_deg": 120.0}, "axis", r"reads -60\.0 degrees more"),  # mirrored: 150 instead of 30
        ({"stronger_dpt": 0.5}, "cylinder", r"reads \+0\.5\d dpt more"),
    ],
)
def test_a_head_outside_one_limit_is_refused_with_its_remedy(errors, name: str, message: str) -> None:
    fit = fit_trial_lenses(readings(**errors), VERTEX_MM)
    assert failing(fit) == [name]
    with pytest.raises(CalibrationRefused, match=message) as error:
        refuse_beyond_limits(fit)
    assert error.value.remedy == next(finding.remedy for finding in fit.findings if finding.fails)


def test_a_wrong_lens_is_named() -> None:
    shown = readings()
    shown[1] = replace(shown[1], found=correction_behind(TrialLens(-2.0), VERTEX_MM))
    with pytest.raises(CalibrationRefused) as error:
        refuse_beyond_limits(fit_trial_lenses(shown, VERTEX_MM))
    fit = fit_trial_lenses(shown, VERTEX_MM)
    line = next(finding for finding in fit.findings if finding.name == "line")
    assert line.fails
    assert "+2.00" in line.remedy
    assert error.value.remedy, "the first of the failing findings has a remedy"


def test_noisy_readings_are_refused_before_a_limit_is_judged() -> None:
    noisy = [replace(reading, sds=PowerVector(0.6, 0.4, 0.4)) for reading in readings()]
    with pytest.raises(CalibrationRefused, match=r"the offset is known to .* only"):
        refuse_beyond_limits(fit_trial_lenses(noisy, VERTEX_MM))


@pytest.mark.parametrize(
    ("spoiled", "message"),
    [
        (lambda found: found[:2] + found[-1:], "2 spheres and 1 cylinders"),
        (lambda found: found[:-1], "5 spheres and 0 cylinders"),
        (lambda found: [replace(found[0], found=PowerVector(float("nan"))), *found[1:]], "no lens .* no number"),
        (lambda found: [replace(found[0], sds=PowerVector(0.0, 0.1, 0.1)), *found[1:]], "no lens .* no number"),
    ],
)
def test_readings_that_determine_nothing_are_refused(spoiled, message: str) -> None:
    with pytest.raises(CalibrationRefused, match=message):
        fit_trial_lenses(spoiled(readings()), VERTEX_MM)


OFFSET = RefractionOffset(0.3, -0.1, 0.15, 0.04, 0.03, 0.02)
FOUND = Refraction(2.0, 0.1, 0.99, 500.0, (), FieldEdge(33.4, 0.0, 0.0, 0.0, 0.1), 0.0, Cylinder(0.5, 0.06, -0.2, 0.07))


def test_a_report_is_corrected_by_the_offset_in_its_own_terms() -> None:
    before, after = report_of(FOUND), report_of(corrected(FOUND, OFFSET))
    changes = [after[key] - before[key] for key in ("sphere", "j0", "j45")]
    assert changes == pytest.approx([-0.3, 0.1, -0.15])
    sds = [after[key] for key in ("sd", "j0_sd", "j45_sd")]
    assert sds == pytest.approx([np.hypot(0.1, 0.04), np.hypot(0.06, 0.03), np.hypot(0.07, 0.02)])
    assert corrected(FOUND, None) is FOUND
    assert corrected(replace(FOUND, cylinder=None), OFFSET).cylinder is None


def head_with_calibration(folder: Path, **calibration: float) -> InstrumentSpec:
    """Return the simulated head with pixels of 10 um, whose PSF is measured with an eye of these keys."""
    spec = with_keys(coarse(load_head(SIM), 2), calibration=calibration)
    light = spec.light.model_copy(update={"preview_colour": spec.light.colour})  # one colour to render, not two
    spec = with_archive(spec.model_copy(update={"light": light}), folder)
    Archive(folder).add_and_activate(simulated_calibration(world(spec)), WHO)
    return spec


def test_the_offset_of_a_simulated_head_is_measured_and_stored(tmp_path: Path) -> None:
    """A PSF measured with an eye of 0.3 dpt of myopia and some cylinder: every eye reads as long-sighted."""
    spec, archive, lines = head_with_calibration(tmp_path, m_dpt=0.3, j45_dpt=0.15), Archive(tmp_path), list[str]()
    before = archive.active_id()
    bench = LensBench(lenses=tuple(TRIAL_LENSES[k] for k in (0, 1, 4, 5)))  # four are enough, and cheaper than six
    done = calibrate_with_lenses(spec, bench, SystemClock(), lambda _: None, lines.append)
    off, kept = done.fit.offset, archive.load()
    assert off.m_dpt == pytest.approx(0.3, abs=3 * off.m_sd_dpt)
    assert off.j0_dpt == pytest.approx(0.0, abs=3 * off.j0_sd_dpt)
    assert off.j45_dpt == pytest.approx(-0.15, abs=3 * off.j45_sd_dpt), "a correcting lens, and y upwards"
    assert done.fit.axis_error_deg == pytest.approx(0.0, abs=3 * done.fit.axis_sd_deg)
    assert kept.calibration.refraction_offset == off
    assert archive.active_id() == kept.calibration.id != before
    assert archive.load(before).calibration.refraction_offset is None, "the earlier calibration is as it was"
    assert dict(kept.provenance.figures) == {"prnu": 0.004} | dict(done.fit.figures)
    assert [line[:5] for line in lines if line.startswith(("no le", "-5.00"))] == ["no le", "-5.00"]


def fit_of(off: PowerVector) -> TrialLensFit:
    return fit_trial_lenses(readings(off), VERTEX_MM)


def test_a_head_outside_its_limits_keeps_its_calibration(tmp_path: Path) -> None:
    archive = Archive(tmp_path)
    archive.add_and_activate(Calibration((Psf(speckle((9, 9))),), Sensor()), WHO)
    refused = fit_of(PowerVector(-0.7))
    with pytest.raises(CalibrationRefused, match=r"the refraction is off by -0\.70 dpt"):
        keep_offset(archive, archive.load(), refused)
    assert any(line.startswith("FAIL  offset ") for line in table(readings(PowerVector(-0.7)), refused))
    assert len(archive.ids()) == 1
    keep_offset(archive, archive.load(), fit_of(PowerVector(-0.2)))
    again = keep_offset(archive, archive.load(), later := fit_of(PowerVector(0.1)))
    assert archive.load().calibration.refraction_offset == later.offset, "a later offset replaces the earlier one"
    assert archive.active_id() == again.calibration.id
    names = [name for name, _ in archive.load().provenance.figures]
    assert len(names) == len(set(names))


def test_the_remedy_gives_a_distance_only_for_a_head_with_the_lenses_of_the_light_path() -> None:
    spec = load_head(SIM)
    assert "37.5 mm before the first lens" in alignment_remedy(spec)
    assert spec.optics is not None
    other = spec.model_copy(update={"optics": spec.optics.model_copy(update={"angular_magnification": 0.8})})
    for unknown in (other, spec.model_copy(update={"optics": None})):
        assert "the trainer eye's pupil on the axis, where " in alignment_remedy(unknown)


def test_a_reconstruction_reports_the_refraction_without_the_offset() -> None:
    of = world(with_keys(coarse(load_head(SIM), 4), eye={"m_dpt": 2.0}))
    counts, recipe = exposed_counts(of), Recipe("evidence", 2)
    make = Reconstructor(simulated_calibration(of), of.shape, scenes.PLANNER, VirtualClock(), (recipe,))
    made = [make(counts)]
    make.calibration = replace(make.calibration, refraction_offset=OFFSET)  # a second one would be warmed up again
    made.append(make(counts))
    before, after = (reconstruction.report.refraction_dpt for reconstruction in made)
    changes = [after[key] - before[key] for key in ("sphere", "j0", "j45")]
    assert changes == pytest.approx([-0.3, 0.1, -0.15])
    assert np.array_equal(made[0].picture, made[1].picture), "the PSF is scaled as the frame says"
    assert made[0].report.psf_scale == made[1].report.psf_scale


def test_a_head_file_without_an_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "head.toml"
    path.write_text(small_head_toml("trial"))
    with pytest.raises(SpecError, match="no archive"):
        calibrate_with_lenses(load_head(path), LensBench(), SystemClock(), lambda _: None, lambda _: None)
