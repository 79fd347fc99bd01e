"""The real application in this process, on a port: a small simulated head whose parts a test breaks while it serves."""

import threading
import time
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path

import uvicorn

from device.spec import load_head
from services.instrument.exporting import Sticks
from tests.journey.asking import Attentive, Shelf, equipped
from tests.journey.conftest import SMALL_HEAD, GateClock, Rig, builder, coarsened


class Watch(GateClock):
    """Real time, and a date that somebody may set while it goes on."""

    def __init__(self) -> None:
        super().__init__()
        self.moved = timedelta(0)

    def now_s(self) -> float:
        return time.monotonic()

    def wall(self) -> datetime:
        return datetime.now(UTC) + self.moved

    def sleep(self, duration_s: float) -> None:
        assert self.gate.wait(30)
        time.sleep(max(0.0, duration_s))


class Real:
    """An instrument that serves: `rig` is its inside, `clock` its watch, `shelf` how much room it believes it has.

    `stick` is the folder of a simulated USB stick, mounted between `put_in` and `pull_out`.
    """

    def __init__(self, folder: Path, port: int) -> None:
        self.url, self.clock, self.shelf = f"http://127.0.0.1:{port}", Watch(), Shelf()
        self.stick, self._undo = folder / "media" / "USB STICK", ExitStack()
        self._mounts = folder / "mounts"
        self.pull_out()
        (folder / "head.toml").write_text(SMALL_HEAD)
        build = builder(coarsened(load_head(folder / "head.toml")), folder / "plans")
        self.bulletin = Attentive()
        self.rig: Rig = build(
            folder, self._undo, head=lambda head: equipped(head, self.clock.wall()),
            store={"free_bytes": self.shelf}, clock=self.clock,
            bulletin=self.bulletin, wait=False, sticks=Sticks((folder / "media",), self._mounts),
        )  # fmt: skip
        assert self.rig.exam.ready.wait(300), "a busy computer makes plans for minutes"
        config = uvicorn.Config(self.rig.app, port=port, log_level="error", ws="none", timeout_graceful_shutdown=3)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run)

    def put_in(self) -> None:
        """Mount a USB stick, as the kernel would list it."""
        self.stick.mkdir(parents=True, exist_ok=True)
        name = str(self.stick).replace(" ", "\\040")
        self._mounts.write_text(f"/dev/sda1 {name} vfat rw 0 0\n")

    def pull_out(self) -> None:
        """Unmount the USB stick."""
        self._mounts.write_text("proc /proc proc rw 0 0\n")

    def __enter__(self) -> "Real":
        self._thread.start()
        while not self._server.started:
            time.sleep(0.01)
        return self

    def __exit__(self, *_: object) -> None:
        self.rig.bulletin.close()  # ends the event streams, which would otherwise hold up the shutdown
        self._server.should_exit = True
        self._thread.join(10)
        self._undo.close()
