"""Source of the date: network, clock cell of the board, or none since the start of the computer."""

from pathlib import Path

from services.health.thresholds import EARLIEST_DATE
from services.records.capture import ClockState

BROWSER_SOURCE = "run/diffuscope-clock/source"  # written when a tablet set the clock


def clock_state(root: Path = Path("/")) -> ClockState:
    """Return the source of the date; `root` is the root of the file system.

    `network` once timesyncd has set the clock, `browser` once a tablet has (clock_request.py), `rtc` if the clock of
    the board kept a plausible date, else `not_set`: a board without a cell starts its clock in 1970, and systemd takes
    the time of the last shutdown, which is too early.
    """
    if (root / "run/systemd/timesync/synchronized").exists():
        return "network"
    if (root / BROWSER_SOURCE).exists():
        return "browser"
    try:
        since_epoch_s = float((root / "sys/class/rtc/rtc0/since_epoch").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return "not_set"
    return "rtc" if since_epoch_s >= EARLIEST_DATE.timestamp() else "not_set"
