"""What must be so before RAUC is asked: of the device now, and of the release."""

import fcntl
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException
from pathlib import Path

from device.errors import (
    UpdateAtRisk,
    UpdateBusy,
    UpdateDamaged,
    UpdateDuringExam,
    UpdateFailed,
    UpdateOlder,
    UpdatePowerLow,
    UpdateTooFar,
    UpdateUncommitted,
    UpdateWrongDevice,
)  # fmt: skip
from services.health import probe
from services.update.bootchooser import BootChooser
from services.update.engine import Release

Version = tuple[int, ...]


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """One update at a time; UpdateBusy for the second. A killed one gives its place up."""
    try:
        lock = (folder / ".lock").open("ab")
    except OSError as error:
        raise UpdateFailed(
            f"{folder} cannot be written: {error.strerror}", "Call it as root, on the device."
        ) from error
    with lock as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UpdateBusy("another update has the lock") from error
        yield


def is_under_way(folder: Path) -> bool:
    """Whether somebody else is at an update now."""
    try:
        with alone(folder):
            return False
    except UpdateBusy:
        return True


def is_trying(chooser: BootChooser) -> bool:
    """Whether the version that runs has yet to be committed; UpdateWrongDevice on a computer that has no slots."""
    try:
        return chooser.is_trying()
    except (OSError, ValueError) as error:
        remedy = "Updates are for the device. On another computer, put the new version in as its README says."
        raise UpdateWrongDevice(f"this computer has no slots: {error}", remedy) from error


def refuse_while_trying(chooser: BootChooser) -> None:
    """UpdateUncommitted unless the committed slot runs: RAUC would write over the only slot that is known to work."""
    if is_trying(chooser):
        raise UpdateUncommitted(f"slot {chooser.booted()} runs and slot {chooser.committed()} is the committed one")


def refuse_unless_at_rest(at: str, lowest_battery: float) -> tuple[str, ...]:
    """The checks that fail already; UpdateDuringExam, UpdatePowerLow or UpdateAtRisk if this is not the time.

    An instrument that does not answer takes no pictures, and an update may be what it needs: it is not refused.
    """
    said = probe.status(at)
    if said is None:
        return ()
    if said["state"] in ("busy", "making"):
        raise UpdateDuringExam(f"the instrument is {said['state']}")
    try:
        known = json.loads(probe.ask(at, "/api/health")[1])
    except (OSError, HTTPException, ValueError):
        return ()
    if (battery := known.get("battery")) is not None and battery < lowest_battery:
        raise UpdatePowerLow(f"the battery is at {battery:.0%}, an update needs {lowest_battery:.0%}")
    failed = {check["name"]: check for check in known.get("checks", ()) if not check["ok"]}
    if "captures" in failed:
        raise UpdateAtRisk(failed["captures"]["value"])
    return tuple(failed)


def unsent(at: str) -> int:
    """How many people wait to be sent: no reason to refuse, for an update leaves the data partition alone."""
    said = probe.status(at) or {}
    return int((said.get("sending") or {}).get("waiting", 0))


def number(version: str) -> Version:
    """A version as numbers that compare, 2.0 being 2; UpdateDamaged if it is none."""
    if not re.fullmatch(r"\d+(\.\d+){0,3}", version):
        raise UpdateDamaged(f"{version!r} is not a version")
    parts = [int(part) for part in version.split(".")]
    while parts and parts[-1] == 0:
        parts.pop()
    return tuple(parts)


def refuse_wrong(release: Release, compatible: str, runs: str) -> None:
    """UpdateWrongDevice, UpdateOlder or UpdateTooFar if this device must not become that release."""
    if release.compatible != compatible:
        raise UpdateWrongDevice(f"it is for {release.compatible}, this is {compatible}")
    if number(release.version) <= number(runs):
        raise UpdateOlder(f"it is version {release.version}, and {runs} runs")
    if number(runs) < number(release.minimum):
        raise UpdateTooFar(f"version {release.version} needs {release.minimum} or newer, and {runs} runs")
