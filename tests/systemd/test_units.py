"""Units in a real systemd: ready, idle, hung, killed, stopped and given up, and the blanker's run after each end.

`diffuscope run` runs with the simulated head, under the units of a release. A container has no SPI, so the checks see
when and with which arguments the blanker is called.
"""

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from signal import SIGKILL, SIGSTOP

import pytest

from tests.appliance.device import run
from tests.systemd.machine import UNIT, Blanked, Machine, booted

pytestmark = pytest.mark.systemd

LAMP = ["--device", "/dev/spidev0.0"]
BUS = "--bind=/dev/null:/dev/spidev0.0"  # nothing writes to it: the recorder ends before
ASK = "import urllib.request as u; print(u.urlopen('http://127.0.0.1:8000{}', timeout=60).read().decode())"


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    with booted(tmp_path_factory.mktemp("machine"), BUS) as machine:
        yield machine


@pytest.fixture
def running(machine: Machine) -> Machine:
    """The machine with the instrument ready and no failures recorded."""
    machine.run("systemctl", "reset-failed")
    machine.run("systemctl", "start", UNIT)
    return machine


def blanked_after(machine: Machine, end_s: float, why: str, patience_s: float = 30.0) -> Blanked:
    """Return the first run of the blanker after `end_s` for reason `why`; print the delay."""

    def answers() -> list[Blanked]:
        return [blanking for blanking in machine.blanked() if blanking.at_s > end_s and blanking.why == why]

    machine.until(lambda: bool(answers()), patience_s)
    first = answers()[0]
    assert first.words == LAMP
    print(f"{why}: dark {1000 * (first.at_s - end_s):.0f} ms later")  # noqa: T201  # figure quoted in the README
    return first


def test_requests_wait_while_the_instrument_starts(machine: Machine) -> None:
    """Also at the first start, which takes half a minute: early requests wait in the socket's backlog."""
    machine.run("systemctl", "start", "diffuscope.socket")
    begin_s = time.monotonic()
    status = json.loads(machine.run("python3", "-c", ASK.format("/api/status")))
    assert status["state"] == "starting"
    assert machine.show(UNIT, "ActiveState", "StatusText") == ["activating", "making plans"]
    machine.until(lambda: machine.show(UNIT, "ActiveState") == ["active"], 240)
    print(f"start: ready after {time.monotonic() - begin_s:.1f} s")  # noqa: T201
    assert json.loads(machine.run("python3", "-c", ASK.format("/api/status")))["state"] == "aim"
    assert machine.show(UNIT, "StatusText", "NRestarts") == ["aim", "0"]


def test_blanker_runs_before_the_instrument(running: Machine) -> None:
    first = running.blanked()[0]
    started_us = int(running.show(UNIT, "ExecMainStartTimestampMonotonic")[0])
    assert first.at_s < started_us / 1e6
    assert first.words == [*LAMP, "--insist"]


def test_instrument_runs_unprivileged_and_without_network(running: Machine) -> None:
    process = Path("/proc") / str(running.main_pid())
    status = running.run("cat", str(process / "status"))
    assert int(re.findall(r"^Uid:\s+(\d+)", status, re.M)[0]) > 60000
    assert re.findall(r"^(?:CapEff|NoNewPrivs|Seccomp):\s+(\S+)", status, re.M) == ["0000000000000000", "1", "2"]
    links = running.run("cat", str(process / "net/dev")).splitlines()[2:]
    assert [link.split(":")[0].strip() for link in links] == ["lo"]


def test_usb_drive_is_writable_for_the_instrument_only(running: Machine) -> None:
    """A drive mounted during a run, and one mounted before the start; a tmpfs stands for FAT, which needs a kernel."""
    place = "/run/systemd/system/diffuscope-stick@sda1.service.d"
    disk = "ExecStart=/usr/bin/mount -t tmpfs -o nosuid,nodev,noexec,gid=stick,mode=0770 stick /media/stick-sda1"
    running.run("mkdir", "-p", place)
    lines = f"[Service]\nExecStart=\nExecStart=/usr/bin/mkdir -p /media/stick-sda1\n{disk}\n"
    running.run("sh", "-c", f"printf '{lines}' > {place}/disk.conf && systemctl daemon-reload")
    running.run("systemctl", "start", "diffuscope-stick@sda1.service")
    for name in ("came-later", "was-there-before"):
        inside = ["nsenter", "-t", str(running.main_pid()), "-m"]
        uid = re.findall(r"^Uid:\s+(\d+)", running.run("cat", f"/proc/{running.main_pid()}/status"), re.M)[0]
        touch = ["touch", f"/media/stick-sda1/{name}"]
        running.run(*inside, "setpriv", f"--reuid={uid}", f"--regid={uid}", "--groups=stick", *touch)
        running.run("systemctl", "restart", UNIT)
    assert running.run("ls", "/media/stick-sda1").split() == ["came-later", "was-there-before"]
    stranger = ["setpriv", "--reuid=nobody", "--clear-groups", "ls", "/media/stick-sda1"]
    assert running.run(*stranger, check=False) == ""
    options = running.run("findmnt", "-n", "-o", "OPTIONS", "/media/stick-sda1")
    assert {"nosuid", "nodev", "noexec"} <= set(options.strip().split(","))
    running.run("systemctl", "stop", "diffuscope-stick@sda1.service")
    assert not running.is_there("/media/stick-sda1")


