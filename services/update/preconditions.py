"""Preconditions of an update: state of the device, and properties of the release."""

import json
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

import httpx
from pydantic import AwareDatetime, BaseModel, ValidationError

from device import atomic_io
from device.config.operating_limits import is_battery_low
from services.errors import (
    UpdateBusy,
    UpdateCapturesAtRisk,
    UpdateDamaged,
    UpdateDuringExam,
    UpdateFailed,
    UpdateOlder,
    UpdatePowerLow,
    UpdateStepMissing,
    UpdateUncommitted,
    UpdateWrongDevice,
)
from services.health import probe
from services.update.bootchooser import BootChooser
from services.update.rauc import Release

Version = tuple[int, ...]
Answer = TypeVar("Answer", bound=BaseModel)
EXAM_S = 600.0  # after the last picture
# A Raspberry Pi 5 with the bootloader of 23 September 2024 hung in a tried version, with one of November it did not:
# home-assistant/operating-system issue 3943.
MIN_BOOTLOADER = datetime(2024, 11, 1, tzinfo=UTC)
BOOTLOADER_REMEDY = (
    "Write Raspberry Pi Imager's Bootloader (Pi 5 family) to another card, start the device with it until the screen "
    "is green, then start the device with its own card."
)
KERNEL_REMEDY = "Get the update that the maker of the device made for cards: it brings its kernel."


class ReportedState(BaseModel):
    """Status as reported by the instrument.

    `state`: of the exam, None if the release does not report it. `last_capture_at`: time of the newest picture, if any.
    """

    state: str | None = None
    last_capture_at: AwareDatetime | None = None


class ReportedCheck(BaseModel):
    """Health check as reported by the instrument: result, and the measured value in words."""

    name: str
    ok: bool
    value: str


class ReportedHealth(BaseModel):
    """Health as reported by the instrument; `battery`: charge, 0 to 1, None without a battery."""

    battery: float | None = None
    checks: tuple[ReportedCheck, ...] = ()


@contextmanager
def update_lock(folder: Path) -> Iterator[None]:
    """Hold the update lock (flock) of the folder during the block; UpdateBusy if another process holds it.

    UpdateFailed if the folder cannot be written. The kernel also releases the lock when the process ends.
    """
    with ExitStack() as held:
        try:
            held.enter_context(atomic_io.file_lock(folder / ".lock", wait=False))
        except BlockingIOError as error:
            raise UpdateBusy("another update has the lock") from error
        except OSError as error:
            raise UpdateFailed(
                f"{folder} cannot be written: {error.strerror}", "Call it as root, on the device."
            ) from error
        yield


def is_under_way(folder: Path) -> bool:
    """Return whether another process holds the update lock."""
    try:
        with update_lock(folder):
            return False
    except UpdateBusy:
        return True


def is_trying(chooser: BootChooser) -> bool:
    """Return whether the running version is not yet committed; UpdateWrongDevice on a computer without boot slots."""
    try:
        return chooser.is_trying()
    except (OSError, ValueError) as error:
        remedy = "Updates are for the device. On another computer, put the new version in as its README says."
        raise UpdateWrongDevice(f"this computer has no slots: {error}", remedy) from error


def refuse_while_trying(chooser: BootChooser) -> None:
    """Raise UpdateUncommitted unless the committed slot runs: RAUC would overwrite the only slot known to work."""
    if is_trying(chooser):
        raise UpdateUncommitted(f"slot {chooser.booted()} runs and slot {chooser.committed()} is the committed one")


