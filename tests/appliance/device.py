"""Emulated device with two boot slots: emulated Raspberry Pi firmware, and a real systemd in the booted slot.

Slots and data partition are loop devices. The firmware reads `autoboot.txt` and the reboot argument, and boots the
selected slot's image in a container, where RAUC finds the loop devices under the names of the real partitions.
"""

import os
import stat
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from signal import SIGKILL

from tests.systemd.machine import CACHE, Machine, leader

PARTITIONS = {"2": "A", "3": "B"}
NAMES = {"A": "root-a", "B": "root-b", "boot-a": "boot-a", "boot-b": "boot-b"}
SLOT_MB, BOOT_MB, DATA_MB = 500, 4, 1600
FOLDERS = ("captures", "compiled", "update", "journal", "network", "timesync", "settings")

# The container shows the host's kernel command line; ours is mounted over it, also in units with their own /proc.
FIRST = """\
mount --bind /run/cmdline /proc/cmdline
for unit in settle update-request; do
	place=/run/systemd/system/diffuscope-$unit.service.d
	mkdir -p $place
	printf '[Service]\\nBindReadOnlyPaths=/run/cmdline:/proc/cmdline\\n' >$place/slot.conf
done
exec /lib/systemd/systemd
"""


def run(*words: object, **options: object) -> str:
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, **options)  # type: ignore[call-overload]
    assert done.returncode == 0, f"{' '.join(map(str, words))}: {done.stdout}{done.stderr}"
    return str(done.stdout)


@dataclass
class Device:
    """Board and card; `folder` holds the files of the loop devices."""

    folder: Path
    loops: dict[str, str] = field(default_factory=dict)
    booted: str = ""
    tried: bool = False  # the next boot takes [tryboot]

    @property
    def chooser(self) -> Path:
        return self.folder / "chooser"

    @property
    def data(self) -> Path:
        return self.folder / "data"

    def autoboot(self) -> tuple[str, str]:
        """Return the committed slot and the other one."""
        every, once = (self.chooser / "autoboot.txt").read_text().split("[tryboot]")
        slots = [PARTITIONS[part.split("boot_partition=")[1].split()[0]] for part in (every, once)]
        return slots[0], slots[1]

    @contextmanager
    def on(self, *more: str) -> Iterator[Machine]:
        """Boot the selected slot; yield the machine until it powers off, restarts, or the test ends."""
        self.booted = self.autoboot()[1 if self.tried else 0]
        self.tried = False
        (self.folder / "cmdline").write_text(f"console=tty1 rauc.slot={self.booted} systemd.volatile=overlay\n")
        root = self.folder / "root"
        run("mount", "-o", "ro", self.loops[self.booted], root)
        try:
            with self._running(root, more) as machine:
                yield machine
        finally:
            run("umount", root)

    @contextmanager
    def _running(self, root: Path, more: tuple[str, ...]) -> Iterator[Machine]:
        loops = [f"--bind={path}" for path in _loop_devices()]
        words = [
            "systemd-nspawn",
            "--quiet",
            "-D",
            str(root),
            "--register=no",
            "--keep-unit",
            "--private-network",
            "--volatile=overlay",
            "--console=pipe",
            "--machine=diffuscope-device",
            "--bind=/dev/loop-control",
            *loops,
            *(f"--bind={self.loops[slot]}:/dev/disk/by-partlabel/{name}" for slot, name in NAMES.items()),
            f"--bind={self.data}:/data",
            f"--bind={self.chooser}:/boot/chooser",
            f"--bind={self.folder / 'media'}:/media",
            f"--bind-ro={self.folder / 'cmdline'}:/run/cmdline",
            *more,
            "/bin/sh",
            "-c",
            FIRST,
        ]
        log = self.folder / "console"
        with log.open("wb") as console:
            nspawn = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=console, stderr=console)
        word = pid = -1
        try:
            pid = leader(nspawn, log)
            machine = Machine(pid)
            machine.until(lambda: machine.is_there("/run/systemd/private"))
            word = os.open(Path("/proc") / str(pid) / "root" / "run" / "systemd", os.O_RDONLY | os.O_DIRECTORY)
            yield machine
            if nspawn.poll() is None:
                machine.run("systemctl", "poweroff", "--force", check=False)
            nspawn.wait(60)
        finally:
            if nspawn.poll() is None:
                os.kill(pid if pid > 0 else nspawn.pid, SIGKILL)  # the first process inside; all others end with it
            nspawn.wait(60)
            if word >= 0:
                self.tried = nspawn.returncode == 133 and "tryboot" in _read_at(word, "reboot-param")
                os.close(word)

    def restarts(self, machine: Machine, patience_s: float = 300.0) -> None:
        """Wait until the machine is off."""
        end = time.monotonic() + patience_s
        while machine.is_on():
            assert time.monotonic() < end, f"it did not restart{machine.journal()}"
            time.sleep(0.1)

    def journal_tail(self) -> str:
        """Return the last lines of the journal on the data partition, also of a machine that is off."""
        words = ["journalctl", "-D", str(self.data / "journal"), "--no-pager", "-n", "60"]
        return subprocess.run(words, capture_output=True, text=True, check=False).stdout

    def captures(self) -> dict[str, str]:
        """Return the SHA-256 of every file of every capture, by path."""
        folder = self.data / "captures" / "captures"
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        sums = run("sha256sum", *paths).splitlines() if paths else []
        return {line.split(maxsplit=1)[1].removeprefix(str(folder)): line.split()[0] for line in sums}


