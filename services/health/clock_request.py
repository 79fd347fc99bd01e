"""Time of a tablet's browser, used where neither network nor a clock cell has set the clock of the device.

The instrument may not set the clock: it leaves a request, and `systemd/diffuscope-clock.path` runs this module as root.
The journal records the time before and after; every later record has the source `browser`.
"""

import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from device import atomic_io
from device.clock import Clock, SystemClock, set_system_clock
from services.health.clock_source import BROWSER_SOURCE, clock_state
from services.health.thresholds import EARLIEST_DATE

REQUEST = "run/diffuscope-clock/request"
LATEST_DATE = datetime(2060, 1, 1, tzinfo=UTC)  # end of the device's certificates


def offer_time(now: datetime, root: Path = Path("/")) -> bool:
    """Request that the clock is set to `now`, with a time zone; return whether a request was written.

    No request if the clock has a source, on a computer without the unit's folder, and for an impossible date.
    """
    request = root / REQUEST
    if clock_state(root) != "not_set" or not request.parent.is_dir() or not EARLIEST_DATE <= now < LATEST_DATE:
        return False
    atomic_io.write_atomically_unsynced(request, now.astimezone(UTC).isoformat().encode())
    return True


def take_request(set_clock: Callable[[datetime], None], clock: Clock, root: Path = Path("/")) -> str:
    """Set the clock as requested, by `set_clock`, and return a sentence for the journal.

    The request is removed first, so that an invalid one is not repeated. Nothing is set if the clock has a source now.
    """
    content = (root / REQUEST).read_bytes()
    (root / REQUEST).unlink()
    now = datetime.fromisoformat(content.decode("ascii"))
    if clock_state(root) != "not_set" or not EARLIEST_DATE <= now < LATEST_DATE:
        return f"The time of a tablet, {now}, is not needed"
    before = clock.wall()
    set_clock(now)
    (root / BROWSER_SOURCE).write_text(f"{before.isoformat()} {now.isoformat()}\n", encoding="ascii")
    return f"The clock was set by a tablet, from {before} to {now}"


if __name__ == "__main__":
    sys.stdout.write(take_request(set_system_clock, SystemClock()) + "\n")
