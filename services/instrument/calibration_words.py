"""What `diffuscope calibrations` says about a kept calibration, in lines of plain words."""

from device.calibration.archive import Kept
from device.values import Calibration, Geometry


def shown(text: str) -> str:
    """Words from a file on one line of a terminal, which they must not command."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def summary(kept: Kept) -> tuple[str, ...]:
    """Two or three lines: which, when, whose, how warm, by whom; what was found; what it is not."""
    found, said = kept.calibration, kept.provenance
    warm = "-" if said.temperature_c is None else f"{said.temperature_c:.1f} C"
    first = f"{found.id}  {said.made_at:%Y-%m-%d %H:%M}  {shown(said.serial):<12}  {warm:>7}  by {shown(said.made_by)}"
    return (first, _numbers(kept), *_warnings(kept))


def details(kept: Kept) -> tuple[str, ...]:
    """Everything else that it holds, one line each, and what is unknown."""
    found, said = kept.calibration, kept.provenance
    lines = [
        ("software", shown(said.software)),
        ("geometry", _geometry(found.geometry)),
        ("field", "unknown" if found.field_deg is None else f"{found.field_deg:g} deg"),
        *((name, "unknown" if getattr(found, name) is None else "measured") for name in ("dark_dn", "flat", "bad")),
        *((f"psf {k}", shown(psf.name)) for k, psf in enumerate(found.psfs)),
        *((shown(name), f"{value:.4g}") for name, value in said.figures),
    ]
    if said.unknown:
        lines.append(("unknown", shown(", ".join(said.unknown))))
    wide = max(len(name) for name, _ in lines)
    return tuple(f"  {name:<{wide}}  {value}" for name, value in lines)


def _numbers(kept: Kept) -> str:
    found, unknown = kept.calibration, kept.provenance.unknown
    sensor = found.sensor
    black = "unknown" if "black_dn" in unknown else f"{sensor.black_dn:.2f} DN"
    white = "unknown" if "white_dn" in unknown else f"{sensor.white_dn:.0f} DN"
    gain = "unknown" if sensor.gain_e_per_dn is None else f"{sensor.gain_e_per_dn:.3f} e-/DN"
    noise = "unknown" if sensor.read_noise_e is None else f"{sensor.read_noise_e:.2f} e-"
    return f"black {black}, white {white}, gain {gain}, read noise {noise}, {_psfs(found)}"


def _psfs(found: Calibration) -> str:
    rows, cols = found.psfs[0].shape
    return f"{rows} x {cols} pixels" + (f", {len(found.psfs)} PSFs" if len(found.psfs) > 1 else "")


def _warnings(kept: Kept) -> tuple[str, ...]:
    said, notes = kept.provenance, []
    if kept.calibration.simulated:
        notes.append("SIMULATED")
    if said.origin == "imported":
        notes.append(f"IMPORTED from {shown(said.source or 'somewhere')}, {len(said.unknown)} things unknown")
    return (", ".join(notes),) if notes else ()


def _geometry(geometry: Geometry | None) -> str:
    if geometry is None:
        return "unknown"
    return (
        f"{geometry.pitch_um:g} um per pixel, {geometry.diffuser_to_sensor_um:g} um to the sensor, "
        f"angles x {geometry.angular_magnification:g}"
    )
