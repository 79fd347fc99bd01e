"""Emulated board in QEMU that boots a card: firmware of a Raspberry Pi 5 emulated here, kernel and card real.

The firmware reads `autoboot.txt` and the restart argument, selects a boot partition, and starts the kernel in it with
the command line of that partition. The processor is emulated by QEMU (TCG); a power cut is a kill of QEMU.
"""

import json
import socket
import subprocess
import time
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.project_files import ROOT

CORES, MEMORY_MB, CARD_MB = 2, 3072, 7000
BOARDS = {
    "arm64": ("qemu-system-aarch64", "-machine", "virt,gic-version=3", "-cpu", "cortex-a76"),
    "amd64": ("qemu-system-x86_64", "-machine", "q35", "-cpu", "max"),
}
CONSOLES = {"arm64": "ttyAMA0", "amd64": "ttyS0"}
ARGUMENT = "restart argument:"  # printed by overlay/usr/lib/systemd/system-shutdown/argument
PAGE_LIMIT_S = 600.0
OPEN = {"StrictHostKeyChecking": "no", "UserKnownHostsFile": "/dev/null", "LogLevel": "ERROR", "ConnectTimeout": "20"}


def run(*words: object, limit_s: float = 300.0) -> str:
    """Run a program on this machine and return its output; AssertionError if it fails."""
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, timeout=limit_s, check=False)
    assert done.returncode == 0, f"{' '.join(map(str, words))}: {done.stdout}{done.stderr}"
    return done.stdout


def free_port() -> int:
    """Return a TCP port that nothing listens on."""
    with socket.socket() as here:
        here.bind(("127.0.0.1", 0))
        return int(here.getsockname()[1])


def wait_until(holds: Callable[[], object], limit_s: float, what: str, poll_s: float = 0.5) -> float:
    """Poll until `holds` returns a true value; return the seconds that it took. AssertionError after `limit_s`."""
    begin_s = time.monotonic()
    while not holds():
        assert time.monotonic() - begin_s < limit_s, f"not within {limit_s:.0f} s: {what}"
        time.sleep(poll_s)
    return time.monotonic() - begin_s


@dataclass
class Card:
    """Image of a card in a file, read and written with mtools while the board is off."""

    image: Path

    def grow(self, size_mb: int) -> None:
        """Extend the file to the size of a card, as writing the image to a larger card does."""
        run("truncate", "-s", f"{size_mb}M", self.image)

    def partitions(self) -> dict[str, int]:
        """Return name and first byte of each partition."""
        table = json.loads(run("sfdisk", "--json", self.image))["partitiontable"]
        return {str(part["name"]): int(part["start"]) * int(table["sectorsize"]) for part in table["partitions"]}

    def fat(self, partition: str) -> str:
        """Return mtools' name of a FAT partition."""
        return f"{self.image}@@{self.partitions()[partition]}"

    def text(self, partition: str, name: str) -> str:
        """Return a file of a FAT partition."""
        return run("mtype", "-i", self.fat(partition), f"::{name}")

    def write(self, partition: str, file: Path) -> None:
        """Copy a file onto a FAT partition, over one of the same name."""
        run("mcopy", "-o", "-i", self.fat(partition), file, f"::{file.name}")

    def selected(self, tried: bool) -> str:
        """Return the boot partition that the firmware selects: of [tryboot] after a restart with that argument."""
        every, once = self.text("chooser", "autoboot.txt").split("[tryboot]")
        number = (once if tried else every).split("boot_partition=")[1].split()[0]
        return {"2": "boot-a", "3": "boot-b"}[number]

    def head_of(self, partition: str, count: int = 96) -> bytes:
        """Return the first bytes of a partition; also of a board that runs, since QEMU writes through this file."""
        with self.image.open("rb") as file:
            file.seek(self.partitions()[partition])
            return file.read(count)


