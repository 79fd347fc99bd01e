"""What page and updater tell one another: a journal that the updater writes, and a wish that the page leaves.

    STATE/journal.json   the updater's (root), for everybody to read: how far the last update is, and what was found
    RUN/wish.json        the page's (nobody in particular), taken away by the updater before it is looked at

Neither trusts the other's file: both are read whole, up to a limit, and checked; a wish holds no path, only the name of
something that the updater itself has found.
"""

import io
import json
import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from device.errors import DiffuscopeError, UpdateNotUnderstood
from services.records import disk

JOURNAL, WISH = "journal.json", "wish.json"
TABLET = "tablet"  # folder in the updater's, into which the page puts what a tablet sent
UPLOAD = "update.raucb"  # the one file in it
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
MOST_JOURNAL_BYTES, MOST_WISH_BYTES = 65_536, 1_000
PLAINLY = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
FOR_EVERYBODY = 0o644  # whatever the umask of whoever writes: the other side is another user

State = Literal[
    "none", "looking", "fetching", "installing", "installed", "trying", "committed", "went back", "refused",
    "interrupted",
]  # fmt: skip
UNDER_WAY = ("looking", "fetching", "installing")
Id = Field(pattern="^[0-9a-f]{16}$")


class Trouble(BaseModel):
    """Why something was not done, as every error of ours says it."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    code: str
    message: str
    remedy: str

    @classmethod
    def of(cls, error: DiffuscopeError) -> Self:
        """An error, written down."""
        return cls(code=error.code, message=error.message, remedy=error.remedy)


class Found(BaseModel):
    """An update that could be installed, or why not; `id` is the name by which it is wished for.

    `takes_s` is within which time it would be done, guessed from how long its first copy took.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)
    id: str = Id
    where: Literal["stick", "tablet", "channel"]
    stick: str = ""
    name: str = ""
    bytes: int = Field(ge=0)
    version: str = ""
    trouble: Trouble | None = None
    takes_s: tuple[float, float] | None = None


class Entry(BaseModel):
    """How far an update is.

    `trouble` is what went wrong; `ill` the checks that failed before the update, which it is not blamed for; `boot` the
    start of the computer in which `state` was written; `settling` that the version that is tried wrote it itself;
    `offered` what the channel has that is newer. `spent_s` is how long the install took that is under way or waits,
    `took_s` how long the last update took that was committed: its install, and its start until it was found well.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)  # a later release may say more
    form: Literal[1] = 1
    state: State = "none"
    version: str = ""
    before: str = ""
    share: float = Field(default=0.0, ge=0, le=1)
    trouble: Trouble | None = None
    ill: tuple[str, ...] = ()
    offered: str = ""
    found: tuple[Found, ...] = ()
    looked: bool = False
    boot: str = ""
    settling: bool = False
    spent_s: float = Field(default=0.0, ge=0)
    took_s: float | None = Field(default=None, ge=0)


class Wish(BaseModel):
    """What a technician tapped: look for updates, install one that was found, or restart to try what is installed."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    form: Literal[1] = 1
    do: Literal["check", "install", "restart"]
    id: str | None = Field(default=None, pattern="^[0-9a-f]{16}$")

    @model_validator(mode="after")
    def _installs_something(self) -> Self:
        if (self.id is None) == (self.do == "install"):
            raise ValueError("an install names what to install, and nothing else does")
        return self


def this_boot() -> str:
    """The name of this start of the computer, which the kernel draws."""
    return BOOT_ID.read_text(encoding="ascii").strip()


def read_entry(folder: Path) -> Entry:
    """The journal's entry; one that cannot be read, or is of another form, counts as none, since it only tells."""
    try:
        return Entry.model_validate_json(_read(folder / JOURNAL, MOST_JOURNAL_BYTES))
    except (OSError, ValidationError):
        return Entry()


def write_entry(folder: Path, entry: Entry) -> None:
    """Put an entry where both sides read it, whole at any moment."""
    _put(folder / JOURNAL, entry)


def leave(folder: Path, wish: Wish) -> None:
    """Leave a wish for the updater; an OSError if the folder does not take it."""
    _put(folder / WISH, wish)


def take(folder: Path) -> Wish | None:
    """Take a wish away and read it: None if there is none, UpdateNotUnderstood if it is not one.

    Whatever lies there is gone afterwards: the same nonsense is not looked at twice.
    """
    path = folder / WISH
    try:
        said = _read(path, MOST_WISH_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UpdateNotUnderstood(f"the page's wish cannot be read: {error.strerror}") from error
    finally:
        with suppress(OSError):  # gone already; or nothing that we may remove, and then systemd stops asking
            path.unlink()
    try:
        return Wish.model_validate_json(said)
    except ValidationError as error:
        raise UpdateNotUnderstood(f"the page's wish is none: {error.errors()[0]['msg']}") from error


def stage(entry: Entry, runs: str, boot: str) -> str:
    """What the page tells of an entry, read by version `runs` in the start `boot` of the computer.

    As `state`, but also `restarting` and `lost` (a try that never came to an end), and nothing that is over and done.
    """
    same_boot = entry.boot == boot
    match entry.state:
        case "looking":
            return "looking" if same_boot else "none"
        case "fetching" | "installing":
            return entry.state if same_boot else "interrupted"
        case "trying" if entry.version != runs:
            return "restarting" if same_boot else "lost"
        case "trying" if entry.settling and not same_boot:  # what runs once more was committed; then the power went
            return "committed"
        case "committed" if entry.version != runs:
            return "none"
    return entry.state


def _read(path: Path, most_bytes: int) -> bytes:
    """A plain file, whole: no link, no pipe, nothing without an end."""
    with io.FileIO(os.open(path, PLAINLY), closefd=True) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(0, "it is no plain file")
        said = file.read(most_bytes + 1)
    if len(said) > most_bytes:
        raise OSError(0, f"it is longer than {most_bytes} bytes")
    return said


def _put(path: Path, note: BaseModel) -> None:
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    with part.open("xb") as file:
        os.fchmod(file.fileno(), FOR_EVERYBODY)
        file.write(json.dumps(note.model_dump()).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    disk.settle(path.parent)
