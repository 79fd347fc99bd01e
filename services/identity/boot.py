"""What a boot is told of who it is: the root forgets everything, so name, keys and network are laid out each time."""

import secrets
import shutil
import socket
import subprocess
from dataclasses import dataclass
from pathlib import Path

from device.clock import Clock
from services.identity.birth import Identity
from services.identity.certificates import server

LABEL = """
  {name}   serial {serial}
  Wi-Fi {name}   password {wifi}
  Photograph this, print it, and stick it onto the device.

"""


@dataclass(frozen=True)
class Computer:
    """The computer that boots; `root` is where its files begin."""

    root: Path = Path("/")

    @property
    def data(self) -> Path:
        """The partition that lasts."""
        return self.root / "data"

    def serial(self) -> str:
        """The board's number, burnt in by its maker; a computer without one draws it, for its identity to keep."""
        said = self.root / "proc/device-tree/serial-number"
        return said.read_text().rstrip("\0\n").lower() if said.exists() else secrets.token_hex(8)

    def becomes(self, identity: Identity, clock: Clock) -> None:
        """Lay everything out, and tell the kernel and the journal, if it is this computer and not a folder."""
        (self.root / "etc/hostname").write_text(f"{identity.name}\n")
        self._lays("run/NetworkManager/system-connections/access-point.nmconnection", self._access_point(identity))
        key, certificate = server(identity.authority_key, identity.authority_crt, identity.name, clock)
        self._lays("run/diffuscope-identity/server.key", key)
        self._lays("run/diffuscope-identity/server.crt", certificate + identity.authority_crt)
        label = LABEL.format(name=identity.name, serial=identity.serial, wifi=identity.wifi)
        self._lays("run/issue.d/diffuscope.issue", _drawn(identity.qr) + label.encode())
        if self.root == Path("/"):
            socket.sethostname(identity.name)
            self._keeps_one_journal(identity.machine_id)

    def _access_point(self, identity: Identity) -> bytes:
        plain = (self.root / "etc/diffuscope/access-point.nmconnection").read_text()
        return plain.replace("@NAME@", identity.name).replace("@WIFI@", identity.wifi).encode()

    def _lays(self, name: str, content: bytes) -> None:
        """A file in memory that only root may read."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch(mode=0o600)
        path.write_bytes(content)

    def _keeps_one_journal(self, machine_id: str) -> None:
        """The journal is kept per machine: with a number drawn anew by each boot, its limits would never hold."""
        file = self.root / "etc/machine-id"
        drawn = file.read_text().strip()
        if drawn == machine_id:
            return
        subprocess.run(["umount", "-q", file], check=False)  # systemd lays the drawn one over a file it did not write
        file.write_text(f"{machine_id}\n")
        early, ours = (self.root / "run/log/journal" / one for one in (drawn, machine_id))
        ours.mkdir(parents=True, exist_ok=True)
        for number, written in enumerate(sorted(early.glob("*.journal"))):
            written.rename(ours / f"early-{number}.journal")  # is read and taken over by the flush that follows
        subprocess.run(["systemctl", "restart", "systemd-journald.service"], check=True)


def _drawn(text: str) -> bytes:
    """A QR code for the screen, in the console's own characters; nothing where the image brings no qrencode."""
    if shutil.which("qrencode") is None:
        return b""
    return subprocess.run(["qrencode", "-t", "UTF8"], input=text.encode(), check=True, capture_output=True).stdout
