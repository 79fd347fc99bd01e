"""Identity at first, later and interrupted boots: identity, journal and network in a real systemd.

The tree is Debian with NetworkManager, avahi and the files of a release; only the data partition survives a boot. A
container has no radio, so the access point is checked by NetworkManager's reading of its profile.
"""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from cryptography import x509

from tests.project_files import ROOT
from tests.systemd.machine import Machine, boot_tree, boot_until_power_cut, installed, root

pytestmark = pytest.mark.systemd

UNIT, CERTIFICATE = "diffuscope-identity.service", "diffuscope-certificate.service"
SHIPPED = {
    "fstab": "etc/fstab",
    "journald.conf": "etc/systemd/journald.conf.d/diffuscope.conf",
    "access-point.nmconnection": "etc/diffuscope/access-point.nmconnection",
    "avahi.service": "etc/avahi/services/diffuscope.service",
    "avahi-daemon.conf": "etc/avahi/avahi-daemon.conf",
}


@dataclass(frozen=True)
class Board:
    """A card in a computer: the root is volatile, `data` survives."""

    tree: Path
    data: Path
    words: list[str]

    @contextmanager
    def boots(self) -> Iterator[Machine]:
        with boot_tree(self.tree, self.data.with_name("console"), f"--bind={self.data}:/data", *self.words) as machine:
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
    units = [(f"systemd/{unit}", f"etc/systemd/system/{unit}") for unit in (UNIT, CERTIFICATE)]
    units += [("systemd/diffuscope.sysusers", "etc/sysusers.d/diffuscope.conf")]
    units += [("systemd/tls.tmpfiles", "etc/tmpfiles.d/diffuscope-tls.conf")]
    units += [("systemd/image/address-change", "etc/NetworkManager/dispatcher.d/50-diffuscope")]
    for ours, theirs in [*units, *((f"systemd/image/{ours}", theirs) for ours, theirs in SHIPPED.items())]:
        words = [
            "install",
            "-D",
            "--mode=644",
            ROOT / ours,
            tree / theirs,
        ]  # never through a hard link into the cached Debian
        subprocess.run(words, check=True)
    for folder in ("data", "boot/chooser", "var/lib/diffuscope-update", "var/log/journal"):
        (tree / folder).mkdir(parents=True, exist_ok=True)
    wants = tree / "etc/systemd/system/sysinit.target.wants"
    wants.mkdir(exist_ok=True)
    (wants / UNIT).symlink_to(f"/etc/systemd/system/{UNIT}")
    (tree / "etc/NetworkManager/dispatcher.d/50-diffuscope").chmod(0o755)
    subprocess.run(["systemd-sysusers", f"--root={tree}"], check=True)
    for unit in (UNIT, CERTIFICATE):  # the Python of the tests is outside Debian's library path
        own = tree / f"etc/systemd/system/{unit}.d/python.conf"
        own.parent.mkdir()
        own.write_text("[Service]\nEnvironment=LD_LIBRARY_PATH=/opt/python/lib\n")
    return Board(tree, data, [f"--bind={data}:/data", *installed(opt)])


def test_interrupted_first_boot_is_completed_and_the_identity_stays(board: Board) -> None:
    """Three boots; the first one is killed while it writes the identity."""
    part, whole = board.data / ".identity.part", board.data / "identity"
    console = board.data.with_name("console")
    boot_until_power_cut(board.tree, console, lambda: part.exists() or whole.exists(), *board.words)
    cut = board.identity() if whole.exists() else None
    print(f"when it was cut the identity was {'whole' if cut else 'not there yet'}")  # noqa: T201  # figure for the log (-rP)
    identities = []
    for _ in range(2):
        with board.boots() as machine:
            assert machine.show(UNIT, "ActiveState", "Result") == ["active", "success"], machine.journal()
            identities.append(board.identity())
            check_identity_is_applied(machine, identities[-1])
            check_single_journal(machine, board.data / "journal", identities[-1])
    assert identities[0] == identities[1]
    assert cut in (None, identities[0])
    assert not part.exists()