def _loop_devices() -> list[Path]:
    """Create more loop device nodes than are in use: RAUC needs a free one, and a container does not see later ones."""
    nodes = [Path(f"/dev/loop{number}") for number in range(64)]
    for number, node in enumerate(nodes):
        if not node.exists():
            os.mknod(node, stat.S_IFBLK | 0o660, os.makedev(7, number))
    return nodes


def _read_at(folder: int, name: str) -> str:
    """Return a file of the container's tmpfs, which stays readable through its descriptor after the container's end."""
    try:
        descriptor = os.open(name, os.O_RDONLY, dir_fd=folder)
    except FileNotFoundError:
        return ""
    with open(descriptor, encoding="utf-8") as file:
        return file.read()


@contextmanager
def factory_new(folder: Path, image: Path) -> Iterator[Device]:
    """Yield a factory-new device: `image` in slot A, slot B and the data partition empty."""
    device = Device(folder)
    for name in ("chooser", "data", "root", "media"):
        (folder / name).mkdir(parents=True)
    text = "[all]\ntryboot_a_b=1\nboot_partition=2\n[tryboot]\nboot_partition=3\n"
    (device.chooser / "autoboot.txt").write_text(text)
    try:
        sizes_mb = {"A": SLOT_MB, "B": SLOT_MB, "boot-a": BOOT_MB, "boot-b": BOOT_MB, "data": DATA_MB}
        for name, size_mb in sizes_mb.items():
            file = folder / f"{name}.img"
            run("truncate", "-s", f"{size_mb}M", file)
            device.loops[name] = run("losetup", "-f", "--show", file).strip()
        run("dd", f"if={image}", f"of={device.loops['A']}", "bs=4M", "conv=fsync", "status=none")
        run("mkfs.ext4", "-q", "-F", device.loops["data"])
        run("mount", device.loops["data"], device.data)
        for name in FOLDERS:
            (device.data / name).mkdir()
        if (CACHE / "appliance").is_dir():  # numba's cache of earlier runs
            run("cp", "-a", CACHE / "appliance" / ".", device.data / "compiled")
        yield device
        (CACHE / "appliance").mkdir(parents=True, exist_ok=True)
        run("cp", "-a", device.data / "compiled" / ".", CACHE / "appliance")
    finally:
        subprocess.run(["umount", str(device.data)], check=False)
        for loop in device.loops.values():
            subprocess.run(["losetup", "-d", loop], check=False)
