"""Debian with a real systemd and our units, booted in a container (systemd-nspawn)."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from signal import SIGKILL

from tests.project_files import ROOT, files

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "diffuscope" / "systemd"
PACKAGES = "systemd,systemd-sysv,dbus,udev,python3-minimal,libpython3-stdlib,network-manager,avahi-daemon,qrencode"
UNIT = "diffuscope.service"
START = """\
#!/opt/diffuscope/.venv/bin/python
import sys

sys.path.insert(0, "/opt/diffuscope")
from services.cli import main

main()
"""


@dataclass(frozen=True)
class Blanked:
    """One run of the blanker: its time (CLOCK_MONOTONIC), the service's result before it, and its arguments."""

    at_s: float
    why: str
    words: list[str]


class Machine:
    """A booted container, controlled from outside."""

    def __init__(self, leader: int) -> None:
        self._leader = leader
        self._enter = ["nsenter", "-t", str(leader), "-a", "--"]

    def run(self, *words: str, check: bool = True) -> str:
        """Run a command as root inside; return its output."""
        done = subprocess.run([*self._enter, *words], capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0 or not check, f"{' '.join(words)}: {done.stdout}{done.stderr}{self.journal()}"
        return done.stdout

    def journal(self) -> str:
        done = subprocess.run(
            [*self._enter, "journalctl", "-b", "--no-pager", "-n", "60"], capture_output=True, text=True
        )
        return "\n" + done.stdout

    def show(self, unit: str, *names: str) -> list[str]:
        """Return properties of a unit, in the given order."""
        properties = dict(
            line.split("=", 1) for line in self.run("systemctl", "show", unit).splitlines() if "=" in line
        )
        return [properties[name] for name in names]

    def is_there(self, path: str) -> bool:
        return subprocess.run([*self._enter, "test", "-e", path], check=False).returncode == 0

    def is_on(self) -> bool:
        """Return whether the container's first process is alive.

        Checked from outside: a process that enters a stopping container may delay its end.
        """
        try:
            stat = Path(f"/proc/{self._leader}/stat").read_text()
        except (FileNotFoundError, ProcessLookupError):
            return False
        return stat.rpartition(")")[2].split()[0] not in "ZX"

    def blanked(self) -> list[Blanked]:
        """Return every run of the blanker so far."""
        rows = [line.split() for line in self.run("cat", "/run/blanked", check=False).splitlines()]
        return [Blanked(float(at), why, words) for at, why, *words in rows]

    def main_pid(self) -> int:
        return int(self.show(UNIT, "MainPID")[0])

    def signal(self, number: int) -> float:
        """Send a signal to the instrument, if it still exists; return the time (CLOCK_MONOTONIC)."""
        send = f"import os, time; print(time.monotonic(), flush=True); os.kill({self.main_pid()}, {int(number)})"
        return float(self.run("python3", "-c", send, check=False))

    def until(self, holds: Callable[[], bool], patience_s: float = 120.0) -> None:
        end = time.monotonic() + patience_s
        while not holds():
            assert time.monotonic() < end, f"it never happened{self.journal()}"
            time.sleep(0.02)


def root() -> Path:
    """Return the path of a Debian of this machine's release; made once, cached outside the checkout."""
    release = dict(line.split("=", 1) for line in Path("/etc/os-release").read_text().splitlines() if "=" in line)
    name = release["VERSION_CODENAME"]
    made = CACHE / f"{name}-2"
    if not made.is_dir():
        part = CACHE / f"{name}.part"
        shutil.rmtree(part, ignore_errors=True)
        CACHE.mkdir(parents=True, exist_ok=True)
        words = ["mmdebstrap", "--quiet", "--mode=root", "--variant=minbase", f"--include={PACKAGES}", name, str(part)]
        subprocess.run(words, check=True, timeout=600)
        part.rename(made)
    return made


def installed(opt: Path) -> list[str]:
    """Copy the checkout to `opt` as /opt/diffuscope, with this Python's packages; return nspawn options that mount it.

    The interpreter's folder is mounted at /opt/python, because a service cannot read the test user's home.
    """
    for name in files():
        if name.startswith(("device/", "services/", "web/", "hardware/", "systemd/")):
            (opt / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, opt / name)  # with its modification time, the key of numba's cache
    shutil.copytree(ROOT / "web" / "vendor", opt / "web" / "vendor")  # vendored, so not in `files`
    blanker = opt / "device" / "drivers" / "blank.py"
    blanker.write_text(Path(__file__).with_name("recorder.py").read_text() + blanker.read_text())
    python = f"python{sys.version_info.major}.{sys.version_info.minor}"
    venv = opt / ".venv"
    packages = venv / "lib" / python / "site-packages"
    for folder in (venv / "bin", packages):
        folder.mkdir(parents=True)
    (venv / "pyvenv.cfg").write_text("home = /opt/python/bin\ninclude-system-site-packages = false\n")
    (venv / "bin" / "python").symlink_to(f"/opt/python/bin/{python}")
    (venv / "bin" / "diffuscope").write_text(START)
    for path in (opt, *opt.rglob("*")):  # readable for all users, independent of the umask
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() or path.parent.name == "bin" else 0o644)
    here = Path(sys.prefix) / "lib" / python / "site-packages"
    compiled = CACHE / "compiled"
    compiled.mkdir(exist_ok=True)
    return [
        f"--bind={compiled}:/var/cache/private/diffuscope",
        f"--bind-ro={opt}:/opt/diffuscope",
        f"--bind-ro={sys.base_prefix}:/opt/python",
        f"--bind-ro={here}:/opt/diffuscope/{packages.relative_to(opt)}",
    ]


