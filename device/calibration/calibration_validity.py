"""Validity of a calibration before the first picture, and of what would change it: period, sensor mode, simulation."""

from datetime import datetime, timedelta

from device.calibration.archive import Provenance
from device.calibration.monitoring.finding import Finding
from device.config.head_file import CameraSpec
from device.errors import CalibrationExpired, CalibrationModeMismatch, CalibrationRefused
from device.values import Calibration

# The calibration monitor finds slow drift in ordinary pictures (`head_check.py`); the age limit catches the rest.
# Yearly service: a hint after half a year, a refusal two months after a missed service.
REMIND_AFTER = timedelta(weeks=26)
EXPIRES_AFTER = timedelta(weeks=61)
CLOCK_SLACK = timedelta(days=1)  # a date further in the future means a wrong computer clock: the age is unknown

PITCH_SHARE = 1e-3
MIN_WHITE = 0.55  # of the converter range: wells may saturate earlier; one bit less would be 0.5
BLACK_DN, BLACK_SHARE = 16.0, 0.5  # one bit more or less would double or halve the black level
DARK_MAP_DN, DARK_MAP_SHARE = 3.0, 0.5  # share of the dark current: a larger difference means another exposure


def is_old(age: timedelta) -> bool:
    """Return whether a calibration is to be replaced soon; true at REMIND_AFTER."""
    return age >= REMIND_AFTER


def is_expired(age: timedelta) -> bool:
    """Return whether a calibration is too old for pictures; true at EXPIRES_AFTER."""
    return age >= EXPIRES_AFTER


def check_age(provenance: Provenance, now: datetime) -> Finding:
    """Return the age finding: a hint from 26 weeks on, a failure from 61 weeks on; a hint for a date in the future."""
    weeks = (now - provenance.made_at) / timedelta(weeks=1)
    if now < provenance.made_at - CLOCK_SLACK:
        remedy = "The computer's clock is behind the day of the calibration. Set the clock."
        return Finding("age", False, weeks, 0.0, "weeks", remedy, hint=True)
    if is_expired(now - provenance.made_at):
        limit = EXPIRES_AFTER / timedelta(weeks=1)
        return Finding("age", False, weeks, limit, "weeks", CalibrationExpired.default_remedy)
    limit = REMIND_AFTER / timedelta(weeks=1)
    old = is_old(now - provenance.made_at)
    remedy = f"Plan a calibration: from {EXPIRES_AFTER / timedelta(weeks=1):.0f} weeks on no pictures are taken."
    return Finding("age", not old, weeks, limit, "weeks", remedy if old else "", hint=old)


def refuse_expired(provenance: Provenance, now: datetime) -> None:
    """Raise CalibrationExpired if the calibration is 61 weeks old or older."""
    found = check_age(provenance, now)
    if found.fails:
        raise CalibrationExpired(
            f"the calibration of {provenance.serial} is {found.value:.0f} weeks old; "
            f"from {found.limit:.0f} weeks on no pictures are taken"
        )


def refuse_other_mode(calibration: Calibration, provenance: Provenance, camera: CameraSpec) -> None:
    """Raise CalibrationModeMismatch if the sensor mode of the calibration differs from the head file.

    Compared with tolerances: shape, pitch, white and black level, exposure of the dark map. Unknown values (of an
    imported PSF) are not compared.
    """
    difference = _other_mode(calibration, provenance, camera)
    if difference is not None:
        raise CalibrationModeMismatch(f"the calibration of {provenance.serial} {difference}")


def _other_mode(calibration: Calibration, known: Provenance, camera: CameraSpec) -> str | None:
    """Return the first difference in shape, pitch, white or black level, or dark exposure as a sentence; else None."""
    sensor = calibration.sensor
    geometry = calibration.geometry
    maps = [array for array in (calibration.dark_dn, calibration.flat, calibration.bad) if array is not None]
    for rows, cols in (array.shape for array in (*calibration.psfs, *maps)):
        if (rows, cols) != (camera.rows, camera.cols):
            return f"has {rows} x {cols} pixels, the head's file {camera.rows} x {camera.cols}"
    if geometry is not None and abs(geometry.pitch_um / camera.pitch_um - 1) > PITCH_SHARE:
        return f"has pixels of {geometry.pitch_um:g} um, the head's file {camera.pitch_um:g} um"
    if sensor.gain_e_per_dn is None:  # the sensor was not measured
        return None
    if not MIN_WHITE * camera.white_dn < sensor.white_dn <= camera.white_dn:
        return f"is full at {sensor.white_dn:.0f} DN, the head's file at {camera.white_dn} DN"
    if abs(sensor.black_dn - camera.black_dn) > max(BLACK_DN, BLACK_SHARE * camera.black_dn):
        return f"is black at {sensor.black_dn:.1f} DN, the head's file at {camera.black_dn:g} DN"
    return _other_exposure(calibration, known, camera)


def _other_exposure(calibration: Calibration, known: Provenance, camera: CameraSpec) -> str | None:
    """Return a sentence if the level of the dark map contradicts the exposure of pictures; None if not, or unknown."""
    per_s = dict(known.figures).get("dark_e_per_s")
    gain = calibration.sensor.gain_e_per_dn
    if per_s is None or gain is None or calibration.dark_dn is None:
        return None
    good = slice(None) if calibration.bad is None else ~calibration.bad
    level_dn = float(calibration.dark_dn[good].mean(dtype="float64"))
    warmth_dn = per_s * camera.exposure_s / gain
    off_dn = level_dn - calibration.sensor.black_dn - warmth_dn
    if abs(off_dn) > DARK_MAP_DN + DARK_MAP_SHARE * abs(warmth_dn):
        return (
            f"was dark at {level_dn:.1f} DN, {off_dn:+.1f} DN from what {camera.exposure_s:g} s make: another exposure"
        )
    return None


def refuse_simulated_change(calibration: Calibration, *, is_simulated: bool) -> None:
    """Raise CalibrationRefused if what a simulated head shows would change the calibration of a real one."""
    if is_simulated and not calibration.simulated:
        raise CalibrationRefused(
            "this head is simulated, and its archive holds the calibration of a real one",
            "Give the archive of the simulated head, or the file of the real one.",
        )
