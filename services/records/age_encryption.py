"""Encryption to public keys of age (X25519, https://age-encryption.org/v1), as backups and exports use it."""

from collections.abc import Sequence
from typing import Annotated

import pyrage
from pydantic import AfterValidator


def _checked(value: str) -> str:
    try:
        pyrage.x25519.Recipient.from_str(value)
    except pyrage.RecipientError as error:
        # Without the value, which may be a secret key by mistake.
        raise ValueError("no public key of age; give one that begins with age1") from error
    return value


PublicKey = Annotated[str, AfterValidator(_checked)]


def encrypted(content: bytes, recipients: Sequence[str]) -> bytes:
    """Return content that only the holder of a secret key can decrypt; `recipients`: public keys, at least one."""
    encrypted: bytes = pyrage.encrypt(content, [pyrage.x25519.Recipient.from_str(key) for key in recipients])
    return encrypted
