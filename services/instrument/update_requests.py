"""Update requests from the page to the updater: state of an update, request files, upload of an update bundle.

The updater, a separate privileged process, installs updates; this module only exchanges files with it.
"""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import BinaryIO

from pydantic import BaseModel, ConfigDict

from device import atomic_io
from device.clock import Clock, boot_id
from device.errors import InputError
from services import resources
from services.errors import UpdateBusy, UpdateFailed, UpdateNoRoom, UpdateWrongDevice
from services.records.json_values import OmittedIfNone
from services.update.ipc import (
    REQUEST_FILE,
    TABLET,
    UNDER_WAY,
    UPLOAD,
    WORLD_READABLE,
    FoundUpdate,
    StoredError,
    UpdateRequest,
    read_state,
    stage_of,
    write_request,
)

MAX_BYTES = 2_000_000_000  # largest upload; a bundle has about 350 MB
PICKUP_TIMEOUT_S = 90.0  # for the updater to take a request, on a busy computer
NO_UPDATER_REMEDY = "Updates are for the device. On another computer, put the new version in as its README says."


class UpdateStatus(BaseModel):
    """State of an update: running version (`runs`), `state`, updates found, last error (`trouble`), `news` of it.

    `here`: this computer has an updater. Only with an updater: the new `version`, the version `before` it, progress 0
    to 1 (`share`), a newer version `offered` by the channel, and whether a search was done since the last install
    (`looked`). `took_s`: duration of the last committed update in seconds. `news`: release notes.
    """

    model_config = ConfigDict(frozen=True)

    here: bool
    runs: str
    state: str
    found: tuple[FoundUpdate, ...] = ()
    trouble: StoredError | None = None
    news: tuple[str, ...] = ()
    took_s: float | None = None
    version: OmittedIfNone[str] = None
    before: OmittedIfNone[str] = None
    share: OmittedIfNone[float] = None
    offered: OmittedIfNone[str] = None
    looked: OmittedIfNone[bool] = None


class BundleUpload:
    """Temporary file that receives an uploaded bundle; `publish` renames it once `length` bytes have arrived."""

    def __init__(self, part: Path, file: BinaryIO, length: int) -> None:
        self._part = part
        self._file = file
        self._length = length
        self._arrived = 0

    def write(self, piece: bytes) -> None:
        """Append one chunk of the bundle."""
        self._arrived += len(piece)
        self._file.write(piece)

    def publish(self) -> None:
        """Give the complete file to the updater; InputError if another number of bytes arrived."""
        self._file.close()
        if self._arrived != self._length:
            raise InputError(
                f"{self._arrived} of {self._length} bytes arrived", "Send the file again, and stay on this page."
            )
        _publish(self._part, self._part.with_name(UPLOAD))


