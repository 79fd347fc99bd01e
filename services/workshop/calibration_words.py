"""Text of `diffuscope calibrations` for one archived calibration."""

from device.calibration.archive import StoredCalibration
from device.calibration.procedure.lens_check import lens_messages
from device.values import Calibration, Geometry, RefractionOffset, RefractionZero, WhiteReference

ZERO_WORDS: dict[RefractionZero, str] = {
    "trial lens": "known by trial lenses",
    "point source": "known by the stated distance of the point source",
    "relative": "not known: refractions are relative to the PSF; show trial lenses, or calibrate with --source-mm",
}


def printable(text: str) -> str:
    """Return text with a space for each unprintable character, so that the text cannot control the terminal."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def summary(kept: StoredCalibration) -> tuple[str, ...]:
    """Return two or three lines: ID, date, serial number, temperature and technician; measured values; warnings."""
    found = kept.calibration
    provenance = kept.provenance
    warm = "-" if provenance.temperature_c is None else f"{provenance.temperature_c:.1f} C"
    first = (
        f"{found.id}  {provenance.made_at:%Y-%m-%d %H:%M}  {printable(provenance.serial):<12}  {warm:>7}"
        f"  by {printable(provenance.made_by)}"
    )
    return (first, _numbers(kept), *_warnings(kept))


def details(kept: StoredCalibration) -> tuple[str, ...]:
    """Return the values that `summary` omits, one line each, and the list of unknown ones."""
    found = kept.calibration
    provenance = kept.provenance
    lines = [
        ("software", printable(provenance.software)),
        ("geometry", _geometry(found.geometry)),
        ("field", "unknown" if found.field_deg is None else f"{found.field_deg:g} deg"),
        *((name, "unknown" if getattr(found, name) is None else "measured") for name in ("dark_dn", "flat", "bad")),
        ("zero of the refraction", ZERO_WORDS[found.refraction_zero]),
        ("trial lenses", _offset(found.refraction_offset)),
        ("white card", _white(found.white)),
        *((f"psf {k}", printable(psf.name)) for k, psf in enumerate(found.psfs)),
        *((printable(name), f"{value:.4g}") for name, value in provenance.figures),
    ]
    if provenance.unknown:
        lines.append(("unknown", printable(", ".join(provenance.unknown))))
    wide = max(len(name) for name, _ in lines)
    return tuple(f"  {name:<{wide}}  {value}" for name, value in lines)


def _offset(offset: RefractionOffset | None) -> str:
    if offset is None:
        return "not measured"
    return f"M {offset.m_dpt:+.2f} (sd {offset.m_sd_dpt:.2f}), J0 {offset.j0_dpt:+.2f}, J45 {offset.j45_dpt:+.2f} dpt"


def _white(white: WhiteReference | None) -> str:
    if white is None:
        return "not measured"
    return ", ".join(f"{colour} {light:.3g}" for colour, light in white.dn_per_s) + " DN/s"


def _numbers(kept: StoredCalibration) -> str:
    found = kept.calibration
    unknown = kept.provenance.unknown
    sensor = found.sensor
    black = "unknown" if "black_dn" in unknown else f"{sensor.black_dn:.2f} DN"
    white = "unknown" if "white_dn" in unknown else f"{sensor.white_dn:.0f} DN"
    gain = "unknown" if sensor.gain_e_per_dn is None else f"{sensor.gain_e_per_dn:.3f} e-/DN"
    noise = "unknown" if sensor.read_noise_e is None else f"{sensor.read_noise_e:.2f} e-"
    return f"black {black}, white {white}, gain {gain}, read noise {noise}, {_psfs(found)}"


def _psfs(found: Calibration) -> str:
    rows, cols = found.psfs[0].shape
    return f"{rows} x {cols} pixels" + (f", {len(found.psfs)} PSFs" if len(found.psfs) > 1 else "")


def _warnings(kept: StoredCalibration) -> tuple[str, ...]:
    provenance = kept.provenance
    notes = []
    if kept.calibration.simulated:
        notes.append("SIMULATED")
    if provenance.origin == "imported":
        notes.append(
            f"IMPORTED from {printable(provenance.source or 'somewhere')}, {len(provenance.unknown)} things unknown"
        )
    lenses = lens_messages(dict(provenance.figures))
    return (*((", ".join(notes),) if notes else ()), *lenses)


def _geometry(geometry: Geometry | None) -> str:
    if geometry is None:
        return "unknown"
    return (
        f"{geometry.pitch_um:g} um per pixel, {geometry.diffuser_to_sensor_um:g} um to the sensor, "
        f"angles x {geometry.angular_magnification:g}"
    )
