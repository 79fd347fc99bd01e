"""Who a device is: made on the device itself at its first start, whole or not at all, and never again.

Nothing here is a default that two devices share, and no private half ever leaves the data partition.
"""

import re
import secrets
import shutil
from dataclasses import dataclass
from pathlib import Path

from device.clock import Clock
from device.errors import StoreDamaged
from services.identity.certificates import authority
from services.records import disk

CHARACTERS = "abcdefghjkmnpqrstuvwxyz23456789"  # none that is taken for another when it is read from a label
GROUPS, GROUP = 4, 4  # 31^16: 79 bits
FILES = ("serial", "machine-id", "wifi", "authority.key", "authority.crt")
REMEDY = (
    "Copy the captures, call the technician, and keep the device off networks: with this folder gone the next start "
    "makes a new identity, with a new Wi-Fi password and a new label."
)


@dataclass(frozen=True)
class Identity:
    """What a device keeps of itself; `authority_key` and `authority_crt` are PEM."""

    serial: str
    machine_id: str
    wifi: str
    authority_key: bytes
    authority_crt: bytes

    @property
    def name(self) -> str:
        """The name on the network and on the label."""
        return name_of(self.serial)

    @property
    def qr(self) -> str:
        """What a tablet's camera understands as a wireless network; nothing in it needs a backslash."""
        return f"WIFI:T:WPA;S:{self.name};P:{self.wifi};;"


def name_of(serial: str) -> str:
    """A name by which people tell devices of one shelf apart."""
    return f"diffuscope-{serial[-6:]}"


def born(folder: Path, serial: str, clock: Clock) -> Identity:
    """The identity in `folder`; where there is none it is made first, for a board with this serial number.

    A power cut leaves none or a whole one. StoreDamaged if what is kept cannot be read: it is not replaced silently.
    """
    part = folder.with_name(f".{folder.name}.part")
    if not folder.exists():
        shutil.rmtree(part, ignore_errors=True)  # of a first start that was cut short
        disk.make_folder(folder.parent)
        key, crt = authority(name_of(serial), clock)
        wifi = "-".join("".join(secrets.choice(CHARACTERS) for _ in range(GROUP)) for _ in range(GROUPS))
        contents = (serial.encode(), secrets.token_hex(16).encode(), wifi.encode(), key, crt)
        disk.write_folder(part, dict(zip(FILES, contents, strict=True)))
        part.chmod(0o700)
        part.rename(folder)
        disk.settle(folder.parent)
    return _read(folder)


def _read(folder: Path) -> Identity:
    try:
        serial, machine_id, wifi, key, crt = ((folder / name).read_bytes() for name in FILES)
    except OSError as error:
        raise StoreDamaged(f"the identity of this device cannot be read: {error}", REMEDY) from error
    words = {"serial": serial, "machine-id": machine_id, "wifi": wifi}
    for name, rule in {"serial": "[0-9a-f]{8,}", "machine-id": "[0-9a-f]{32}", "wifi": "[a-z0-9-]{19}"}.items():
        if not re.fullmatch(rule.encode(), words[name]):
            raise StoreDamaged(f"{folder / name} is not what was kept", REMEDY)
    return Identity(serial.decode(), machine_id.decode(), wifi.decode(), key, crt)
