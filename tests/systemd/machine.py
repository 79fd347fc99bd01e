"""A computer that has just been switched on: Debian with a real systemd, booted in a container, and our units in it."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from signal import SIGKILL

from tests.house import ROOT, files

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
    """One run of the blanker: when it ran (CLOCK_MONOTONIC), what the service had died of, and its words."""

    at_s: float
    why: str
    words: list[str]


class Machine:
    """A booted container, driven from outside."""

    def __init__(self, leader: int) -> None:
        self._leader = leader
        self._enter = ["nsenter", "-t", str(leader), "-a", "--"]

    def run(self, *words: str, check: bool = True) -> str:
        """What a command says that runs as root inside."""
        done = subprocess.run([*self._enter, *words], capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0 or not check, f"{' '.join(words)}: {done.stdout}{done.stderr}{self.journal()}"
        return done.stdout

    def journal(self) -> str:
        done = subprocess.run(
            [*self._enter, "journalctl", "-b", "--no-pager", "-n", "60"], capture_output=True, text=True
        )
        return "\n" + done.stdout

    def show(self, unit: str, *names: str) -> list[str]:
        """Properties of a unit, in the order asked for."""
        said = dict(line.split("=", 1) for line in self.run("systemctl", "show", unit).splitlines() if "=" in line)
        return [said[name] for name in names]

    def is_there(self, path: str) -> bool:
        return subprocess.run([*self._enter, "test", "-e", path], check=False).returncode == 0

    def is_on(self) -> bool:
        """Whether its first process lives; asked from outside: who enters a machine that ends may hold up its end."""
        try:
            said = Path(f"/proc/{self._leader}/stat").read_text()
        except (FileNotFoundError, ProcessLookupError):
            return False
        return said.rpartition(")")[2].split()[0] not in "ZX"

    def blanked(self) -> list[Blanked]:
        """Every run of the blanker so far."""
        rows = [line.split() for line in self.run("cat", "/run/blanked", check=False).splitlines()]
        return [Blanked(float(at), why, words) for at, why, *words in rows]

    def main_pid(self) -> int:
        return int(self.show(UNIT, "MainPID")[0])

    def signal(self, number: int) -> float:
        """Send a signal to the instrument, which may be gone already; when that was (CLOCK_MONOTONIC)."""
        send = f"import os, time; print(time.monotonic(), flush=True); os.kill({self.main_pid()}, {int(number)})"
        return float(self.run("python3", "-c", send, check=False))

    def until(self, holds: Callable[[], bool], patience_s: float = 30.0) -> None:
        end = time.monotonic() + patience_s
        while not holds():
            assert time.monotonic() < end, f"it never happened{self.journal()}"
            time.sleep(0.02)


def root() -> Path:
    """A Debian of the same release as this machine's, made once and kept outside the checkout."""
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
    """Put the checkout into `opt` as /opt/diffuscope, with this Python's packages; nspawn's words that show it inside.

    The interpreter's own folder is shown at /opt/python: a service cannot look into the home of whoever runs the tests.
    """
    for name in files():
        if name.startswith(("device/", "services/", "web/", "hardware/", "systemd/")):
            (opt / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, opt / name)  # with its time, by which numba knows what it has compiled
    shutil.copytree(ROOT / "web" / "vendor", opt / "web" / "vendor")  # not ours, so not in `files`
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
    for path in (opt, *opt.rglob("*")):  # for everybody to read, whoever's umask made them
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() or path.parent.name == "bin" else 0o644)
    here = Path(sys.prefix) / "lib" / python / "site-packages"
    compiled = CACHE / "compiled"
    compiled.mkdir(exist_ok=True)
    return [
        f"--bind={compiled}:/var/cache/private/diffuscope",
        f"--bind-ro={opt}:/opt/diffuscope", f"--bind-ro={sys.base_prefix}:/opt/python",
        f"--bind-ro={here}:/opt/diffuscope/{packages.relative_to(opt)}",
    ]  # fmt: skip


@contextmanager
def booted(folder: Path) -> Iterator[Machine]:
    """A machine with our units installed as systemd/README.md says; what it changes is gone when it is switched off."""
    opt = folder / "opt"
    opt.mkdir()
    with switched_on(root(), folder / "console", *installed(opt)) as machine:
        _install(machine)
        yield machine


@contextmanager
def switched_on(tree: Path, console: Path, *more: str) -> Iterator[Machine]:
    """A container that boots `tree` under a layer in memory; `more` are nspawn's words, `console` what it says."""
    nspawn = _begun(tree, console, more)
    try:
        machine = Machine(leader(nspawn, console))
        machine.until(lambda: machine.is_there("/run/systemd/private"))
        machine.until(
            lambda: machine.run("systemctl", "is-system-running", check=False).strip() in ("running", "degraded")
        )
        yield machine
        machine.run("systemctl", "poweroff", "--force")
        nspawn.wait(20)
    finally:
        nspawn.terminate()
        nspawn.wait(20)


def pulled_out(tree: Path, console: Path, when: Callable[[], bool], *more: str) -> None:
    """Boot the same, and pull the plug as soon as `when` holds."""
    nspawn = _begun(tree, console, more)
    try:
        first = leader(nspawn, console)
        end = time.monotonic() + 30
        while not when():
            assert time.monotonic() < end, f"it never happened: {console.read_text()}"
            time.sleep(0.001)
        os.kill(first, SIGKILL)  # the first process inside: all others end with it
        nspawn.wait(20)
    finally:
        nspawn.terminate()
        nspawn.wait(20)


def _begun(tree: Path, console: Path, more: tuple[str, ...]) -> subprocess.Popen[bytes]:
    words = [
        "systemd-nspawn", "--quiet", "-D", str(tree), "--boot", "--register=no", "--keep-unit", "--private-network",
        "--volatile=overlay", "--console=pipe", "--machine=diffuscope-test", *more,
    ]  # fmt: skip
    with console.open("wb") as said:
        return subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=said, stderr=said)


def leader(nspawn: subprocess.Popen[bytes], log: Path) -> int:
    """The container's first process: the child of nspawn that became systemd."""
    children = Path(f"/proc/{nspawn.pid}/task/{nspawn.pid}/children")
    end = time.monotonic() + 20
    while time.monotonic() < end:
        assert nspawn.poll() is None, f"systemd-nspawn ended: {log.read_text()}"
        for child in children.read_text().split():
            if Path(f"/proc/{child}/comm").read_text().strip() == "systemd":
                return int(child)
        time.sleep(0.02)
    raise AssertionError(f"nothing booted: {log.read_text()}")


def _install(machine: Machine) -> None:
    """What the README tells an owner to do."""
    units = "/opt/diffuscope/systemd"
    machine.run("sh", "-c", f"cp {units}/*.service {units}/*.socket /etc/systemd/system/")
    machine.run("sh", "-c", "echo /opt/python/lib > /etc/ld.so.conf.d/python.conf && ldconfig")  # the tests' own Python
    machine.run("systemd-sysusers", f"{units}/diffuscope.sysusers")
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "enable", "diffuscope.service")
