"""Key of a data folder, 32 random bytes beside the users, made once; records get it as a value.

It authenticates the audit log, the files of records and the second copy of the dose ledger.
"""

import secrets
from pathlib import Path

from device import atomic_io
from services.errors import StoreDamaged
from services.identity.users import FOLDER
from services.records.audit_log import LOG

FILE, BYTES = "audit-key", 32
REMEDY = "Restore it from a backup: the entries of the audit log cannot be checked without it."


def load_or_create_audit_key(data: Path) -> bytes:
    """Return the key of a data folder, which is made if neither key nor log exists; OSError if it cannot be written.

    StoreDamaged as by `read_audit_key`.
    """
    file = data / FOLDER / FILE
    if not file.exists() and not (data / LOG).exists():
        atomic_io.make_private(file.parent)
        atomic_io.write_atomically(file, secrets.token_bytes(BYTES))
    return read_audit_key(data)


def read_audit_key(data: Path) -> bytes:
    """Return the key of a data folder; StoreDamaged for a key that is missing or of another length."""
    key = find_audit_key(data)
    if key is None:
        raise StoreDamaged("the key of the audit log is missing", REMEDY)
    return key


def find_audit_key(data: Path) -> bytes | None:
    """Return the key of a data folder, None if it has none; StoreDamaged for a key of another length."""
    try:
        key = (data / FOLDER / FILE).read_bytes()
    except FileNotFoundError:
        return None
    if len(key) != BYTES:
        raise StoreDamaged("the key of the audit log is damaged", REMEDY)
    return key