class UpdateRequests:
    """File-based interface to the updater: folder `state` (its journal, uploads), folder `requests` (request file).

    If one is None or `requests` is not writable, this computer has no updater; `status` then reports `here: False`.
    `version` is the running version, `boot` the id of the current boot (None: read from the kernel).
    """

    def __init__(
        self, state: Path | None, requests: Path | None, clock: Clock, version: str, boot: str | None = None
    ) -> None:
        self._state, self._requests, self._clock, self._version = state, requests, clock, version
        self._boot = boot or boot_id()
        self._requested_s = clock.now_s()
        self._timeout_error: StoredError | None = None
        self._receiving = Lock()
        if state is not None and self.is_here:
            self._part(state).unlink(missing_ok=True)  # an interrupted upload

    @property
    def is_here(self) -> bool:
        """Whether this computer has an updater whose request folder is writable."""
        return self._state is not None and self._requests is not None and os.access(self._requests, os.W_OK | os.X_OK)

    def status(self) -> UpdateStatus:
        """Return the state of the update.

        `state` is `asked` while a request waits for the updater, else that of `stage_of`.
        """
        if self._state is None or not self.is_here:
            return UpdateStatus(here=False, runs=self._version, state="none")
        entry = read_state(self._state)
        waits = self._is_waiting()
        state = "asked" if waits else stage_of(entry, self._version, self._boot)
        trouble = self._timeout_error or (None if state in ("asked", "committed") else entry.trouble)
        return UpdateStatus(
            here=True,
            runs=self._version,
            state=state,
            found=entry.found,
            trouble=trouble,
            news=tuple(release_notes(self._version)) if state == "committed" else (),
            took_s=entry.took_s,
            version=entry.version,
            before=entry.before,
            share=entry.share,
            offered=entry.offered,
            looked=entry.looked,
        )

    def request(self, request: UpdateRequest) -> None:
        """Write a request file for the updater.

        Raises UpdateBusy while a request or an update is in progress, UpdateWrongDevice without an updater,
        UpdateFailed if the file cannot be written.
        """
        requests = self._refuse_elsewhere()[1]
        self._refuse_while_under_way()
        try:
            write_request(requests, request)
        except OSError as error:
            raise UpdateFailed(f"the updater cannot be told: {error.strerror}") from error
        self._requested_s = self._clock.now_s()
        self._timeout_error = None

    @contextmanager
    def receiving(self, length: int) -> Iterator[BundleUpload]:
        """Return the temporary file for an uploaded bundle of `length` bytes; the updater sees it after `publish`.

        Raises InputError (invalid length), UpdateNoRoom (the disk reserve for pictures stays free), UpdateBusy,
        UpdateWrongDevice without an updater, UpdateFailed for another disk error. A file that was not published is
        deleted at exit.
        """
        state = self._refuse_elsewhere()[0]
        self._refuse_while_under_way()
        if not 0 < length <= MAX_BYTES:
            raise InputError(f"a file of {length} bytes is no update", "Choose the file whose name ends in .raucb.")
        if not self._receiving.acquire(blocking=False):
            raise UpdateBusy("another file is being sent")
        part = self._part(state)
        try:
            self._refuse_without_space(part.parent, length)
            with open(part, "wb", opener=atomic_io.private_opener) as file:
                yield BundleUpload(part, file, length)
        except OSError as error:
            if not atomic_io.is_full(error):
                raise UpdateFailed(f"the file cannot be saved: {error.strerror}") from error
            raise UpdateNoRoom("the disk is full") from error
        finally:
            part.unlink(missing_ok=True)
            self._receiving.release()

    def _is_waiting(self) -> bool:
        """Return whether a request waits for the updater; after PICKUP_TIMEOUT_S delete it and record an error."""
        assert self._requests is not None
        request = self._requests / REQUEST_FILE
        if not request.exists():
            return False
        if self._clock.now_s() - self._requested_s < PICKUP_TIMEOUT_S:
            return True
        request.unlink(missing_ok=True)
        self._timeout_error = StoredError.of(UpdateFailed(f"the updater took no request in {PICKUP_TIMEOUT_S:g} s"))
        return False

    def _refuse_elsewhere(self) -> tuple[Path, Path]:
        if self._state is None or self._requests is None or not self.is_here:
            raise UpdateWrongDevice("this computer has no updater", NO_UPDATER_REMEDY)
        return self._state, self._requests

    def _refuse_while_under_way(self) -> None:
        now = self.status().state
        if now in ("asked", "restarting", *UNDER_WAY):
            raise UpdateBusy(f"the updater is at it: {now}")

    @staticmethod
    def _part(state: Path) -> Path:
        return state / TABLET / f".{UPLOAD}.part"

    @staticmethod
    def _refuse_without_space(folder: Path, length_bytes: int) -> None:
        """Raise UpdateNoRoom without space for the bundle twice: the updater makes a protected copy."""
        free = atomic_io.free_bytes(folder)
        twice = 2 * length_bytes
        if not atomic_io.has_room(twice, free):
            raise UpdateNoRoom(f"{free} bytes are free, and {twice + atomic_io.RESERVE_BYTES} are needed")


def _publish(part: Path, whole: Path) -> None:
    part.chmod(WORLD_READABLE)
    atomic_io.fsync_file(part)
    atomic_io.replace_durably(part, whole)


def release_notes(version: str, file: Path = resources.CHANGELOG) -> list[str]:
    """Return the changelog items of `version` as plain text, else those of the newest release; [] without a file."""
    try:
        changelog = file.read_text(encoding="utf-8")
    except OSError:
        return []
    parts = re.split(r"^## +", changelog, flags=re.M)[1:]
    part = next((part for part in parts if part.split()[0] == version), parts[0] if parts else "")
    items = re.findall(r"^\* (.+(?:\n  .+)*)", part, flags=re.M)
    return [re.sub(r"\s+", " ", re.sub(r"[*`]", "", item)) for item in items]
