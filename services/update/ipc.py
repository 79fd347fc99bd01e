"""Inter-process communication of page and updater by two files: a journal from the updater, a request from the page.

    STATE/journal.json   written by the updater (root), readable by every user: progress and found updates
    RUN/request.json     written for the page by the unprivileged server; the updater removes it before it parses it

Both files are untrusted input: they are read completely, up to a size limit, and validated. A request holds no path,
only the id of an update that the updater itself found.
"""

import json
from contextlib import suppress
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from device import atomic_io
from device.errors import DiffuscopeError
from device.user_files import read_plain_file
from services.errors import UpdateRequestInvalid

STATE_FILE, REQUEST_FILE = "journal.json", "request.json"
TABLET = "tablet"  # subfolder of the updater's folder for files uploaded by the page
UPLOAD = "update.raucb"  # its only file
MAX_STATE_BYTES, MAX_REQUEST_BYTES = 65_536, 1_000
WORLD_READABLE = 0o644  # independent of the umask: the reader is another user

State = Literal[
    "none",
    "looking",
    "fetching",
    "installing",
    "installed",
    "trying",
    "committed",
    "went back",
    "refused",
    "interrupted",
]
MAX_MESSAGE_CHARS = 500  # a message may cite a file of another maker
UNDER_WAY = ("looking", "fetching", "installing")
Id = Field(pattern="^[0-9a-f]{16}$")


class StoredError(BaseModel):
    """An error as stored and shown: code, message and remedy."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    code: str
    message: str
    remedy: str

    @classmethod
    def of(cls, error: DiffuscopeError) -> Self:
        """Return the stored form of an error."""
        return cls(code=error.code, message=error.message[:MAX_MESSAGE_CHARS], remedy=error.remedy)


class FoundUpdate(BaseModel):
    """An update that was found; `trouble` is the reason why it cannot be installed, `id` identifies it in requests.

    `where`: source (USB drive, upload from the tablet, channel). `stick`: name of the drive's folder. `takes_s`: least
    and largest estimated duration of install and restart, from the time of copying the bundle; None if not copied.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)
    id: str = Id
    where: Literal["stick", "tablet", "channel"]
    stick: str = ""
    name: str = ""
    bytes: int = Field(ge=0)
    version: str = ""
    trouble: StoredError | None = None
    takes_s: tuple[float, float] | None = None


class UpdateState(BaseModel):
    """State of the last update.

    `version`: the new version; `before`: the version that installed it. `share`: progress (0 to 1). `trouble`: last
    error. `ill`: health checks that failed before the update. `looked`: a search was done since the last install.
    `boot`: id of the boot in which `state` was written. `settling`: the tried version itself wrote the state.
    `offered`: newer version in the channel. `spent_s`: duration of the last install. `took_s`: duration of the last
    committed update, its install and its boot until it was found healthy.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)  # later releases may add fields
    form: Literal[1] = 1
    state: State = "none"
    version: str = ""
    before: str = ""
    share: float = Field(default=0.0, ge=0, le=1)
    trouble: StoredError | None = None
    ill: tuple[str, ...] = ()
    offered: str = ""
    found: tuple[FoundUpdate, ...] = ()
    looked: bool = False
    boot: str = ""
    settling: bool = False
    spent_s: float = Field(default=0.0, ge=0)
    took_s: float | None = Field(default=None, ge=0)


class UpdateRequest(BaseModel):
    """A technician's request: search for updates, install the found update `id`, or restart into the installed one."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    form: Literal[1] = 1
    do: Literal["check", "install", "restart"]
    id: str | None = Field(default=None, pattern="^[0-9a-f]{16}$")

    @model_validator(mode="after")
    def _installs_something(self) -> Self:
        if (self.id is None) == (self.do == "install"):
            raise ValueError("an install names what to install, and nothing else does")
        return self


def read_state(folder: Path) -> UpdateState:
    """Return the stored state; UpdateState() if it is missing, unreadable or invalid, since it is informative only."""
    try:
        return UpdateState.model_validate_json(read_plain_file(folder / STATE_FILE, MAX_STATE_BYTES))
    except (OSError, ValidationError):
        return UpdateState()


def write_state(folder: Path, entry: UpdateState) -> None:
    """Write the state atomically, readable by every user; OSError if it cannot be written."""
    _put(folder / STATE_FILE, entry)


def write_request(folder: Path, request: UpdateRequest) -> None:
    """Write a request for the updater; OSError if the folder cannot be written."""
    _put(folder / REQUEST_FILE, request)


def take_request(folder: Path) -> UpdateRequest | None:
    """Remove the request and return it; None if there is none, UpdateRequestInvalid if it is invalid.

    The file is removed in every case if possible, so that an invalid request is read once.
    """
    path = folder / REQUEST_FILE
    try:
        content = read_plain_file(path, MAX_REQUEST_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UpdateRequestInvalid(f"the request of the page cannot be read: {error.strerror}") from error
    finally:
        with suppress(OSError):  # removed already, or not removable: then systemd's start limit ends the retries
            path.unlink()
    try:
        return UpdateRequest.model_validate_json(content)
    except ValidationError as error:
        raise UpdateRequestInvalid(f"the request of the page is invalid: {error.errors()[0]['msg']}") from error


def stage_of(entry: UpdateState, runs: str, boot: str) -> str:
    """Return the stage of an update as the page shows it, for running version `runs` and boot id `boot`.

    It is `state`, except: "restarting"; "lost" (a try that did not finish booting); "interrupted" for a fetch or an
    install of an earlier boot; "committed" for a committed try whose state was not written; "none" for a search of an
    earlier boot, and for a committed version that no longer runs.
    """
    same_boot = entry.boot == boot
    match entry.state:
        case "looking":
            return "looking" if same_boot else "none"
        case "fetching" | "installing":
            return entry.state if same_boot else "interrupted"
        case "trying" if entry.version != runs:
            return "restarting" if same_boot else "lost"
        case "trying" if entry.settling and not same_boot:  # committed, then power was cut before the write
            return "committed"
        case "committed" if entry.version != runs:
            return "none"
    return entry.state


def _put(path: Path, note: BaseModel) -> None:
    """Write a model as JSON atomically, with mode 0644."""
    atomic_io.write_atomically(path, json.dumps(note.model_dump()).encode() + b"\n", mode=WORLD_READABLE)