@contextmanager
def booted(folder: Path, *more: str) -> Iterator[Machine]:
    """Yield a machine with our units installed as in systemd/README.md, with nspawn options `more`; nothing is kept."""
    opt = folder / "opt"
    opt.mkdir()
    with boot_tree(root(), folder / "console", *installed(opt), *more) as machine:
        _install(machine)
        yield machine


@contextmanager
def boot_tree(tree: Path, console: Path, *more: str) -> Iterator[Machine]:
    """Yield a container that boots `tree` under a tmpfs overlay; `more` are nspawn options, `console` its log file."""
    nspawn = _start_nspawn(tree, console, more)
    try:
        machine = Machine(leader(nspawn, console))
        machine.until(lambda: machine.is_there("/run/systemd/private"))
        machine.until(
            lambda: machine.run("systemctl", "is-system-running", check=False).strip() in ("running", "degraded")
        )
        yield machine
        machine.run("systemctl", "poweroff", "--force")
        nspawn.wait(60)
    finally:
        nspawn.terminate()
        nspawn.wait(60)


def boot_until_power_cut(tree: Path, console: Path, when: Callable[[], bool], *more: str) -> None:
    """Boot `tree`, and kill the container as soon as `when` returns True."""
    nspawn = _start_nspawn(tree, console, more)
    try:
        leader_pid = leader(nspawn, console)
        end = time.monotonic() + 120
        while not when():
            assert time.monotonic() < end, f"it never happened: {console.read_text()}"
            time.sleep(0.001)
        os.kill(leader_pid, SIGKILL)  # the first process inside; all others end with it
        nspawn.wait(60)
    finally:
        nspawn.terminate()
        nspawn.wait(60)


def _start_nspawn(tree: Path, console: Path, more: tuple[str, ...]) -> subprocess.Popen[bytes]:
    words = [
        "systemd-nspawn",
        "--quiet",
        "-D",
        str(tree),
        "--boot",
        "--register=no",
        "--keep-unit",
        "--private-network",
        "--volatile=overlay",
        "--console=pipe",
        "--machine=diffuscope-test",
        *more,
    ]
    with console.open("wb") as output:
        return subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=output, stderr=output)


def leader(nspawn: subprocess.Popen[bytes], log: Path) -> int:
    """Return the process id of the container's first process: the child of nspawn that became systemd."""
    children = Path(f"/proc/{nspawn.pid}/task/{nspawn.pid}/children")
    end = time.monotonic() + 20
    while time.monotonic() < end:
        assert nspawn.poll() is None, f"systemd-nspawn ended: {log.read_text()}"
        for child in children.read_text().split():
            with suppress(FileNotFoundError, ProcessLookupError):  # a child of nspawn that has ended meanwhile
                if Path(f"/proc/{child}/comm").read_text().strip() == "systemd":
                    return int(child)
        time.sleep(0.02)
    raise AssertionError(f"nothing booted: {log.read_text()}")


def _install(machine: Machine) -> None:
    """Install as the README describes."""
    machine.run("sh", "-c", "echo /opt/python/lib > /etc/ld.so.conf.d/python.conf && ldconfig")  # Python of the tests
    machine.run("bash", "/opt/diffuscope/systemd/install", "sim")
