"""`diffuscope check`: the last captures of the shelf, or a dark frame taken now, against the calibration in force."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from device.calibration.admission import refuse_other_mode
from device.calibration.archive import Archive, Kept
from device.calibration.check import Exposures, Sight, check, look
from device.calibration.finding import Finding
from device.clock import Clock
from device.errors import HeadMismatch
from device.head import Bench, open_bench
from device.recon.plan import Planner
from device.recon.refraction import Refractor, can_refract
from device.recon.witness import Witness
from device.spec import CalibrationTable, InstrumentSpec
from device.values import Calibration, Capture, Shot
from services.instrument.fitness import LOOKED_AT, exposures, in_force_since, spheres_dpt, taken_with
from services.records.store import Store

DARKS = 3


@dataclass(frozen=True)
class Checked:
    """The calibration, what was found about it, and what it was asked with: captures, or dark frames taken now."""

    kept: Kept
    findings: tuple[Finding, ...]
    captures: int
    darks: int


def checked(spec: InstrumentSpec, data: Path, clock: Clock, tell: Callable[[str], None]) -> Checked:
    """Load what is in force, refuse another mode, look at the shelf's last captures, or expose dark frames now.

    Raises CalibrationMissing, CalibrationDamaged, CalibrationOtherMode, HeadMismatch, and whatever the camera raises.
    """
    assert spec.calibration is not None
    kept = Archive(spec.calibration.archive).load()
    refuse_other_mode(kept.calibration, kept.provenance, spec.camera)
    taken = _taken(spec, kept.calibration.id, data)
    if taken:
        tell(f"looking at {min(len(taken), LOOKED_AT)} captures of {data}")
        sights = _of_captures(kept, taken, data)
    else:
        tell("no captures with this calibration yet: taking dark frames now")
        sights = _of_darks(spec, kept, clock)
    known = kept.calibration, kept.provenance
    findings = check(*known, sights, spheres_dpt(taken), clock.wall())
    return Checked(kept, findings, len(taken), 0 if taken else len(sights))


def with_archive(spec: InstrumentSpec, archive: Path | None) -> InstrumentSpec:
    """The head with its calibrations in another folder than its file says."""
    return spec if archive is None else spec.model_copy(update={"calibration": CalibrationTable(archive=archive)})


def table(found: Checked) -> str:
    """Each finding on a line: number, limit, and what to do below it."""
    lines = []
    for one in found.findings:
        mark = "ok  " if one.ok else "note" if one.hint else "FAIL"
        lines.append(f"{mark}  {one.name:<12} {one.value:>10.4g} {one.unit:<6} limit {one.limit:.4g}")
        if one.remedy:
            lines.append(f"{'':<6}{one.remedy}")
    known = {one.name for one in found.findings}
    if "psf" not in known:
        lines.append("      psf: no capture here tells whether it fits. Take a picture of an eye, then check again.")
    return "\n".join(lines)


def _taken(spec: InstrumentSpec, calibration_id: str, data: Path) -> list[Capture]:
    if not (data / "shelf.sqlite").is_file():
        return []
    with Store(data) as store:
        return list(taken_with(store, calibration_id, in_force_since(spec)))


def _of_captures(kept: Kept, taken: list[Capture], data: Path) -> list[Sight]:
    witness = _witness(kept.calibration)
    with Store(data) as store:
        seen = [exposures(store, capture) for capture in taken[-LOOKED_AT:]]
    return [look(kept.calibration, kept.provenance, witness, one) for one in seen]


def _witness(calibration: Calibration) -> Witness | None:
    if not can_refract(calibration):
        return None
    return Witness(Refractor(calibration, calibration.psfs[0].shape, Planner(None, effort="FFTW_ESTIMATE"), 0))


def _of_darks(spec: InstrumentSpec, kept: Kept, clock: Clock) -> list[Sight]:
    exposure_s, sights = spec.camera.exposure_s, []
    with closing(open_bench(spec, clock)) as bench:
        _refuse_another_head(bench, kept)
        bench.camera.prepare(Shot(exposure_s))
        for _ in range(DARKS):
            dark = bench.camera.expose(Shot(exposure_s)).counts
            at = Exposures(clock.wall(), np.empty((0, 0), np.uint16), dark, exposure_s)
            sights.append(look(kept.calibration, kept.provenance, None, at))
    return sights


def _refuse_another_head(bench: Bench, kept: Kept) -> None:
    known = bench.chips.memory.read() if bench.chips.memory is not None else None
    if known is not None and known.calibration_id != kept.calibration.id:
        raise HeadMismatch(f"head {known.serial} was calibrated as {known.calibration_id[:16]}")
