"""Emulated device for updates: folders for USB drive, boot slots and boot selection, and a fake RAUC.

The updater is the real one, in its own process beside the page: `python -m tests.updates answer FOLDER VERSION` is the
call that systemd makes on a device. `tests/rauc.py` prints recorded output of RAUC 1.8; `tests/appliance` runs the real
RAUC. A bundle is a line of JSON and padding.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread

from device.clock import SystemClock
from services.update.bootchooser import BootChooser
from services.update.ipc import REQUEST_FILE, TABLET
from services.update.settings import UpdateSettings
from services.update.updater import Updater
from tests.project_files import ROOT

DEVICE = "diffuscope-pi5"
NOWHERE = "http://127.0.0.1:9"  # no instrument
AUTOBOOT = "[all]\ntryboot_a_b=1\nboot_partition=2\n[tryboot]\nboot_partition=3\n"
RAUC = ROOT / "tests" / "rauc.py"


@dataclass
class Board:
    """Folders of the device; `first_on_path` comes first on the updater's PYTHONPATH and so sets its version."""

    folder: Path
    instrument: str = NOWHERE
    first_on_path: Path | None = None
    patience_s: float = 2.0

    @classmethod
    def new(cls, folder: Path, instrument: str = NOWHERE) -> "Board":
        """Return a factory-new device: slot A runs and is committed."""
        for name in ("chooser", "media/STICK", f"state/{TABLET}", "requests"):
            (folder / name).mkdir(parents=True)
        (folder / "chooser/autoboot.txt").write_text(AUTOBOOT)
        (folder / "cmdline").write_text("rauc.slot=A\n")
        return cls(folder, instrument)

    @property
    def state(self) -> Path:
        return self.folder / "state"

    @property
    def requests(self) -> Path:
        return self.folder / "requests"

    @property
    def stick(self) -> Path:
        return self.folder / "media" / "STICK"

    @property
    def chooser(self) -> BootChooser:
        here = self.folder
        return BootChooser(here / "chooser/autoboot.txt", self.state, here / "word", here / "cmdline")

    def settings(self, **changed: object) -> UpdateSettings:
        here = self.folder
        known: dict[str, object] = {
            "sticks": here / "media",
            "folder": self.state,
            "requests": self.requests,
            "keyring": here / "ca.crt",
            "rauc": (sys.executable, "-IS", str(RAUC), str(here)),
            "instrument": self.instrument,
            "restart": ("touch", str(here / "off")),
            "answer_s": 2.0,
            "patience_s": self.patience_s,
            "modules": here / "modules",
        }
        return UpdateSettings(**known | changed)  # type: ignore[arg-type]

    def updater(self, runs: str, **changed: object) -> Updater:
        return Updater(self.settings(**changed), SystemClock(), print, self.chooser, runs)

    def bundle(self, name: str, version: str = "2.0", padding_bytes: int = 3_000_000, **changed: str) -> Path:
        """Write an update bundle to the USB drive; return its path."""
        path = self.stick / name
        manifest = {
            "compatible": DEVICE,
            "version": version,
            "minimum": "0.1",
            "signer": "ours",
            "slot": "large",
        } | changed
        path.write_bytes(json.dumps(manifest).encode() + b"\n" + bytes(padding_bytes))
        return path

    def hold(self) -> None:
        """Pause the next install at half of its steps, until `release`."""
        (self.folder / "hold").touch()

    def release(self) -> None:
        (self.folder / "hold").unlink()

    @property
    def is_off(self) -> bool:
        """Whether the updater has restarted the device."""
        return (self.folder / "off").exists()

    def boot(self) -> str:
        """Emulate the firmware after an orderly restart; return the slot that runs."""
        slot = self.chooser.primary()
        for name in ("word", "off"):
            (self.folder / name).unlink(missing_ok=True)
        (self.folder / "cmdline").write_text(f"rauc.slot={slot}\n")
        return slot

    def run(self, word: str, version: str) -> str:
        """Call the updater as systemd does; return its output."""
        words = [
            sys.executable,
            "-m",
            "tests.updates",
            word,
            str(self.folder),
            version,
            self.instrument,
            str(self.patience_s),
        ]
        place = {"PYTHONPATH": str(self.first_on_path)} if self.first_on_path else {}
        done = subprocess.run(
            words, cwd=ROOT, env=os.environ | place, capture_output=True, text=True, timeout=150, check=False
        )
        return done.stdout + done.stderr

    @contextmanager
    def path_unit(self, version: str) -> Iterator[list[str]]:
        """Emulate `diffuscope-update-request.path` while version `version` runs; yield the outputs of the updater."""
        outputs: list[str] = []
        over = Event()

        def watch() -> None:
            while not over.wait(0.05):
                if (self.requests / REQUEST_FILE).exists():
                    outputs.extend((self.run("answer", version), self.run("tidy", version)))

        thread = Thread(target=watch)
        thread.start()
        try:
            yield outputs
        finally:
            over.set()
            thread.join(60)


if __name__ == "__main__":
    word, folder, runs, at, patience_s = sys.argv[1:]
    assert word in ("answer", "tidy", "settle")
    getattr(Board(Path(folder), at, patience_s=float(patience_s)).updater(runs), word)()
