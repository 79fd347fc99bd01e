"""Key of a data folder, 32 random bytes beside the users, made once; records get it as a value.

It authenticates the audit log, the files of records and the second copy of the dose ledger. It is kept in two files,
each with its digest: with one changed bit everything would look as if another program had written it.
"""

import secrets
from contextlib import suppress
from pathlib import Path

from device import atomic_io
from services.errors import StoreDamaged
from services.identity.users import FOLDER
from services.records import digested_json
from services.records.audit_log import LOG

FILES, BYTES = ("audit-key", "audit-key-copy"), 32
REMEDY = "Restore it from a backup: the entries of the audit log cannot be checked without it."


def load_or_create_audit_key(data: Path) -> bytes:
    """Return the key of a data folder, which is made if neither key nor log exists; OSError if it cannot be written.

    A copy that is missing or damaged is written again. StoreDamaged as by `read_audit_key`.
    """
    paths = _paths(data)
    is_new = not any(path.exists() for path in (*paths, data / LOG))
    key = secrets.token_bytes(BYTES) if is_new else read_audit_key(data)
    atomic_io.make_private(data / FOLDER)
    for path in paths:
        if _key_in(path) != key:
            atomic_io.write_atomically(path, digested_json.encoded({"key": key.hex()}))
    return key


def read_audit_key(data: Path) -> bytes:
    """Return the key of a data folder; StoreDamaged if both copies are missing or damaged."""
    key = find_audit_key(data)
    if key is None:
        raise StoreDamaged("the key of the audit log is missing", REMEDY)
    return key


def find_audit_key(data: Path) -> bytes | None:
    """Return the key of a data folder, None if it has none; StoreDamaged if no copy is whole."""
    keys = [key for path in _paths(data) if (key := _key_in(path)) is not None]
    if not keys and any(path.exists() for path in _paths(data)):
        raise StoreDamaged("the key of the audit log is damaged", REMEDY)
    return keys[0] if keys else None


def _paths(data: Path) -> list[Path]:
    return [data / FOLDER / name for name in FILES]


def _key_in(path: Path) -> bytes | None:
    """Return the key in a file; None if it is missing, unreadable or changed."""
    with suppress(OSError, ValueError, KeyError):
        return bytes.fromhex(str(digested_json.decoded(path.read_bytes())["key"]))
    return None
