"""Real RAUC on this computer: its service on a private D-Bus, small slots on loop devices, and our boot chooser."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from device.clock import SystemClock
from services.update.bootchooser import BootChooser
from services.update.settings import UpdateSettings
from services.update.updater import Updater
from tests.appliance.device import run
from tests.appliance.releases import Workshop
from tests.project_files import ROOT

NOWHERE = "http://127.0.0.1:9"  # no instrument; a device whose page does not answer may be updated
SLOT_KB, BOOT_KB = 32_768, 64
BACKEND = """\
#!{python} -I
import sys
from pathlib import Path

sys.path.insert(0, "{root}")
from services.update.bootchooser import BootChooser, main

here = Path("{here}")
places = here / "chooser/autoboot.txt", here / "state", here / "word", here / "cmdline"
sys.exit(main(sys.argv[1:], BootChooser(*places)))
"""


@dataclass
class Bench:
    """Emulated device for RAUC and the updater: boot selection and slots; nothing boots."""

    here: Path
    workshop: Workshop
    loops: dict[str, str] = field(default_factory=dict)
    reports: list[str] = field(default_factory=list)
    bus: str = ""

    @property
    def chooser(self) -> BootChooser:
        here = self.here
        return BootChooser(here / "chooser/autoboot.txt", here / "state", here / "word", here / "cmdline")

    def rauc(self, *before: str) -> tuple[str, ...]:
        """Return the command line of RAUC on this bench; `before` are prefix words, such as faketime."""
        bus = ("DBUS_STARTER_BUS_TYPE=session", f"DBUS_SESSION_BUS_ADDRESS={self.bus}")
        return ("env", *bus, *before, "rauc", "-c", str(self.here / "system.conf"))

    def settings(self, **changed: object) -> UpdateSettings:
        here = self.here
        known = {"sticks": here / "media", "folder": here / "state", "keyring": self.workshop.keys / "ca.crt"}
        rest = {"rauc": self.rauc(), "restart": ("true",), "instrument": NOWHERE, "modules": here / "modules"}
        return UpdateSettings(**known | rest | changed)  # type: ignore[arg-type]

    def updater(self, runs: str = "1.0", **changed: object) -> Updater:
        return Updater(self.settings(**changed), SystemClock(), self.reports.append, self.chooser, runs)

    @contextmanager
    def service(self, *before: str) -> Iterator[subprocess.Popen[bytes]]:
        """Run RAUC's service, in the slot that the firmware booted."""
        words = [*self.rauc(*before), "service", f"--override-boot-slot={self.chooser.booted()}"]
        with (self.here / "service.log").open("ab") as log:
            service = subprocess.Popen(words, stdout=log, stderr=log, start_new_session=True)
        try:
            end = time.monotonic() + 60
            while subprocess.run([*self.rauc(), "status"], capture_output=True).returncode:
                assert time.monotonic() < end, (self.here / "service.log").read_text()
                time.sleep(0.02)
            yield service
        finally:
            service.terminate()
            service.wait(60)

    def boot(self) -> str:
        """Emulate the firmware after an orderly restart; return the slot that runs."""
        slot = self.chooser.primary()
        (self.here / "word").unlink(missing_ok=True)
        (self.here / "cmdline").write_text(f"rauc.slot={slot}\n")
        return slot

    def version(self, slot: str) -> str:
        """Mount a slot and read it completely; return its version. OSError from the kernel if it is damaged."""
        root = self.here / "root"
        run("mount", "-t", "squashfs", "-o", "ro", self.loops[slot], root)
        try:
            (root / "noise").read_bytes()
            return (root / "version").read_text()
        finally:
            run("umount", root)

    def fill(self, slot: str, bundle: Path) -> None:
        """Write the image of a bundle into a slot, as in the factory."""
        folder = self.here / f"{bundle.stem}-image"
        run("unsquashfs", "-q", "-n", "-f", "-d", folder, bundle, "rootfs.img")
        run("dd", f"if={folder / 'rootfs.img'}", f"of={self.loops[slot]}", "bs=4M", "conv=fsync", "status=none")


@contextmanager
def opened(here: Path, workshop: Workshop, slot_kb: int = SLOT_KB) -> Iterator[Bench]:
    """Yield a bench with the committed slot A running and both slots empty."""
    bench = Bench(here, workshop)
    for name in ("chooser", "state", "media", "root"):
        (here / name).mkdir(parents=True)
    (here / "chooser/autoboot.txt").write_text("[all]\ntryboot_a_b=1\nboot_partition=2\n[tryboot]\nboot_partition=3\n")
    (here / "cmdline").write_text("rauc.slot=A\n")
    (here / "backend").write_text(BACKEND.format(python=sys.executable, root=ROOT, here=here))
    (here / "backend").chmod(0o755)
    address = ["dbus-daemon", "--session", "--nofork", "--nopidfile", "--print-address=1"]
    daemon = subprocess.Popen(address, stdout=subprocess.PIPE, text=True)
    try:
        assert daemon.stdout is not None
        bench.bus = daemon.stdout.readline().strip()
        for slot, size_kb in (("A", slot_kb), ("B", slot_kb), ("boot-a", BOOT_KB), ("boot-b", BOOT_KB)):
            run("truncate", "-s", f"{size_kb}K", here / f"{slot}.img")
            bench.loops[slot] = run("losetup", "-f", "--show", here / f"{slot}.img").strip()
        (here / "system.conf").write_text(_conf(bench))
        yield bench
    finally:
        clear(bench)
        for loop in bench.loops.values():
            subprocess.run(["losetup", "-d", loop], check=False)
        daemon.terminate()
        daemon.communicate(timeout=60)


def clear(bench: Bench) -> None:
    """Unmount what a killed RAUC left, which also frees its loop device, as a reboot would."""
    for mounted in sorted((bench.here / "mnt").glob("*"), reverse=True):
        if os.path.ismount(mounted):
            run("umount", "-l", mounted)


def _conf(bench: Bench) -> str:
    """Return the system.conf of a release with this bench's paths."""
    text = (ROOT / "systemd" / "image" / "system.conf").read_text()
    for theirs, ours in {
        "@FORMATS@": "plain verity",
        "/run/rauc": str(bench.here / "mnt"),
        "/var/lib/diffuscope-update": str(bench.here / "state"),
        "/etc/rauc/keyring.pem": str(bench.workshop.keys / "ca.crt"),
        "/opt/diffuscope/services/update/bootchooser.py": str(bench.here / "backend"),
        "/dev/disk/by-partlabel/root-a": bench.loops["A"],
        "/dev/disk/by-partlabel/root-b": bench.loops["B"],
        "/dev/disk/by-partlabel/boot-a": bench.loops["boot-a"],
        "/dev/disk/by-partlabel/boot-b": bench.loops["boot-b"],
    }.items():
        assert theirs in text, f"system.conf no longer says {theirs}"
        text = text.replace(theirs, ours)
    (bench.here / "mnt").mkdir()
    return text
