"""Bodies of the endpoints of the calibration procedure."""

from typing import Literal

from pydantic import Field

from device.calibration.procedure.calibration_sequence import CalibrationTarget
from services.http.schemas.common import KEY_PATTERN, RequestBody, ResponseBody, Timestamp
from services.http.schemas.problems import ErrorText


class CalibrationStart(RequestBody):
    """Request body: operator, serial number of the head (null: the stored one), and source diameter in degrees."""

    by: str = Field(min_length=1, max_length=60, pattern=r"^[^\x00-\x1f]*\S[^\x00-\x1f]*$")
    serial: str | None = Field(default=None, min_length=1, max_length=60, pattern=r"^[^\x00-\x1f]*\S[^\x00-\x1f]*$")
    source_deg: float | None = Field(default=None, ge=0, le=5)


class TargetReady(RequestBody):
    """Request body: the calibration target in front of the head; on a simulated head also a fault to inject."""

    stand: str = Field(max_length=40)
    mishap: str | None = Field(default=None, max_length=40)


class CalibrationChoice(RequestBody):
    """Request body: the id of the calibration to restore."""

    id: str = Field(pattern=KEY_PATTERN)


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
    """A calibration of the archive: its origin, its measured figures (`numbers`), and whether it is in force."""

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


ArchivedCalibration = IntactCalibration | DamagedCalibration


class CalibrationAnswer(ResponseBody):
    """State of the calibration procedure, its errors, and the archived calibrations.

    `state`: `starting`, `idle`, `begin`, `asking` (for the target `stand`) or `measuring`. `progress`: 0 to 1, or null.
    `error`: last error of the procedure. `needed`: error because of which a calibration is required. `unfinished`:
    targets whose measurement can be resumed. `made`: calibration of the last run; `kept`: the newest calibrations and
    the one in force. `mishaps`: faults that can be injected into a simulated head. `white_dn`: counts of a saturated
    pixel. `shape`: rows and columns of the sensor. `idle_s`: idle timeout of the login in seconds.
    """

    state: str
    stand: CalibrationTarget | None
    progress: float | None
    error: ErrorText | None
    needed: ErrorText | None
    steps: list[StepState]
    unfinished: list[CalibrationTarget]
    made: ArchivedCalibration | None
    in_force: ArchivedCalibration | None
    kept: list[ArchivedCalibration]
    name: str
    kind: str
    white_dn: int
    shape: tuple[int, int]
    mishaps: list[str]
    idle_s: float
