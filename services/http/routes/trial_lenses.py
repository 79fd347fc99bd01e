"""Description of a run with trial lenses, running or finished, for the answer of the calibration endpoints."""

from collections.abc import Sequence
from typing import Literal

from device.calibration.trial_lenses import LensReading
from device.optics.trial_lens import correction_behind
from services.http.problem_responses import error_text
from services.http.schemas.calibration import LensPower, TrialLensAnswer, TrialLensRow
from services.http.schemas.status import FindingAnswer
from services.instrument.head_arbiter import HeadOwner
from services.instrument.trial_lens_measurement import LensBench, TrialLensOutcome
from services.instrument.trial_lens_run import TrialLensSession


def trial_lens_answer(owner: HeadOwner) -> TrialLensAnswer | None:
    """Return the finished run if the last one was with trial lenses, else the running one; None without either."""
    if owner.last_lenses is not None:
        return _finished(owner.last_lenses)
    if not isinstance(owner.session, TrialLensSession):
        return None
    bench = owner.session.bench
    now = owner.session.run.now
    return TrialLensAnswer(
        state=now.state,
        lens=now.step,
        vertex_mm=bench.vertex_mm,
        eye_dpt=bench.eye.m_dpt,
        rows=_rows(bench, tuple(now.found.values()), now.step),
        findings=[],
        offset=None,
        error=error_text(now.error),
        stored_id=None,
        ended_at=None,
    )


def _finished(run: TrialLensOutcome) -> TrialLensAnswer:
    fit = run.fit
    stored = run.stored
    return TrialLensAnswer(
        state="done",
        lens=None,
        vertex_mm=run.bench.vertex_mm,
        eye_dpt=run.bench.eye.m_dpt,
        rows=_rows(run.bench, run.readings, None, () if fit is None else fit.residuals_dpt),
        findings=[] if fit is None else [FindingAnswer.model_validate(finding) for finding in fit.findings],
        offset=None if fit is None else LensPower.model_validate(fit.offset),
        error=error_text(run.failure),
        stored_id=None if stored is None else stored.calibration.id,
        ended_at=run.ended_at,
    )


def _rows(
    bench: LensBench, readings: Sequence[LensReading], current: int | None, off_line_dpt: Sequence[float] = ()
) -> list[TrialLensRow]:
    """Return one row per lens of the bench; `current` is the number of the requested lens."""
    rows = []
    for number, lens in enumerate(bench.lenses):
        reading = readings[number] if number < len(readings) else None
        state: Literal["todo", "now", "done"] = "done" if reading else "now" if number == current else "todo"
        nominal = correction_behind(lens, bench.vertex_mm, bench.eye)
        row = TrialLensRow(
            sphere_dpt=lens.sphere_dpt,
            cylinder_dpt=lens.cylinder_dpt,
            axis_deg=lens.axis_deg,
            state=state,
            nominal=LensPower.model_validate(nominal),
            measured=None if reading is None else LensPower.model_validate(reading.found),
            sd=None if reading is None else LensPower.model_validate(reading.sds),
            off_line_dpt=off_line_dpt[number] if off_line_dpt else None,
        )
        rows.append(row)
    return rows
