"""Key of the audit log: 32 random bytes beside the users, made once; records get it as a value."""

import secrets
from pathlib import Path

from device import atomic_io
from services.errors import StoreDamaged
from services.identity.users import FOLDER
from services.records.audit_log import LOG

FILE, BYTES = "audit-key", 32
REMEDY = "Restore it from a backup: the entries of the audit log cannot be checked without it."


def audit_key(data: Path) -> bytes:
    """Return the key of a data folder, which is made if neither key nor log exists.

    StoreDamaged for a key of another length, or a log without a key; OSError if it cannot be written.
    """
    file = data / FOLDER / FILE
    if not file.exists() and not (data / LOG).exists():
        atomic_io.make_private(file.parent)
        atomic_io.write_atomically(file, secrets.token_bytes(BYTES))
    try:
        key = file.read_bytes()
    except FileNotFoundError as error:
        raise StoreDamaged("the key of the audit log is missing", REMEDY) from error
    if len(key) != BYTES:
        raise StoreDamaged("the key of the audit log is damaged", REMEDY)
    return key
