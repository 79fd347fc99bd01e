"""What can be said about a calibration before the first picture: its age, and whether it was measured in this mode."""

from datetime import datetime, timedelta

from device.calibration.archive import Provenance
from device.calibration.finding import Finding
from device.errors import CalibrationOld, CalibrationOtherMode
from device.spec import CameraSpec
from device.values import Calibration

# What ages slowly is seen in ordinary pictures (`check.py`); age alone is the net below that. Instruments are serviced
# once a year: reminded after half of it, refused two months after a service that did not take place.
OLD_FROM = timedelta(weeks=26)
TOO_OLD_FROM = timedelta(weeks=61)
CLOCK_SLACK = timedelta(days=1)  # a calibration from the future: the computer's clock is wrong, and ages are not known

PITCH_SHARE = 1e-3
LEAST_WHITE = 0.55  # of the converter's end: wells may be full before it, but a bit less would be a half
BLACK_DN, BLACK_SHARE = 16.0, 0.5  # a bit more or less would double or halve it
DARK_MAP_DN, DARK_MAP_SHARE = 3.0, 0.5  # of what warmth brings: the map of another exposure


def age(known: Provenance, now: datetime) -> Finding:
    """How long ago it was measured; beyond TOO_OLD_FROM no picture may rest on it."""
    weeks = (now - known.made_at) / timedelta(weeks=1)
    if now < known.made_at - CLOCK_SLACK:
        remedy = "The computer's clock is behind the day of the calibration. Set the clock."
        return Finding("age", False, weeks, 0.0, "weeks", remedy, hint=True)
    if now - known.made_at >= TOO_OLD_FROM:
        limit = TOO_OLD_FROM / timedelta(weeks=1)
        return Finding("age", False, weeks, limit, "weeks", CalibrationOld.default_remedy)
    limit = OLD_FROM / timedelta(weeks=1)
    old = now - known.made_at >= OLD_FROM
    said = f"Plan a calibration: from {TOO_OLD_FROM / timedelta(weeks=1):.0f} weeks on no pictures are taken."
    return Finding("age", not old, weeks, limit, "weeks", said if old else "", hint=old)


def refuse_old(known: Provenance, now: datetime) -> None:
    """CalibrationOld if it is too old."""
    found = age(known, now)
    if found.fails:
        raise CalibrationOld(
            f"the calibration of {known.serial} is {found.value:.0f} weeks old, it may be {found.limit:.0f} at most"
        )


def refuse_other_mode(calibration: Calibration, known: Provenance, camera: CameraSpec) -> None:
    """CalibrationOtherMode if the sensor was read in another way than the head's file says.

    Where a calibration does not know something (an imported PSF), that is not compared.
    """
    said = _other_mode(calibration, known, camera)
    if said is not None:
        raise CalibrationOtherMode(f"the calibration of {known.serial} {said}")


def _other_mode(calibration: Calibration, known: Provenance, camera: CameraSpec) -> str | None:
    sensor, geometry = calibration.sensor, calibration.geometry
    maps = [one for one in (calibration.dark_dn, calibration.flat, calibration.bad) if one is not None]
    for rows, cols in (one.shape for one in (*calibration.psfs, *maps)):
        if (rows, cols) != (camera.rows, camera.cols):
            return f"has {rows} x {cols} pixels, the head's file {camera.rows} x {camera.cols}"
    if geometry is not None and abs(geometry.pitch_um / camera.pitch_um - 1) > PITCH_SHARE:
        return f"has pixels of {geometry.pitch_um:g} um, the head's file {camera.pitch_um:g} um"
    if sensor.gain_e_per_dn is None:  # nobody measured the sensor
        return None
    if not LEAST_WHITE * camera.white_dn < sensor.white_dn <= camera.white_dn:
        return f"is full at {sensor.white_dn:.0f} DN, the head's file at {camera.white_dn} DN"
    if abs(sensor.black_dn - camera.black_dn) > max(BLACK_DN, BLACK_SHARE * camera.black_dn):
        return f"is black at {sensor.black_dn:.1f} DN, the head's file at {camera.black_dn:g} DN"
    return _other_exposure(calibration, known, camera)


def _other_exposure(calibration: Calibration, known: Provenance, camera: CameraSpec) -> str | None:
    """Whether the dark map was taken at another exposure than pictures are."""
    per_s, gain = dict(known.figures).get("dark_e_per_s"), calibration.sensor.gain_e_per_dn
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
