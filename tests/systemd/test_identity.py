"""First boot, second boot, a first boot that is cut: who the device is, its journal and network, in a real systemd.

The tree is Debian with NetworkManager and avahi and the files that ship; only the data partition outlives a boot. There
is no radio in a container, so what is seen of the access point is what NetworkManager makes of its profile.
"""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.house import ROOT
from tests.systemd.machine import Machine, installed, pulled_out, root, switched_on

pytestmark = [pytest.mark.systemd, pytest.mark.timeout(240)]

UNIT = "diffuscope-identity.service"
SHIPPED = {
    "fstab": "etc/fstab",
    "journald.conf": "etc/systemd/journald.conf.d/diffuscope.conf",
    "access-point.nmconnection": "etc/diffuscope/access-point.nmconnection",
    "avahi.service": "etc/avahi/services/diffuscope.service",
    "avahi-daemon.conf": "etc/avahi/avahi-daemon.conf",
}


@dataclass(frozen=True)
class Board:
    """A card in a computer: the root forgets, `data` lasts."""

    tree: Path
    data: Path
    words: list[str]

    @contextmanager
    def boots(self) -> Iterator[Machine]:
        with switched_on(
            self.tree, self.data.with_name("console"), f"--bind={self.data}:/data", *self.words
        ) as machine:
            yield machine

    def identity(self) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in (self.data / "identity").iterdir()}


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Board:
    here = tmp_path_factory.mktemp("board")
    tree, data, opt = here / "tree", here / "data", here / "opt"
    opt.mkdir()
    for name in ("captures", "compiled", "update", "journal"):
        (data / name).mkdir(parents=True)
    subprocess.run(["cp", "-al", root(), tree], check=True)
    units = [(f"systemd/{UNIT}", f"etc/systemd/system/{UNIT}")]
    for ours, theirs in [*units, *((f"systemd/image/{ours}", theirs) for ours, theirs in SHIPPED.items())]:
        words = ["install", "-D", "--mode=644", ROOT / ours, tree / theirs]  # never through a link to the kept Debian
        subprocess.run(words, check=True)
    for folder in ("data", "boot/chooser", "var/lib/diffuscope-update", "var/log/journal"):
        (tree / folder).mkdir(parents=True, exist_ok=True)
    wants = tree / "etc/systemd/system/sysinit.target.wants"
    wants.mkdir(exist_ok=True)
    (wants / UNIT).symlink_to(f"/etc/systemd/system/{UNIT}")
    own = tree / f"etc/systemd/system/{UNIT}.d/python.conf"  # the tests' own Python is not where Debian's is
    own.parent.mkdir()
    own.write_text("[Service]\nEnvironment=LD_LIBRARY_PATH=/opt/python/lib\n")
    return Board(tree, data, [f"--bind={data}:/data", *installed(opt)])


def test_a_first_boot_that_is_cut_is_finished_by_the_next_and_then_nothing_changes(board: Board) -> None:
    """Three boots: the plug is pulled out of the first while its identity is being written."""
    part, whole = board.data / ".identity.part", board.data / "identity"
    console = board.data.with_name("console")
    pulled_out(board.tree, console, lambda: part.exists() or whole.exists(), *board.words)
    cut = board.identity() if whole.exists() else None
    print(f"when it was cut the identity was {'whole' if cut else 'not there yet'}")  # noqa: T201  # a figure for who reads the log (-rP)
    whos = []
    for _ in range(2):
        with board.boots() as machine:
            assert machine.show(UNIT, "ActiveState", "Result") == ["active", "success"], machine.journal()
            whos.append(board.identity())
            known_to_the_computer(machine, whos[-1])
            written_to_one_journal(machine, board.data / "journal", whos[-1])
    assert whos[0] == whos[1]
    assert cut in (None, whos[0])
    assert not part.exists()


def known_to_the_computer(machine: Machine, who: dict[str, bytes]) -> None:
    name = f"diffuscope-{who['serial'].decode()[-6:]}"
    assert machine.run("hostname").strip() == name
    assert machine.run("cat", "/etc/machine-id").strip() == who["machine-id"].decode()
    shown = machine.run("cat", "/run/issue.d/diffuscope.issue")
    assert f"password {who['wifi'].decode()}\n" in shown
    assert len([line for line in shown.splitlines() if "█" in line or "▄" in line]) > 10, "no QR code"
    assert machine.run("stat", "-c", "%a", "/run/diffuscope-identity/server.key").strip() == "600"
    assert who["wifi"].decode() not in machine.run("journalctl", "--no-pager", "-o", "cat")


def written_to_one_journal(machine: Machine, kept: Path, who: dict[str, bytes]) -> None:
    """Of all boots: what was written before the number was known is in it too."""
    machine.until(lambda: machine.show("systemd-journal-flush.service", "ActiveState") == ["active"])
    machine.run("journalctl", "--sync")
    assert [path.name for path in kept.iterdir()] == [who["machine-id"].decode()]
    first = machine.run("journalctl", "-b", "--no-pager", "-o", "cat", "-D", "/var/log/journal")
    assert "Journal started" in first
    assert "This device is diffuscope-" in first
    assert "Unknown key" not in first, "journald has something to say about journald.conf"


def test_networkmanager_and_avahi_understand_what_they_are_given(board: Board) -> None:
    with board.boots() as machine:
        wifi = board.identity()["wifi"].decode()
        machine.until(lambda: machine.show("NetworkManager.service", "ActiveState") == ["active"])
        radio, security = "802-11-wireless", "802-11-wireless-security"
        fields = f"{radio}.mode,{radio}.ssid,{security}.key-mgmt,{security}.psk,"
        fields += "connection.autoconnect,ipv4.method,ipv4.addresses"
        asked = ["nmcli", "--terse", "--show-secrets", "--get-values", fields, "connection", "show", "access-point"]
        found = machine.run(*asked).split()
        name = machine.run("hostname").strip()
        assert sorted(found) == sorted(["no", "ap", name, "wpa-psk", wifi, "shared", "10.42.0.1/24"])
        assert "keyfile" not in machine.run("journalctl", "-u", "NetworkManager", "-p", "warning", "-o", "cat")
        machine.run("systemctl", "start", "avahi-daemon.service")
        machine.until(lambda: "Server startup complete" in machine.run("journalctl", "-u", "avahi-daemon", "-o", "cat"))
        said = machine.run("journalctl", "-u", "avahi-daemon", "-o", "cat")
        assert "Host name is diffuscope.local" in said
        assert "diffuscope.service) successfully established" in said
