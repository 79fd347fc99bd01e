"""The page's side of an update: what the updater's journal says, a wish left for it, a tablet's file where it looks.

Nothing here installs anything, or has the right to: the updater is another process, with rights of its own.
"""

import os
import re
from collections.abc import AsyncIterator
from pathlib import Path
from threading import Lock
from typing import Any

from starlette.concurrency import run_in_threadpool

from device.clock import Clock
from device.errors import InputError, UpdateBusy, UpdateFailed, UpdateNoRoom, UpdateWrongDevice
from services import resources
from services.records import disk
from services.records.update_notes import (
    FOR_EVERYBODY,
    TABLET,
    UNDER_WAY,
    UPLOAD,
    WISH,
    Trouble,
    Wish,
    leave,
    read_entry,
    stage,
    this_boot,
)  # fmt: skip

MOST_BYTES = 2_000_000_000  # of a tablet's file; a bundle has some 350 MB
PATIENCE_S = 90.0  # for whoever takes wishes to take one, on a computer that has much to do
NOT_HERE = "Updates are for the device. On another computer, put the new version in as its README says."


class UpdateDesk:
    """Where page and updater meet: `state` is the updater's folder, `wishes` the one that it looks into.

    None for both, or folders that are not there: this computer has no updater, and the page says so.
    """

    def __init__(
        self, state: Path | None, wishes: Path | None, clock: Clock, runs: str, boot: str | None = None
    ) -> None:
        self._state, self._wishes, self._clock, self._runs = state, wishes, clock, runs
        self._boot = boot or this_boot()
        self._left_s = clock.now_s()
        self._unheard: Trouble | None = None
        self._receiving = Lock()
        if state is not None and self.is_here:
            self._part(state).unlink(missing_ok=True)  # of a tablet that was switched off

    @property
    def is_here(self) -> bool:
        """Whether there is an updater to talk to."""
        return self._state is not None and self._wishes is not None and os.access(self._wishes, os.W_OK | os.X_OK)

    def told(self) -> dict[str, Any]:
        """All that the page shows: what runs, how far an update is, what was found, and what went wrong."""
        if self._state is None or not self.is_here:
            return {"here": False, "runs": self._runs, "state": "none", "found": [], "trouble": None, "news": [],
                    "took_s": None}  # fmt: skip
        entry, waits = read_entry(self._state), self._waits()
        state = "asked" if waits else stage(entry, self._runs, self._boot)
        trouble = self._unheard or (None if state in ("asked", "committed") else entry.trouble)
        return {
            "here": True, "runs": self._runs, "state": state, "version": entry.version, "before": entry.before,
            "share": entry.share, "trouble": trouble, "offered": entry.offered, "looked": entry.looked,
            "found": [one.model_dump() for one in entry.found], "took_s": entry.took_s,
            "news": news(self._runs) if state == "committed" else [],
        }  # fmt: skip

    def wish(self, wish: Wish) -> None:
        """Leave a wish; UpdateBusy while one or an update is under way, UpdateWrongDevice where nobody takes it."""
        wishes = self._refuse_elsewhere()[1]
        self._refuse_while_under_way()
        try:
            leave(wishes, wish)
        except OSError as error:
            raise UpdateFailed(f"the updater cannot be told: {error.strerror}") from error
        self._left_s, self._unheard = self._clock.now_s(), None

    async def receive(self, length: int, pieces: AsyncIterator[bytes]) -> None:
        """Put a tablet's file of `length` bytes where the updater looks for it: whole, or not at all.

        InputError, UpdateNoRoom or UpdateBusy if not; pictures keep their reserve.
        """
        state = self._refuse_elsewhere()[0]
        self._refuse_while_under_way()
        if not 0 < length <= MOST_BYTES:
            raise InputError(f"a file of {length} bytes is no update", "Choose the file whose name ends in .raucb.")
        if not self._receiving.acquire(blocking=False):
            raise UpdateBusy("another file is being sent")
        part = self._part(state)
        try:
            self._refuse_without_room(part.parent, length)
            arrived = await self._written(part, pieces)
            if arrived != length:
                raise InputError(f"{arrived} of {length} bytes arrived", "Send the file again, and stay on this page.")
            await run_in_threadpool(_put, part, part.with_name(UPLOAD))
        except OSError as error:
            if not disk.is_full(error):
                raise UpdateFailed(f"the file cannot be kept: {error.strerror}") from error
            raise UpdateNoRoom("the disk is full") from error
        finally:
            part.unlink(missing_ok=True)
            self._receiving.release()

    async def _written(self, part: Path, pieces: AsyncIterator[bytes]) -> int:
        arrived = 0
        with part.open("wb") as file:
            async for piece in pieces:
                arrived += len(piece)
                await run_in_threadpool(file.write, piece)  # a slow card must not hold up the page
        return arrived

    def _waits(self) -> bool:
        """Whether a wish lies there; one that nobody takes is taken back, and that is said."""
        assert self._wishes is not None
        wish = self._wishes / WISH
        if not wish.exists():
            return False
        if self._clock.now_s() - self._left_s < PATIENCE_S:
            return True
        wish.unlink(missing_ok=True)
        self._unheard = Trouble.of(UpdateFailed(f"nobody took the wish in {PATIENCE_S:g} s"))
        return False

    def _refuse_elsewhere(self) -> tuple[Path, Path]:
        if self._state is None or self._wishes is None or not self.is_here:
            raise UpdateWrongDevice("this computer has no updater", NOT_HERE)
        return self._state, self._wishes

    def _refuse_while_under_way(self) -> None:
        now = self.told()["state"]
        if now in ("asked", "restarting", *UNDER_WAY):
            raise UpdateBusy(f"the updater is at it: {now}")

    @staticmethod
    def _part(state: Path) -> Path:
        return state / TABLET / f".{UPLOAD}.part"

    @staticmethod
    def _refuse_without_room(folder: Path, length_bytes: int) -> None:
        """Twice: the updater makes a copy of its own, which nobody else can change."""
        free, needed = disk.free_bytes(folder), 2 * length_bytes + disk.RESERVE_BYTES
        if free < needed:
            raise UpdateNoRoom(f"{free} bytes are free, and {needed} are needed")


def _put(part: Path, whole: Path) -> None:
    part.chmod(FOR_EVERYBODY)
    with part.open("rb") as file:
        os.fsync(file.fileno())
    part.replace(whole)
    disk.settle(whole.parent)


def news(version: str, file: Path = resources.CHANGELOG) -> list[str]:
    """What is new in a version, without marks: its own list of changes, else the newest one; [] without a file."""
    try:
        said = file.read_text(encoding="utf-8")
    except OSError:
        return []
    parts = re.split(r"^## +", said, flags=re.M)[1:]
    part = next((part for part in parts if part.split()[0] == version), parts[0] if parts else "")
    items = re.findall(r"^\* (.+(?:\n  .+)*)", part, flags=re.M)
    return [re.sub(r"\s+", " ", re.sub(r"[*`]", "", item)) for item in items]
