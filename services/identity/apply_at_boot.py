"""Identity applied at boot: the root file system is volatile, so every boot writes hostname, label and Wi-Fi."""

import secrets
import shutil
import socket
import subprocess
from dataclasses import dataclass
from pathlib import Path

from device import atomic_io
from services.identity.provision import Identity

# agetty replaces \4{INTERFACE} by the address, again whenever it changes; without a network nothing stands there.
LABEL = """
  {name}   serial {serial}
  Wi-Fi {name}   password {wifi}
  Photograph this, print it, and stick it onto the device.

  Address by Wi-Fi: \\4{{wlan0}}   by cable: \\4{{eth0}}\\4{{end0}}

"""


@dataclass(frozen=True)
class Computer:
    """The computer that boots; `root` is the root of its file system ("/" or a folder in tests)."""

    root: Path = Path("/")

    @property
    def data(self) -> Path:
        """Data partition, which keeps its content over boots and updates."""
        return self.root / "data"

    def serial(self) -> str:
        """Return the board's serial number from the device tree, in lower case; without one, 16 random hex digits."""
        file = self.root / "proc/device-tree/serial-number"
        return file.read_text().rstrip("\0\n").lower() if file.exists() else secrets.token_hex(8)

    def apply_identity(self, identity: Identity) -> None:
        """Write hostname, access point configuration and label text.

        If `root` is "/", also set the kernel's hostname and the journal's machine id.
        """
        (self.root / "etc/hostname").write_text(f"{identity.name}\n")
        self._write_private(
            "run/NetworkManager/system-connections/access-point.nmconnection", self._access_point(identity)
        )
        label = LABEL.format(name=identity.name, serial=identity.serial, wifi=identity.wifi)
        self._write_private("run/issue.d/diffuscope.issue", qr_code(identity.qr) + label.encode())
        if self.root == Path("/"):
            socket.sethostname(identity.name)
            self._set_machine_id(identity.machine_id)

    def show_setup_code(self, code: str) -> None:
        """Show a set-up code on the console, above the login prompt; with users it needs the button of the head too."""
        text = f"  Set-up code, for a new device or a forgotten PIN: {code[:4]}-{code[4:]}\n\n"
        self._write_private("run/issue.d/diffuscope-setup.issue", text.encode())

    def _access_point(self, identity: Identity) -> bytes:
        plain = (self.root / "etc/diffuscope/access-point.nmconnection").read_text()
        return plain.replace("@NAME@", identity.name).replace("@WIFI@", identity.wifi).encode()

    def _write_private(self, name: str, content: bytes) -> None:
        """Write a file below `root` with mode 0600."""
        atomic_io.make_folder((self.root / name).parent)
        atomic_io.write_atomically_unsynced(self.root / name, content)

    def _set_machine_id(self, machine_id: str) -> None:
        """Use the identity's machine id for the journal, and move the earlier records; restart journald.

        journald limits its size per machine id; the random id of each boot would start a new journal each time.
        """
        file = self.root / "etc/machine-id"
        random_id = file.read_text().strip()
        if random_id == machine_id:
            return
        subprocess.run(["umount", "-q", file], check=False)  # systemd mounts its random id over the file
        file.write_text(f"{machine_id}\n")
        early, ours = (self.root / "run/log/journal" / name for name in (random_id, machine_id))
        ours.mkdir(parents=True, exist_ok=True)
        for number, written in enumerate(sorted(early.glob("*.journal"))):
            written.rename(ours / f"early-{number}.journal")  # the following flush includes it
        subprocess.run(["systemctl", "restart", "systemd-journald.service"], check=True)


def qr_code(text: str) -> bytes:
    """Return a QR code in Unicode block characters; b"" if qrencode is not installed."""
    if shutil.which("qrencode") is None:
        return b""
    return subprocess.run(["qrencode", "-t", "UTF8"], input=text.encode(), check=True, capture_output=True).stdout
