"""`diffuscope trial-lenses`: offset and check of the refraction with lenses before a trainer eye.

    calibrate_with_lenses   shows each lens, measures its refraction, judges the head, and stores the offset
    table                   the readings and findings as text

The technician's page does the same; both use `services/instrument/trial_lens_measurement.py`.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass

from device.calibration.archive import Archive, StoredCalibration
from device.calibration.trial_lenses import LensReading, TrialLensFit
from device.clock import Clock
from device.config.head_file import InstrumentSpec
from device.errors import SpecError
from device.head import open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.optics.trial_lens import TrialLens
from services.instrument.trial_lens_measurement import LensBench, LensCheck


@dataclass(frozen=True)
class TrialLensResult:
    """Readings with their fit; `stored` is the calibration with the offset, now in force."""

    readings: tuple[LensReading, ...]
    fit: TrialLensFit
    stored: StoredCalibration


def calibrate_with_lenses(
    spec: InstrumentSpec, bench: LensBench, clock: Clock, ask: Callable[[str], None], progress: Callable[[str], None]
) -> TrialLensResult:
    """Measure the refraction with each trial lens and put the calibration with the offset in force.

    The lamp shines on a trainer eye, never on a person. `ask` prompts the operator of a real head and returns once the
    lens is there. CalibrationRefused if the head is outside its limits, after `progress` has the table; the calibration
    in force then stays. SpecError for a head file without an archive; errors of the head's parts and its archive.
    """
    if spec.calibration is None:
        raise SpecError(f"{spec.name} names no archive of calibrations", "Give one with --archive.")
    with closing(open_head(spec, clock, MemoryLedger(clock))) as head:
        check = LensCheck(head, Archive(spec.calibration.archive), bench)
        readings = []
        for lens in bench.lenses:
            if not check.present(lens):
                ask(_prompt(lens, bench))
            progress(f"measuring with {lens.label}")
            readings.append(check.read(lens))
        fit = check.fit(readings)
        for line in table(readings, fit):
            progress(line)
        return TrialLensResult(tuple(readings), fit, check.keep(fit))


def table(readings: Sequence[LensReading], fit: TrialLensFit) -> tuple[str, ...]:
    """Return one line per lens (nominal and measured correction, M beside the line), then one per finding."""
    lines = [f"{'lens':<22} {'nominal M  J0  J45':<22} {'measured M  J0  J45':<22} {'sd of M':>8} {'off line':>8}"]
    for reading, nominal, off_dpt in zip(readings, fit.nominals, fit.residuals_dpt, strict=True):
        due, seen = (" ".join(f"{value:+6.2f}" for value in values) for values in (nominal, reading.found))
        lines.append(f"{reading.lens.label:<22} {due:<22} {seen:<22} {reading.sds.m_dpt:>8.2f} {off_dpt:>+8.2f}")
    off = fit.offset
    lines.append(
        f"offset M {off.m_dpt:+.3f} (sd {off.m_sd_dpt:.3f}), J0 {off.j0_dpt:+.3f} (sd {off.j0_sd_dpt:.3f}), "
        f"J45 {off.j45_dpt:+.3f} (sd {off.j45_sd_dpt:.3f}) dpt; slope {fit.slope:.3f} (sd {fit.slope_sd:.3f})"
    )
    for finding in fit.findings:
        mark = "ok  " if finding.ok else "FAIL"
        lines.append(f"{mark}  {finding.name:<12} {finding.value:>+10.3f} {finding.unit:<6} limit {finding.limit:.3g}")
    return tuple(lines)


def _prompt(lens: TrialLens, bench: LensBench) -> str:
    if not any(lens):
        return "Put the trainer eye before the head, without a lens."
    return f"Put the lens {lens.label} before the trainer eye, {bench.vertex_mm:g} mm before its pupil."
