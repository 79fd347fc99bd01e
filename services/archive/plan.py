"""Plan of a reprocessing run: the captures, calibrations, settings and versions, as one TOML file.

It is written before anything runs, and a copy of it is stored beside the results. Paths are absolute; every file that
decides about a picture has its SHA-256.
"""

import tomllib
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from device import atomic_io
from device.errors import SettingError, SpecError
from device.user_files import read_text
from services.records.capture import OtherColour
from services.research.reconstruct_file import write_or_raise

FORMAT = 1
Role = Literal["psf", "psf-red", "psf-blue", "psf-amber", "dark", "flat", "archive"]
COLOUR_ROLES: dict[OtherColour, Role] = {"red": "psf-red", "blue": "psf-blue", "amber": "psf-amber"}


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PlanSettings(_Part):
    """Settings of every reconstruction of a plan; None: what the solver chooses from PSF and frame.

    With `budget_s` (seconds for each capture) results depend on the speed of the machine; with `rounds`, or without
    both, they do not. No method draws random numbers, so a plan has no seed.
    """

    method: str | None = None
    rounds: int | None = None
    budget_s: float | None = None


class InputFile(_Part):
    """One file of a calibration, with its SHA-256."""

    role: Role
    path: str
    sha256: str


class PlannedCalibration(_Part):
    """Calibration of several captures: files of PSFs, dark and flat frame, or one entry of a calibration archive.

    `digest` is over the content of the files; `id` is the id in an archive, else empty; `made_at` is ISO 8601, empty if
    unknown.
    """

    digest: str
    label: str
    files: tuple[InputFile, ...]
    id: str = ""
    made_at: str = ""


class PlannedFrame(_Part):
    """One more raw frame of a capture: of the burst, or in another `colour` of light (empty: of the burst).

    `unusable`: reason why it must not enter the picture, as the instrument recorded it; empty if it may.
    """

    path: str
    sha256: str
    colour: OtherColour | Literal[""] = ""
    unusable: str = ""


class PlannedCapture(_Part):
    """One capture: raw frame, own dark frame, calibration (digest), and the name of its result.

    `raw` is the first frame of the burst, `frames` are the others in their order, then those in other colours.
    `device`: the calibration archive of its device, by the name of its folder; `origin`: UUID of the device that took
    it; both are empty if unknown. `truth` is a picture of the rows and columns of the raw frame to compare with,
    `before` the earlier picture (of a store: the lit field only), `report` the earlier report in the store; each is a
    path, or empty.
    """

    id: str
    source: str
    raw: str
    raw_sha256: str
    calibration: str
    result: str
    frames: tuple[PlannedFrame, ...] = ()
    dark: str = ""
    dark_sha256: str = ""
    truth: str = ""
    before: str = ""
    report: str = ""
    device: str = ""
    origin: str = ""
    eye: str = ""
    taken_at: str = ""


class LeftOut(_Part):
    """A capture that cannot be planned, with the reason."""

    id: str
    source: str
    raw: str
    reason: str


class Plan(_Part):
    """All of a reprocessing run: captures in the order of their sources; a run computes them by calibration."""

    format: int = FORMAT
    made_at: str
    sources: tuple[str, ...]
    settings: PlanSettings
    software: dict[str, str]
    calibrations: tuple[PlannedCalibration, ...] = Field(default=())
    captures: tuple[PlannedCapture, ...] = Field(default=())
    left_out: tuple[LeftOut, ...] = Field(default=())

    def calibration(self, digest: str) -> PlannedCalibration:
        """Return the calibration with this digest; KeyError if the plan has none."""
        return {calibration.digest: calibration for calibration in self.calibrations}[digest]


def encoded(plan: Plan) -> bytes:
    """Return the content of the file of a plan; values that are None or empty are left out."""
    return tomli_w.dumps(_without_empty(plan.model_dump())).encode()


def write_plan(plan: Plan, path: Path) -> None:
    """Write a plan atomically; StoreError, or StoreFull for a full disk."""
    write_or_raise(path, lambda: atomic_io.write_atomically(path, encoded(plan), mode=None))


def read_plan(path: Path) -> Plan:
    """Return the plan in a file; SettingError for a file that is missing, damaged, or of another release."""
    remedy = "Make the plan again: diffuscope archive plan SOURCE -o PLAN.toml."
    try:
        content = tomllib.loads(read_text(path))
        if content.get("format") != FORMAT:
            raise SettingError(f"{path} is a plan of format {content.get('format')}, not {FORMAT}", remedy)
        plan = Plan.model_validate(content)
    except SpecError as error:
        raise SettingError(error.message, error.remedy if path.is_file() else remedy) from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise SettingError(f"{path} is no plan: {place}: {first['msg']}", remedy) from error
    except ValueError as error:
        raise SettingError(f"{path} is not whole TOML: {error}", remedy) from error
    _refuse_inconsistent(plan, path, remedy)
    return plan


def _refuse_inconsistent(plan: Plan, path: Path, remedy: str) -> None:
    known = {calibration.digest for calibration in plan.calibrations}
    if lost := [capture.id for capture in plan.captures if capture.calibration not in known]:
        raise SettingError(f"{path} has no calibration for {lost[0]}", remedy)
    names = Counter(capture.result for capture in plan.captures)
    if twice := [name for name, count in names.items() if count > 1]:
        raise SettingError(f"{path} plans the result {twice[0]} twice", remedy)


def _without_empty(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_empty(entry) for key, entry in value.items() if entry is not None and entry != ""}
    if isinstance(value, list | tuple):
        return [_without_empty(entry) for entry in value]
    return value
