"""Bodies of the endpoints of the calibration procedure."""

from typing import Literal

from pydantic import Field

from device.calibration.procedure.calibration_sequence import CalibrationTarget
from device.values import RefractionZero
from services.http.schemas.common import KEY_PATTERN, RequestBody, ResponseBody
from services.http.schemas.problems import ErrorText
from services.http.schemas.status import FindingAnswer
from services.instrument.trial_lens_measurement import VERTEX_MM
from services.records.json_values import Timestamp


class CalibrationStart(RequestBody):
    """Request body: operator, serial number of the head (null: the stored one), and the point source.

    `source_deg`: its diameter in degrees; `source_mm`: its distance from the lens of the model eye in mm, which fixes
    the zero of the refraction (null: not stated).
    """

    by: str = Field(min_length=1, max_length=60, pattern=r"^[^\x00-\x1f]*\S[^\x00-\x1f]*$")
    serial: str | None = Field(default=None, min_length=1, max_length=60, pattern=r"^[^\x00-\x1f]*\S[^\x00-\x1f]*$")
    source_deg: float | None = Field(default=None, ge=0, le=5)
    source_mm: float | None = Field(default=None, ge=5, le=100)


class TargetReady(RequestBody):
    """Request body: the calibration target in front of the head; on a simulated head also a fault to inject."""

    stand: str = Field(max_length=40)
    mishap: str | None = Field(default=None, max_length=40)


class CalibrationChoice(RequestBody):
    """Request body: the id of the calibration to restore."""

    id: str = Field(pattern=KEY_PATTERN)


class TrialLensStart(RequestBody):
    """Request body: distance from lens to pupil in mm, and the correction that the trainer eye alone needs in dpt."""

    vertex_mm: float = Field(default=VERTEX_MM, ge=0, le=30)
    eye_dpt: float = Field(default=0.0, ge=-10, le=10)


class TrialLensReady(RequestBody):
    """Request body: number of the lens before the trainer eye, from 0."""

    lens: int = Field(ge=0, le=20)


class StepState(ResponseBody):
    """One step: its target (`stand`), `todo`, `now` or `done`, and the figures that it measured (null: none)."""

    stand: CalibrationTarget
    state: Literal["todo", "now", "done"]
    found: dict[str, float] | None


class DamagedCalibration(ResponseBody):
    """A calibration of the archive that cannot be read, with its error; `numbers` is empty."""

    id: str
    damaged: ErrorText
    numbers: dict[str, float]
    in_force: bool


class IntactCalibration(ResponseBody):
    """A calibration of the archive: its origin, its measured figures (`numbers`), and whether it is in force.

    `zero`: what fixes the zero of the refraction. `notes`: sentences on figures of lenslets beyond their limits.
    """

    id: str
    damaged: None
    numbers: dict[str, float | None]
    in_force: bool
    serial: str
    made_at: Timestamp
    made_by: str
    software: str
    temperature_c: float | None
    simulated: bool
    zero: RefractionZero
    notes: list[str]


ArchivedCalibration = IntactCalibration | DamagedCalibration


class LensPower(ResponseBody):
    """Correcting lens as power vector, dpt: mean sphere (negative for myopia), J0 and J45."""

    m_dpt: float
    j0_dpt: float
    j45_dpt: float


class TrialLensRow(ResponseBody):
    """One lens: its prescription, the correction that it should give (`nominal`), and the measured one with its sd.

    `state`: `todo`, `now` or `done`. `off_line_dpt`: measured M minus the line of all readings; null before the fit.
    """

    sphere_dpt: float
    cylinder_dpt: float
    axis_deg: float
    state: Literal["todo", "now", "done"]
    nominal: LensPower
    measured: LensPower | None
    sd: LensPower | None
    off_line_dpt: float | None


class TrialLensAnswer(ResponseBody):
    """Run with trial lenses: `begin`, `asking` (for number `lens`), `measuring`, or `done` at `ended_at`.

    `error`: why the last measurement, or the head, was refused. `findings` and `offset`: of a finished run whose
    readings determine them. `stored_id`: calibration with the offset, in force since then; null if nothing was changed.
    """

    state: Literal["begin", "asking", "measuring", "done"]
    lens: int | None
    vertex_mm: float
    eye_dpt: float
    rows: list[TrialLensRow]
    findings: list[FindingAnswer]
    offset: LensPower | None
    error: ErrorText | None
    stored_id: str | None
    ended_at: Timestamp | None


class CalibrationAnswer(ResponseBody):
    """State of the calibration procedure, its errors, and the archived calibrations.

    `state`: `starting`, `idle`, `begin`, `asking` (for the target `stand`) or `measuring`; `lenses` while a run with
    trial lenses owns the head. `lenses`: that run, or the last one if it was with trial lenses; else null. `progress`:
    0 to 1, or null. `error`: last error of the procedure. `needed`: error because of which a calibration is required.
    `unfinished`: targets whose measurement can be resumed. `made`: calibration of the last run; `kept`: the newest
    calibrations and the one in force. `mishaps`: faults that can be injected into a simulated head. `white_dn`: counts
    of a saturated pixel.
    """

    state: Literal["starting", "idle", "begin", "asking", "measuring", "lenses"]
    stand: CalibrationTarget | None
    progress: float | None
    error: ErrorText | None
    needed: ErrorText | None
    steps: list[StepState]
    unfinished: list[CalibrationTarget]
    lenses: TrialLensAnswer | None
    made: ArchivedCalibration | None
    in_force: ArchivedCalibration | None
    kept: list[ArchivedCalibration]
    name: str
    kind: str
    white_dn: int
    mishaps: list[str]