@dataclass
class Board:
    """Board with its card; `folder` keeps console logs, kernels and sockets, `key` is the private SSH key."""

    folder: Path
    arch: str
    card: Card
    key: Path
    boots: int = 0
    booted: str = ""  # boot partition
    tried: bool = False  # the next boot takes [tryboot]
    begin_s: float = 0.0
    page_port: int = 0
    _ssh_port: int = 0
    _running: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def console(self) -> str:
        """Text on the console of the running or last boot."""
        return (self.folder / f"console-{self.boots}").read_text(errors="replace")

    def power_on(self, drive: Path | None = None) -> None:
        """Boot from the partition that the firmware selects; `drive` is the image of a USB drive."""
        self.boots, self.booted, self.tried = self.boots + 1, self.card.selected(self.tried), False
        self._ssh_port, self.page_port, self.begin_s = free_port(), free_port(), time.monotonic()
        self._start(*self._words(), *(["-device", "usb-storage,drive=usb0", *_drive(drive, "usb0")] if drive else []))

    def insert(self, drive: Path, name: str) -> None:
        """Plug a USB drive into the running board."""
        with socket.socket(socket.AF_UNIX) as monitor:
            monitor.connect(str(self.folder / "monitor"))
            monitor.settimeout(20)
            for line in (
                f"drive_add 0 if=none,format=raw,id={name},file={drive}",
                f"device_add usb-storage,drive={name}",
            ):
                monitor.sendall(line.encode() + b"\n")
                time.sleep(1)

    def cut_power(self) -> None:
        """End the emulated processor at once; what the card has acknowledged is on it."""
        self._end()

    def power_off(self) -> None:
        """Shut down in order."""
        self.ssh("systemctl", "--no-block", "poweroff")
        wait_until(lambda: not self.is_on(), 240, "power off")
        self._end()

    def wait_for_restart(self, limit_s: float) -> float:
        """Wait until the board restarts; keep the restart argument for the next boot. Return the seconds."""
        took_s = wait_until(lambda: not self.is_on(), limit_s, f"a restart: {self.console[-3000:]}")
        self.tried = f"{ARGUMENT} 0 tryboot" in self.console
        self._end()
        return took_s

    def is_on(self) -> bool:
        """Return whether QEMU runs; it ends when the board restarts or powers off."""
        return bool(self._running) and self._running[0].poll() is None

    # Access over SSH

    def ssh(self, *words: str, limit_s: float = 240.0, check: bool = True) -> str:
        """Run a command as root on the board and return its output, with errors; AssertionError if it fails."""
        done = subprocess.run(
            ["ssh", *self._login(), "-p", str(self._ssh_port), "root@127.0.0.1", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=limit_s,
            check=False,
        )
        assert done.returncode == 0 or not check, f"{' '.join(words)}: {done.stdout}"
        return done.stdout

    def wait_for_login(self, limit_s: float = PAGE_LIMIT_S) -> float:
        """Wait until SSH logs in; return the seconds since power-on."""
        begin_s = time.monotonic()
        while self.ssh("echo", "ready", check=False, limit_s=60) != "ready\n":
            assert self.is_on(), f"the board ended: {self.console[-3000:]}"
            assert time.monotonic() - begin_s < limit_s, f"no login: {self.console[-3000:]}"
            time.sleep(1)
        return time.monotonic() - self.begin_s

    def wait_for_page(self, limit_s: float = PAGE_LIMIT_S) -> float:
        """Open the tunnel that the card's README documents, and wait until the page reports `aim`.

        Return the seconds since power-on.
        """
        self.wait_for_login(limit_s)
        forward = ["-p", str(self._ssh_port), "-N", "-L", f"{self.page_port}:127.0.0.1:8000"]
        tunnel = ["ssh", *self._login(), *forward, "root@127.0.0.1"]
        self._running.append(subprocess.Popen(tunnel, stderr=subprocess.DEVNULL))
        try:
            wait_until(lambda: self.page_state() == "aim", limit_s, "state aim")
        except AssertionError as error:
            raise AssertionError(f"{error}: {self.ssh('journalctl', '-b', '-n', '80', '--no-pager')}") from error
        return time.monotonic() - self.begin_s

    def page_state(self) -> str | None:
        """Return the state that the page reports; None without an answer."""
        with suppress(OSError, ValueError):
            return str(self.ask("status")["state"])
        return None

    def ask(self, path: str, body: dict[str, Any] | None = None, limit_s: float = 240.0) -> Any:
        """Return the answer of the page's API to a GET, or to a POST of `body`; OSError without one."""
        data = None if body is None else json.dumps(body).encode()
        url = f"http://127.0.0.1:{self.page_port}/api/{path}"
        request = urllib.request.Request(url, data, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=limit_s) as answer:
            return json.load(answer)

    def copy(self, file: Path, folder: str) -> None:
        """Copy a file into a folder of the board."""
        run("scp", "-q", *self._login(), "-P", self._ssh_port, file, f"root@127.0.0.1:{folder}")

    def _login(self) -> list[str]:
        options = [word for name, value in OPEN.items() for word in ("-o", f"{name}={value}")]
        return [*options, "-i", str(self.key)]

    # QEMU

    def _words(self) -> list[str]:
        """Return QEMU's command line for the selected boot partition."""
        kernel, initrd = self.folder / "kernel", self.folder / "initrd"
        for name, file in (("kernel_2712.img", kernel), ("initramfs_2712", initrd)):
            run("mcopy", "-o", "-n", "-i", self.card.fat(self.booted), f"::{name}", file)
        line = self.card.text(self.booted, f"cmdline-{self.booted[-1]}.txt").strip()
        net = f"user,id=net0,hostfwd=tcp:127.0.0.1:{self._ssh_port}-:22"
        words = [
            *BOARDS[self.arch],
            "-smp",
            str(CORES),
            "-m",
            str(MEMORY_MB),
            "-accel",
            "tcg,thread=multi,tb-size=1024",
            "-kernel",
            str(kernel),
            "-initrd",
            str(initrd),
            "-append",
            f"{line} console={CONSOLES[self.arch]}",
            *_drive(self.card.image, "card"),
            "-device",
            "virtio-blk-pci,drive=card",
            "-netdev",
            net,
            "-device",
            "virtio-net-pci,netdev=net0",
            "-device",
            "qemu-xhci",
            "-device",
            "virtio-rng-pci",
            "-display",
            "none",
            "-no-reboot",
            "-serial",
            f"file:{self.folder / f'console-{self.boots}'}",
            "-monitor",
            f"unix:{self.folder / 'monitor'},server,nowait",
        ]
        return words + (["-dtb", str(self._device_tree())] if self.arch == "arm64" else [])

    def _device_tree(self) -> Path:
        """Return the device tree of QEMU's board with the buses of `buses.dtsi`."""
        blob, source = self.folder / "board.dtb", self.folder / "board.dts"
        if not blob.exists():
            plain = self.folder / "plain.dtb"
            machine = f"{BOARDS[self.arch][2]},dumpdtb={plain}"
            run(*BOARDS[self.arch][:2], machine, *BOARDS[self.arch][3:], "-smp", CORES, "-m", MEMORY_MB)
            added = (ROOT / "tests/boot/buses.dtsi").read_text()
            source.write_text(run("dtc", "-q", "-I", "dtb", "-O", "dts", plain) + added)
            run("dtc", "-q", "-I", "dts", "-O", "dtb", "-o", blob, source)
        return blob

    def _start(self, *words: str) -> None:
        log = self.folder / "qemu.log"
        with log.open("ab") as output:
            self._running = [subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=output, stderr=output)]
        time.sleep(1)
        assert self.is_on(), log.read_text()

    def _end(self) -> None:
        for process in reversed(self._running):
            process.kill()
            process.wait(20)
        self._running = []


def _drive(file: Path, name: str) -> list[str]:
    return ["-drive", f"if=none,format=raw,id={name},file={file}"]
