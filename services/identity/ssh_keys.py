"""Keys for SSH in the file of a card: a boot applies only those that an administrator confirmed at the device.

    run/diffuscope-settings/ssh-keys.json   keys of the file, written by each boot for the page
    ssh-keys.json in the data folder        decisions by fingerprint: true for a confirmed key, false for a refused one

The file is on a FAT drive without a signature: a person with the card could otherwise become root with a line in it.
"""

import base64
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from pydantic import TypeAdapter

from device import atomic_io
from device.user_files import read_plain_file

FILE = "ssh-keys.json"
MAX_BYTES = 65_536
_DECISIONS = TypeAdapter(dict[str, bool])


def fingerprint(key: str) -> str:
    """Return the SHA-256 fingerprint of a public key as `ssh-keygen -l` shows it; ValueError if it is no key."""
    digest = hashlib.sha256(base64.b64decode(key.split()[1], validate=True)).digest()
    return f"SHA256:{base64.b64encode(digest).decode().rstrip('=')}"


def decisions(data: Path) -> dict[str, bool]:
    """Return the decisions in a data folder; a file that is missing or damaged has none: the keys are asked again."""
    try:
        return _DECISIONS.validate_json(read_plain_file(data / FILE, MAX_BYTES))
    except (OSError, ValueError):
        return {}


def decide(data: Path, shown: str, confirmed: bool) -> None:
    """Store the decision on the key with the fingerprint `shown`, durably; OSError if the disk refuses."""
    _write(data, decisions(data) | {shown: confirmed})


def confirmed_keys(keys: Sequence[str], data: Path) -> list[str]:
    """Return the confirmed ones of the keys of a file, and forget the decisions on all others: a key asks again."""
    known = decisions(data)
    kept = {shown: known[shown] for shown in map(fingerprint, keys) if shown in known}
    if kept != known:
        _write(data, kept)
    return [key for key in keys if kept.get(fingerprint(key))]


def _write(data: Path, kept: dict[str, bool]) -> None:
    atomic_io.write_atomically(data / FILE, json.dumps(kept).encode())