def check_identity_is_applied(machine: Machine, identity: dict[str, bytes]) -> None:
    name = f"diffuscope-{identity['serial'].decode()[-6:]}"
    assert machine.run("hostname").strip() == name
    assert machine.run("cat", "/etc/machine-id").strip() == identity["machine-id"].decode()
    shown = machine.run("cat", "/run/issue.d/diffuscope.issue")
    assert f"password {identity['wifi'].decode()}\n" in shown
    assert len([line for line in shown.splitlines() if "█" in line or "▄" in line]) > 10, "no QR code"
    assert identity["wifi"].decode() not in machine.run("journalctl", "--no-pager", "-o", "cat")


def check_single_journal(machine: Machine, journal: Path, identity: dict[str, bytes]) -> None:
    """Check that one journal holds all boots, with the records from before the machine id was set."""
    machine.until(lambda: machine.show("systemd-journal-flush.service", "ActiveState") == ["active"])
    machine.run("journalctl", "--sync")
    assert [path.name for path in journal.iterdir()] == [identity["machine-id"].decode()]
    first = machine.run("journalctl", "-b", "--no-pager", "-o", "cat", "-D", "/var/log/journal")
    assert "Journal started" in first
    assert "This device is diffuscope-" in first
    assert "Unknown key" not in first, "journald warns about journald.conf"


def test_networkmanager_and_avahi_accept_their_configuration(board: Board) -> None:
    with board.boots() as machine:
        machine.until(lambda: machine.show("NetworkManager.service", "ActiveState") == ["active"])
        wifi = board.identity()["wifi"].decode()
        radio, security = "802-11-wireless", "802-11-wireless-security"
        fields = f"{radio}.mode,{radio}.ssid,{security}.key-mgmt,{security}.psk,"
        fields += "connection.autoconnect,ipv4.method,ipv4.addresses"
        asked = ["nmcli", "--terse", "--show-secrets", "--get-values", fields, "connection", "show", "access-point"]
        name = machine.run("hostname").strip()
        expected = sorted(["no", "ap", name, "wpa-psk", wifi, "shared", "10.42.0.1/24"])
        # NetworkManager answers on the bus before it gives secrets away.
        machine.until(lambda: sorted(machine.run(*asked, check=False).split()) == expected)
        assert "keyfile" not in machine.run("journalctl", "-u", "NetworkManager", "-p", "warning", "-o", "cat")
        machine.run("systemctl", "start", "avahi-daemon.service")
        machine.until(lambda: "Server startup complete" in machine.run("journalctl", "-u", "avahi-daemon", "-o", "cat"))
        log = machine.run("journalctl", "-u", "avahi-daemon", "-o", "cat")
        assert "Host name is diffuscope.local" in log
        assert "diffuscope.service) successfully established" in log


def addresses(pem: str) -> set[str]:
    """Return the addresses that a certificate names."""
    certificate = x509.load_pem_x509_certificate(pem.encode())
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    return {str(address) for address in names.get_values_for_type(x509.IPAddress)}


def test_the_certificate_follows_an_address_and_only_its_group_reads_it(board: Board) -> None:
    """The unit has no capability and no socket; the second address is set as DHCP would."""
    with board.boots() as machine:
        machine.run("systemctl", "start", CERTIFICATE)
        server = "/run/diffuscope-tls/server.pem"
        assert machine.run("stat", "-c", "%a %U %G", server).strip() == "640 root diffuscope-tls"
        assert machine.run("stat", "-c", "%a", "/run/diffuscope-tls").strip() == "2750"
        console = machine.run("cat", "/run/issue.d/diffuscope-setup.issue")
        assert console.split()[-1].replace("-", "") == machine.run("cat", "/run/diffuscope-tls/setup-code").split()[0]
        for end, other, host in (("cable", "far", 5), ("far", "cable", 6)):  # NetworkManager calls address-change
            words = ["type", "veth", "ifname", end, "peer", other, "ip4", f"192.168.77.{host}/24"]
            machine.run("nmcli", "connection", "add", *words)
        machine.until(lambda: "192.168.77.5" in addresses(machine.run("cat", server)))
        assert "PRIVATE KEY" not in machine.run("cat", "/run/diffuscope-tls/authority.crt")
