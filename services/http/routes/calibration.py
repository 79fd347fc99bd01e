"""Endpoints of the calibration of the head: state, live picture of the sensor, start, steps, choice, trial lenses."""

from dataclasses import asdict
from functools import lru_cache
from typing import Literal

import numpy as np
from fastapi import APIRouter, Query, Response
from fastapi.params import Depends

from device.calibration.archive import Archive, StoredCalibration
from device.calibration.procedure.calibration_sequence import CalibrationTarget
from device.calibration.procedure.lens_check import lens_messages
from device.errors import CalibrationError, HeadMismatch
from device.head import fault_names, kind_of
from device.optics.trial_lens import PowerVector
from services.errors import Busy
from services.http.media import JpegResponse, file_responses, no_picture
from services.http.problem_responses import error_text
from services.http.routes.trial_lenses import trial_lens_answer
from services.http.schemas.calibration import (
    ArchivedCalibration,
    CalibrationAnswer,
    CalibrationChoice,
    CalibrationStart,
    DamagedCalibration,
    IntactCalibration,
    StepState,
    TargetReady,
    TrialLensReady,
    TrialLensStart,
)
from services.http.schemas.problems import ErrorText
from services.instrument.calibration_request import STEPS_FOLDER, CalibrationRequest
from services.instrument.calibration_run import STANDS, CalibrationSession, TargetState, measured_share
from services.instrument.head_arbiter import HeadArbiter, HeadOwner
from services.instrument.trial_lens_measurement import LensBench
from services.instrument.trial_lens_run import TrialLensRequest, TrialLensSession

MAX_LISTED = 8  # calibrations in the list of earlier ones
STEP_FILES: dict[CalibrationTarget, str] = {"cap": "darks.npz", "screen": "flats.npz", "point": "point.npz"}
PREVIEW_RESPONSES = file_responses("image/jpeg") | no_picture("no picture within 2 s, or no calibration runs")


def calibration_router(arbiter: HeadArbiter, lit: Depends) -> APIRouter:
    """Return the router of the calibration; `lit` is the check of the control lease, which a start needs.

    From then on the run owns the head, and no screen takes pictures.
    """
    router = APIRouter()
    for part in (_read_router(arbiter), _write_router(arbiter, lit), _trial_lens_router(arbiter, lit)):
        router.include_router(part)
    return router


def _read_router(arbiter: HeadArbiter) -> APIRouter:
    """Return the router of the calibration endpoints that only read."""
    router = APIRouter(prefix="/api/calibration")

    @router.get("")
    def state() -> CalibrationAnswer:
        """Return the state of the calibration procedure: steps, progress, results, errors, archived calibrations."""
        return calibration_state(arbiter)

    @router.get("/preview", response_class=JpegResponse, responses=PREVIEW_RESPONSES)
    def preview(after: int = Query(0, ge=0)) -> Response:
        """Return the latest preview picture with a number above `after`, as JPEG, with its levels in headers.

        `X-Frame` (picture number), `X-Age-Ms`, `X-Exposure-Ms`, `X-Brightest` (99.9th percentile, counts), `X-Mean`
        (counts), `X-Full` (share of saturated pixels). 204 if there is none within 2 s or no calibration runs.
        """
        wizard = arbiter.owner.session
        frame = wizard.next_picture(after) if isinstance(wizard, CalibrationSession) else None
        if frame is None:
            return Response(status_code=204)
        age_ms = max(0, round((arbiter.context.clock.now_s() - frame.seen_s) * 1000))
        headers = {
            "X-Frame": str(frame.number),
            "X-Age-Ms": str(age_ms),
            "X-Exposure-Ms": f"{frame.exposure_s * 1000:.3g}",
            "X-Brightest": f"{frame.brightest_dn:.0f}",
            "X-Mean": f"{frame.mean_dn:.1f}",
            "X-Full": f"{frame.full:.4f}",
        }
        return JpegResponse(frame.jpeg, headers=headers)

    return router


def _write_router(arbiter: HeadArbiter, lit: Depends) -> APIRouter:
    """Return the router of the calibration endpoints that act."""
    router = APIRouter(prefix="/api/calibration")

    @router.post("", dependencies=[lit])
    def start(start: CalibrationStart) -> CalibrationAnswer:
        """Start a calibration, or resume an unfinished one.

        409 while a calibration is under way, the instrument starts or another screen holds the control lease; 401
        without a login.
        """
        root = arbiter.context.archive.root
        request = CalibrationRequest(root, start.serial, start.by, start.source_deg, source_mm=start.source_mm)
        arbiter.calibrate(request)
        return calibration_state(arbiter)

    @router.post("/ready")
    def ready(ready: TargetReady) -> CalibrationAnswer:
        """Confirm that the requested target is in place, and measure it; 409 if this target is not requested now."""
        wizard = arbiter.owner.session
        if not isinstance(wizard, CalibrationSession):
            raise Busy("nothing is being calibrated", "Start the calibration first.")
        wizard.ready(ready.stand, ready.mishap)
        return calibration_state(arbiter)

    @router.post("/cancel")
    def cancel() -> CalibrationAnswer:
        """Cancel the running calibration, or run with trial lenses; steps of the former can be resumed for 12 hours."""
        arbiter.stop_calibration()
        return calibration_state(arbiter)

    @router.post("/use")
    def use(use: CalibrationChoice) -> CalibrationAnswer:
        """Put an earlier calibration in force again; 409 during a calibration, 423 if it is unknown or damaged."""
        arbiter.roll_back(use.id)
        return calibration_state(arbiter)

    return router


