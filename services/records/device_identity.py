"""Identity of the device that makes records: created with the data folder, in its file `device.json`.

The identity is that of the data: a restored backup belongs to the new device, so no backup contains the file.
"""

import json
import logging
import secrets
import uuid
from dataclasses import dataclass
from pathlib import Path

from device import atomic_io
from services.errors import StoreDamaged

log = logging.getLogger(__name__)

FILE = "device.json"
BOARD_SERIAL = Path("/proc/device-tree/serial-number")  # of a Raspberry Pi
LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ"  # without I and O, which are misread as digits
PREFIX_LETTERS = 5  # 24^5: eight million prefixes
REMEDY = "Call the technician: the file names this device in every record, and its numbers begin with it."


@dataclass(frozen=True)
class DeviceIdentity:
    """Identity of one device: UUID, and serial number of its board (a computer without one: random)."""

    uuid: str
    serial: str

    @property
    def prefix(self) -> str:
        """Letters that begin the automatic patient numbers of this device, derived from its UUID."""
        rest = uuid.UUID(self.uuid).int
        letters = ""
        for _ in range(PREFIX_LETTERS):
            rest, digit = divmod(rest, len(LETTERS))
            letters += LETTERS[digit]
        return letters


def load_or_create_device(folder: Path, board_serial: Path = BOARD_SERIAL) -> DeviceIdentity:
    """Return the identity of the data folder; create it at the first start, and on another board.

    A card that was copied or moved into another device has the serial number of the other board: it gets an identity
    of its own, so that no two devices give the same numbers, and a log line reports it. `board_serial`: file with the
    serial number of the board. StoreDamaged if the file is unreadable, OSError if it must be and cannot be written.
    """
    known = read_device(folder)
    board = board_serial_number(board_serial)
    if known is not None and board in (None, known.serial):
        return known
    made = DeviceIdentity(str(uuid.uuid4()), board or secrets.token_hex(8))
    content = {"uuid": made.uuid, "serial": made.serial}
    if known is not None:
        content["before"] = known.uuid
        log.warning("this card was made in device %s; in board %s it is device %s", known.uuid, board, made.uuid)
    atomic_io.write_atomically(folder / FILE, json.dumps(content).encode())
    return made


def read_device(folder: Path) -> DeviceIdentity | None:
    """Return the identity of a data folder, None if it has none; StoreDamaged if the file is unreadable."""
    try:
        content = json.loads((folder / FILE).read_text(encoding="utf-8"))
        return DeviceIdentity(str(uuid.UUID(content["uuid"])), str(content["serial"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreDamaged(f"the identity of this device cannot be read: {error}", REMEDY) from error


def board_serial_number(file: Path = BOARD_SERIAL) -> str | None:
    """Return the serial number of the board in lower case; None on a computer without a device tree."""
    try:
        return file.read_text(encoding="ascii").rstrip("\0\n").lower()
    except OSError:
        return None