def refuse_while_in_use(at: str, lowest_battery: float, now: datetime) -> tuple[str, ...]:
    """Return the names of failing health checks, or refuse: UpdateDuringExam, UpdatePowerLow, UpdateCapturesAtRisk.

    `at`: base URL of the instrument; `lowest_battery`: least charge (0 to 1). UpdateDuringExam: the instrument is busy,
    or took a picture less than `EXAM_S` ago; a visit without a picture delays nothing. An instrument that does not
    answer takes no pictures and may need the update: the result is then empty. UpdateFailed for an answer of another
    form: exams and captures are unknown.
    """
    status = _answer(at, "/api/status", ReportedState)
    if status is None:
        return ()
    if status.state in ("busy", "making"):
        raise UpdateDuringExam(f"the instrument is {status.state}")
    if status.last_capture_at is not None and abs(since_s := (now - status.last_capture_at).total_seconds()) < EXAM_S:
        raise UpdateDuringExam(f"the last picture was taken {since_s / 60:.0f} minutes ago")
    health = _answer(at, "/api/health", ReportedHealth) or ReportedHealth()
    if (battery := health.battery) is not None and is_battery_low(battery, lowest_battery):
        raise UpdatePowerLow(f"the battery is at {battery:.0%}, an update needs {lowest_battery:.0%}")
    failed = {check.name: check for check in health.checks if not check.ok}
    if "captures" in failed:
        raise UpdateCapturesAtRisk(failed["captures"].value)
    return tuple(failed)


def waiting_uploads(at: str) -> int:
    """Return the number of visits in the upload queue of the instrument at base URL `at`; 0 if unknown.

    A waiting upload is no reason to refuse: an update does not change the data partition.
    """
    status = probe.status(at)
    return status.sending.waiting if status is not None and status.sending is not None else 0


def _answer(at: str, path: str, model: type[Answer]) -> Answer | None:
    """Return the instrument's answer; None if there is none, or if it is no JSON. An empty list counts as no entries.

    UpdateFailed for JSON of another form.
    """
    try:
        content = json.loads(probe.http_get(at, path)[1])
    except (httpx.HTTPError, ValueError):
        return None
    try:
        return model.model_validate(content if content != [] else {})
    except ValidationError as error:
        raise UpdateFailed(f"the answer of the instrument to {path} has another form than expected") from error


def parse_version(version: str) -> Version:
    """Return a version as a comparable tuple without trailing zeros; UpdateDamaged unless it is one to four numbers."""
    if not re.fullmatch(r"\d+(\.\d+){0,3}", version):
        raise UpdateDamaged(f"{version!r} is not a version")
    parts = [int(part) for part in version.split(".")]
    while parts and parts[-1] == 0:
        parts.pop()
    return tuple(parts)


def refuse_unsuitable(release: Release, compatible: str, runs: str, modules: Path) -> None:
    """Raise UpdateWrongDevice, UpdateOlder or UpdateStepMissing unless the device may install the release.

    `compatible` is the device type, `runs` the running version, `modules` /lib/modules. If that has a folder for the
    running kernel, a release without a kernel is refused: it would run with the kernel of its slot's boot partition,
    and might find neither its root file system nor the camera.
    """
    if release.compatible != compatible:
        raise UpdateWrongDevice(f"it is for {release.compatible}, this is {compatible}")
    if parse_version(release.version) <= parse_version(runs):
        raise UpdateOlder(f"it is version {release.version}, and {runs} runs")
    if parse_version(runs) < parse_version(release.minimum):
        raise UpdateStepMissing(f"version {release.version} needs {release.minimum} or newer, and {runs} runs")
    if not release.has_kernel and _has_modules(modules):
        raise UpdateWrongDevice(f"it has no kernel, and this device runs Linux {os.uname().release}", KERNEL_REMEDY)


def refuse_old_bootloader(file: Path) -> None:
    """Raise UpdateWrongDevice if the bootloader in the EEPROM was built before MIN_BOOTLOADER.

    `file`: its build time in the device tree, big-endian seconds; without the file the computer has none to check.
    """
    if not file.exists():
        return
    built = datetime.fromtimestamp(int.from_bytes(file.read_bytes()), UTC)
    if built < MIN_BOOTLOADER:
        dates = f"of {built:%Y-%m-%d}, and an update needs {MIN_BOOTLOADER:%Y-%m-%d} or newer"
        raise UpdateWrongDevice(f"the bootloader of the board is {dates}", BOOTLOADER_REMEDY)


def _has_modules(modules: Path) -> bool:
    try:
        return (modules / os.uname().release).is_dir()
    except PermissionError:  # not readable for this process, so it exists
        return True