def _trial_lens_router(arbiter: HeadArbiter, lit: Depends) -> APIRouter:
    """Return the router of the endpoints that measure the head with trial lenses."""
    router = APIRouter(prefix="/api/calibration/trial-lenses")

    @router.post("", dependencies=[lit])
    def start_trial_lenses(start: TrialLensStart) -> CalibrationAnswer:
        """Start a run with trial lenses before a trainer eye, for a head with a calibration in force.

        Within the limits of the head a calibration with the offset is put in force, else nothing is changed. 409 while
        a calibration is under way, the instrument starts or another screen holds the control lease; 423 without a
        valid calibration, 401 without a login.
        """
        arbiter.calibrate(TrialLensRequest(LensBench(start.vertex_mm, PowerVector(start.eye_dpt))))
        return calibration_state(arbiter)

    @router.post("/ready")
    def trial_lens_ready(ready: TrialLensReady) -> CalibrationAnswer:
        """Confirm that the requested lens is in place, and measure it; 409 if this lens is not requested now."""
        run = arbiter.owner.session
        if not isinstance(run, TrialLensSession):
            raise Busy("no trial lenses are being measured", "Start the check with trial lenses first.")
        run.ready(ready.lens)
        return calibration_state(arbiter)

    return router


def calibration_state(arbiter: HeadArbiter) -> CalibrationAnswer:
    """Return the state of the calibration procedure, its errors and the archived calibrations."""
    spec = arbiter.context.spec
    archive = arbiter.context.archive
    owner = arbiter.owner
    problem = owner.problem
    now = owner.session.run.now if isinstance(owner.session, CalibrationSession) else None
    kept = _listed(archive)
    return CalibrationAnswer(
        state=_state_without_run(owner) if now is None else now.state,
        stand=None if now is None else now.step,
        progress=None if now is None else measured_share(now),
        error=error_text((None if now is None else now.error) or owner.calibration_failure),
        needed=error_text(problem if isinstance(problem, CalibrationError | HeadMismatch) else None),
        steps=[_step(stand, now) for stand in STANDS],
        unfinished=[stand for stand, name in STEP_FILES.items() if (archive.root / STEPS_FOLDER / name).is_file()],
        lenses=trial_lens_answer(owner),
        made=next((calibration for calibration in kept if calibration.id == owner.last_made_id), None),
        in_force=next((calibration for calibration in kept if calibration.in_force), None),
        kept=kept,
        name=spec.name,
        kind=kind_of(spec),
        white_dn=spec.camera.white_dn,
        mishaps=list(fault_names()) if spec.camera.backend == "sim" else [],
    )


def _state_without_run(owner: HeadOwner) -> Literal["starting", "idle", "lenses"]:
    """Return the calibration state without a calibration run: `lenses` during a run with trial lenses, else idle."""
    return owner.idle_state if owner.session is None else "lenses"


def _step(stand: CalibrationTarget, now: TargetState | None) -> StepState:
    found = None if now is None else now.found.get(stand)
    is_now = now is not None and now.step == stand
    state: Literal["todo", "now", "done"] = "now" if is_now else "done" if found else "todo"
    return StepState(stand=stand, state=state, found=None if found is None else dict(found))


def _listed(archive: Archive) -> list[ArchivedCalibration]:
    """Return the archived calibrations, the newest first, at most `MAX_LISTED` and the current one."""
    try:
        current = archive.active_id()
    except CalibrationError:
        current = None
    ids = archive.ids()[::-1][:MAX_LISTED]
    if current is not None and current not in ids and current in archive.ids():
        ids = (*ids, current)
    return [_described(archive, id, id == current) for id in ids]


def _described(archive: Archive, id: str, in_force: bool) -> ArchivedCalibration:
    try:
        return _read(archive, id).model_copy(update={"in_force": in_force})
    except CalibrationError as error:
        damaged = ErrorText(code=error.code, message=error.message, remedy=error.remedy)
        return DamagedCalibration(id=id, damaged=damaged, numbers={}, in_force=in_force)


@lru_cache(maxsize=32)  # key: the archive object; a load checks every byte, and the page polls each second
def _read(archive: Archive, id: str) -> IntactCalibration:
    return intact_calibration(archive.load(id))


def intact_calibration(stored: StoredCalibration) -> IntactCalibration:
    """Return origin and figures of a calibration that is not in force.

    `psf_spread_px` is the effective number of pixels of the PSF: squared sum over sum of squares. `trial_offset_dpt` is
    the offset of M by trial lenses.
    """
    calibration = stored.calibration
    made = stored.provenance
    psf = calibration.psfs[0].pixels
    off = calibration.refraction_offset
    numbers = dict(made.figures) | asdict(calibration.sensor)
    numbers |= {"psf_spread_px": float(psf.sum(dtype=np.float64) ** 2 / np.square(psf, dtype=np.float64).sum())}
    if off is not None:
        numbers |= {"trial_offset_dpt": off.m_dpt}
    return IntactCalibration(
        id=calibration.id,
        serial=made.serial,
        made_at=made.made_at,
        made_by=made.made_by,
        software=made.software,
        temperature_c=made.temperature_c,
        simulated=calibration.simulated,
        zero=calibration.refraction_zero,
        numbers=numbers,
        notes=list(lens_messages(dict(made.figures))),
        damaged=None,
        in_force=False,
    )
