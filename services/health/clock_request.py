"""Time of a tablet's browser, used where neither network nor a clock cell has set the clock of the device.

The instrument may not set the clock: it leaves the time that a user has accepted as a request, and
`systemd/diffuscope-clock.path` runs this module as root. Journal and audit log record the time before and after; every
later record has the source `browser`: the time was not verified. Only an administrator sets it backwards or once more.
"""

import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from device import atomic_io
from device.clock import Clock, SystemClock, set_system_clock
from device.user_files import read_plain_file
from services.errors import ClockBackwards, ClockRefused
from services.health.clock_source import BROWSER_SOURCE, clock_state
from services.health.thresholds import EARLIEST_DATE

REQUEST = "run/diffuscope-clock/request"
LATEST_DATE = datetime(2060, 1, 1, tzinfo=UTC)  # end of the device's certificates
MAX_REQUEST_BYTES = 64
WORLD_READABLE = 0o644  # the instrument is another user
BACK = "back "  # before the time in the request of an administrator


def needs_time(root: Path = Path("/")) -> bool:
    """Return whether nothing has set the clock since the start, and a request for it can be left."""
    return clock_state(root) == "not_set" and (root / REQUEST).parent.is_dir()


def request_time(now: datetime, clock: Clock, by_administrator: bool = False, root: Path = Path("/")) -> None:
    """Request that the clock is set to `now`, with a time zone.

    ClockRefused if the clock has a source (`browser` is none for an administrator), on a computer without the unit's
    folder, and for an impossible date; ClockBackwards for a time before the present one by another user.
    """
    request = root / REQUEST
    if not request.parent.is_dir() or not _is_settable(now, by_administrator, root):
        raise ClockRefused(f"the clock is not set to {now}: its source is {clock_state(root)!r}")
    if now < clock.wall() and not by_administrator:
        raise ClockBackwards(f"{now} is before the time of the device, {clock.wall()}")
    content = f"{BACK if by_administrator else ''}{now.astimezone(UTC).isoformat()}"
    atomic_io.write_atomically_unsynced(request, content.encode())


def take_request(set_clock: Callable[[datetime], None], clock: Clock, root: Path = Path("/")) -> str:
    """Set the clock as requested, by `set_clock`, and return a sentence for the journal.

    The request is removed first, so that an invalid one is not repeated. Nothing is set if the clock has a source now.
    The instrument may write the folder, and the caller is root: no link is followed, and OSError for a long request.
    """
    try:
        content = read_plain_file(root / REQUEST, MAX_REQUEST_BYTES).decode("ascii")
    finally:
        (root / REQUEST).unlink()
    by_administrator = content.startswith(BACK)
    now = datetime.fromisoformat(content.removeprefix(BACK))
    before = clock.wall()
    if not _is_settable(now, by_administrator, root) or (now < before and not by_administrator):
        return f"The time of a tablet, {now}, is not needed"
    set_clock(now)
    source = f"{before.isoformat()} {now.isoformat()}\n"
    atomic_io.write_atomically(root / BROWSER_SOURCE, source.encode(), WORLD_READABLE)
    return f"The clock was set by a tablet, from {before} to {now}"


def _is_settable(now: datetime, by_administrator: bool, root: Path) -> bool:
    """Return whether the clock may be set: it has no source, or that of a tablet and an administrator sets it again."""
    sources = ("not_set", "browser") if by_administrator else ("not_set",)
    return clock_state(root) in sources and EARLIEST_DATE <= now < LATEST_DATE


if __name__ == "__main__":
    sys.stdout.write(take_request(set_system_clock, SystemClock()) + "\n")
