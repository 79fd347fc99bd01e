"""What must be so before RAUC is asked: of the device now, and of the release."""

import fcntl
import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from http.client import HTTPException
from pathlib import Path
from typing import Any

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
EXAM_S = 1800.0
WITHOUT_KERNEL = "Get the update that the maker of the device made for cards: it brings its kernel."


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


def refuse_unless_at_rest(at: str, lowest_battery: float, now: datetime) -> tuple[str, ...]:
    """The checks that fail already; UpdateDuringExam, UpdatePowerLow or UpdateAtRisk if this is not the time.

    A visit that was begun within half an hour and is not finished is an examination; an older one was left so. An
    instrument that does not answer takes no pictures, and an update may be what it needs: it is not refused.
    """
    said = probe.status(at)
    if said is None:
        return ()
    if said["state"] in ("busy", "making"):
        raise UpdateDuringExam(f"the instrument is {said['state']}")
    for visit in _answered(at, "/api/visits?open=true&limit=1").get("visits", ()):
        if abs(since_s := (now - datetime.fromisoformat(visit["begun_at"])).total_seconds()) < EXAM_S:
            raise UpdateDuringExam(f"visit {visit['number']} is open, begun {since_s / 60:.0f} minutes ago")
    known = _answered(at, "/api/health")
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


def _answered(at: str, path: str) -> dict[str, Any]:
    """What the instrument answers; {} if it does not."""
    try:
        return dict(json.loads(probe.ask(at, path)[1]))
    except (OSError, HTTPException, ValueError):
        return {}


def number(version: str) -> Version:
    """A version as numbers that compare, 2.0 being 2; UpdateDamaged if it is none."""
    if not re.fullmatch(r"\d+(\.\d+){0,3}", version):
        raise UpdateDamaged(f"{version!r} is not a version")
    parts = [int(part) for part in version.split(".")]
    while parts and parts[-1] == 0:
        parts.pop()
    return tuple(parts)


def refuse_wrong(release: Release, compatible: str, runs: str, modules: Path) -> None:
    """UpdateWrongDevice, UpdateOlder or UpdateTooFar if this device must not become that release.

    `modules` is where the kernel that runs finds its own; where it has some, a version without its kernel would meet
    whatever kernel lies beside its slot, and might find neither its own root nor the camera.
    """
    if release.compatible != compatible:
        raise UpdateWrongDevice(f"it is for {release.compatible}, this is {compatible}")
    if number(release.version) <= number(runs):
        raise UpdateOlder(f"it is version {release.version}, and {runs} runs")
    if number(runs) < number(release.minimum):
        raise UpdateTooFar(f"version {release.version} needs {release.minimum} or newer, and {runs} runs")
    if not release.has_kernel and _has_modules(modules):
        raise UpdateWrongDevice(f"it has no kernel, and this device runs Linux {os.uname().release}", WITHOUT_KERNEL)


def _has_modules(modules: Path) -> bool:
    try:
        return (modules / os.uname().release).is_dir()
    except PermissionError:  # hidden from this process, so there are some
        return True
