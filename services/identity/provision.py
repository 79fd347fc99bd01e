"""Identity of a device: generated on the device at its first boot, by an atomic folder write, and never replaced.

No value is shared between devices, and private keys stay on the data partition.
"""

import re
import secrets
import shutil
from dataclasses import dataclass
from pathlib import Path

from device import atomic_io
from device.clock import Clock
from services.errors import StoreDamaged
from services.identity.certificates import create_authority

WIFI_CHARACTERS = "abcdefghjkmnpqrstuvwxyz23456789"  # without characters that are misread on a label
WIFI_GROUPS, WIFI_GROUP_LENGTH = 4, 4  # 31^16: 79 bits
FILES = ("serial", "machine-id", "wifi", "authority.key", "authority.crt", "authority-unconstrained.crt")
REMEDY = (
    "Copy the captures, call the technician, and keep the device off networks: with this folder gone the next start "
    "makes a new identity, with a new Wi-Fi password and a new label."
)


@dataclass(frozen=True)
class Identity:
    """Stored identity of a device: serial number of its board, machine id, Wi-Fi password and certificate authority.

    `authority_key`, `authority_crt` and `unconstrained_crt` are PEM.
    """

    serial: str
    machine_id: str
    wifi: str
    authority_key: bytes
    authority_crt: bytes
    unconstrained_crt: bytes

    @property
    def name(self) -> str:
        """Device name: host name and Wi-Fi name, also printed on the label."""
        return device_name(self.serial)

    @property
    def qr(self) -> str:
        """Text of the QR code for joining the Wi-Fi; no character of it needs escaping."""
        return f"WIFI:T:WPA;S:{self.name};P:{self.wifi};;"


def device_name(serial: str) -> str:
    """Return the device name: "diffuscope-" and the last six characters of the serial number."""
    return f"diffuscope-{serial[-6:]}"


def load_or_create_identity(folder: Path, serial: str, clock: Clock) -> Identity:
    """Return the identity in `folder`; if the folder does not exist, create one for the board `serial`.

    The write is atomic: a power cut leaves no identity or a complete one. StoreDamaged if it cannot be read; a damaged
    identity is never replaced.
    """
    part = folder.with_name(f".{folder.name}.part")
    if not folder.exists():
        shutil.rmtree(part, ignore_errors=True)  # of an interrupted first boot
        atomic_io.make_folder(folder.parent)
        authority = create_authority(device_name(serial), clock)
        wifi = "-".join(
            "".join(secrets.choice(WIFI_CHARACTERS) for _ in range(WIFI_GROUP_LENGTH)) for _ in range(WIFI_GROUPS)
        )
        contents = (serial.encode(), secrets.token_hex(16).encode(), wifi.encode(), *authority)
        atomic_io.write_folder(part, dict(zip(FILES, contents, strict=True)))
        atomic_io.replace_durably(part, folder)
    return _read(folder)


def _read(folder: Path) -> Identity:
    try:
        serial, machine_id, wifi, *authority = ((folder / name).read_bytes() for name in FILES)
    except OSError as error:
        raise StoreDamaged(f"the identity of this device cannot be read: {error}", REMEDY) from error
    words = {"serial": serial, "machine-id": machine_id, "wifi": wifi}
    for name, rule in {"serial": "[0-9a-f]{8,}", "machine-id": "[0-9a-f]{32}", "wifi": "[a-z0-9-]{19}"}.items():
        if not re.fullmatch(rule.encode(), words[name]):
            raise StoreDamaged(f"{folder / name} is not what was kept", REMEDY)
    return Identity(serial.decode(), machine_id.decode(), wifi.decode(), *authority)