def test_udev_rule_mounts_and_unmounts_a_usb_drive(machine: Machine) -> None:
    """udev's evaluation of the rule, for a device marked as USB drive and for another one."""
    drive = Path(run("losetup", "--find").strip()).name  # a free loop device; creates one if there is none
    other = max(path.name for path in Path("/sys/class/block").iterdir() if not path.name.startswith("loop"))
    claims = f'KERNEL=="{drive}", ENV{{ID_BUS}}="usb", ENV{{ID_FS_TYPE}}="vfat"'
    machine.run("sh", "-c", f"mkdir -p /run/udev/rules.d && echo '{claims}' > /run/udev/rules.d/89-claims.rules")
    machine.run("cp", "/opt/diffuscope/systemd/image/stick.rules", "/run/udev/rules.d/90-diffuscope-stick.rules")
    asked = "udevadm test --action={} /sys/class/block/{} 2>&1"
    assert f"diffuscope-stick@{drive}.service" in machine.run("sh", "-c", asked.format("add", drive))
    gone = machine.run("sh", "-c", asked.format("remove", drive))
    assert f"systemctl --no-block stop diffuscope-stick@{drive}.service" in gone
    none = machine.run("sh", "-c", asked.format("add", other))
    assert "diffuscope-stick@" not in none
    warnings = [line for line in (gone + none).splitlines() if "stick.rules:" in line and " RUN " not in line]
    assert not warnings, "udev warns about the rule"


def test_idle_instrument_feeds_the_watchdog(running: Machine) -> None:
    pid = running.main_pid()
    time.sleep(32)  # longer than WatchdogSec
    assert running.main_pid() == pid
    assert running.show(UNIT, "NRestarts") == ["0"]


def test_hung_instrument_is_killed_blanked_and_restarted(running: Machine) -> None:
    pid = running.main_pid()
    hung_s = running.signal(SIGSTOP)
    blanked = blanked_after(running, hung_s, "watchdog", 45)
    assert 27 < blanked.at_s - hung_s < 31  # WatchdogSec minus one beat, plus up to 1 s on a busy machine
    running.until(lambda: running.show(UNIT, "ActiveState") == ["active"], 60)
    assert running.main_pid() not in (0, pid)
    assert "watchdog" in running.journal()


def test_killed_instrument_is_blanked_at_once_and_restarted(running: Machine) -> None:
    pid = running.main_pid()
    killed_s = running.signal(SIGKILL)
    assert blanked_after(running, killed_s, "signal").at_s - killed_s < 1
    running.until(lambda: running.show(UNIT, "ActiveState") == ["active"], 60)
    assert running.main_pid() != pid


def test_stopped_instrument_exits_cleanly_and_is_blanked(running: Machine) -> None:
    stopped_s = time.monotonic()
    running.run("systemctl", "stop", "diffuscope.socket", UNIT)
    assert running.show(UNIT, "ActiveState", "Result") == ["inactive", "success"]
    assert blanked_after(running, stopped_s, "success").at_s - stopped_s < 10


def test_instrument_stays_down_and_is_blanked_after_five_failures(machine: Machine) -> None:
    machine.run("systemctl", "stop", "diffuscope.socket", UNIT)
    machine.run("systemctl", "reset-failed")
    machine.run("systemctl", "start", "--no-block", UNIT)
    begin_s = time.monotonic()
    while machine.show(UNIT, "ActiveState") != ["failed"]:
        assert time.monotonic() < begin_s + 60, machine.journal()
        if machine.main_pid():
            machine.signal(SIGKILL)
        time.sleep(0.1)
    ends = [blanking for blanking in machine.blanked() if blanking.at_s > begin_s and blanking.why == "signal"]
    assert len(ends) == 5
    machine.until(lambda: machine.show("diffuscope-dark.service", "ExecMainExitTimestampMonotonic") != ["0"])
    assert machine.show("diffuscope-dark.service", "Result") == ["success"]  # also without SPI
    given_up = [blanking for blanking in machine.blanked() if blanking.at_s > ends[-1].at_s and blanking.why == "-"]
    assert given_up
    time.sleep(2)
    assert machine.show(UNIT, "ActiveState", "MainPID") == ["failed", "0"]
    machine.run("python3", "-c", ASK.format("/"), check=False)
    machine.until(lambda: machine.show("diffuscope.socket", "ActiveState") == ["failed"])
