"""Key of a device's backups: who can decrypt them, and a secret for the HMAC that names contents and seals lists.

`backup.json` in the folder of the store (mode 600) and, without the secret, in the folder of the backups. Encryption is
age's (X25519, https://age-encryption.org/v1): the device knows the public keys only, so a lost device decrypts no
backup. With a passphrase, a new secret key is encrypted with it (scrypt), together with the secret, and stored beside
the backups and in the device's own file. The public keys are in the clear, so anyone can encrypt a backup: the seal,
which needs the secret, shows that the device wrote it. Holders of secret keys elsewhere keep the secret with them.
"""

import base64
import hashlib
import hmac
import secrets
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Literal, TypeVar

import pyrage
from pydantic import BaseModel, ConfigDict, Field

from device import atomic_io
from device.errors import SpecError
from device.user_files import read_text
from services.errors import BackupDamaged, BackupKeyWrong
from services.records import age_encryption, digested_json
from services.records.age_encryption import PublicKey

KEY_FILE = "backup.json"
HEADER_FILES = (KEY_FILE, "backup-copy.json")  # in a folder of backups: without the header no passphrase helps
SEAL_BYTES = hashlib.sha256().digest_size
MIN_PASSPHRASE = 8  # characters; scrypt makes each guess cost about a second

Model = TypeVar("Model", bound=BaseModel)


class SecretKey:
    """Secret key of age, and the secret (hex) of the seals; `text`: its line in a file of `age-keygen`.

    BackupKeyWrong if it is none.
    """

    def __init__(self, text: str, secret: str) -> None:
        self._secret = secret
        try:
            self._identity = pyrage.x25519.Identity.from_str(text)
        except pyrage.IdentityError as error:
            raise BackupKeyWrong(f"no secret key of age: {error}") from error

    @property
    def public_key(self) -> str:
        """The public key that encrypts for this key."""
        return str(self._identity.to_public())

    def decrypted(self, content: bytes) -> bytes:
        """Return decrypted content; BackupDamaged if it has changed or is for other keys."""
        try:
            decrypted: bytes = pyrage.decrypt(content, [self._identity])
        except pyrage.DecryptError as error:
            raise BackupDamaged(f"cannot be decrypted: {error}") from error
        return decrypted

    def opened(self, encrypted: bytes) -> bytes:
        """Return the content of `BackupKey.sealed`, decrypted; BackupDamaged as above, or if another wrote it."""
        sealed = self.decrypted(encrypted)
        content, seal = sealed[:-SEAL_BYTES], sealed[-SEAL_BYTES:]
        if not hmac.compare_digest(_seal(self._secret, content), seal):
            raise BackupDamaged("the device of these backups did not write it: its seal differs")
        return content


class BackupHeader(BaseModel):
    """What the folder of the backups says in the clear: id, recipients, and the secret key behind a passphrase.

    `recipients`: public keys of age. `sealed_identity`: their secret key and the secret, encrypted with the passphrase
    (Base64); empty if the secret keys are elsewhere.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    format: Literal[1] = 1
    id: str = Field(pattern=r"^[0-9a-f]{8}$")
    recipients: tuple[PublicKey, ...] = Field(min_length=1)
    sealed_identity: str = ""

    def encrypted(self, content: bytes) -> bytes:
        """Return content that only the holder of the secret key or of the passphrase can decrypt."""
        return age_encryption.encrypted(content, self.recipients)


class LastBackup(BaseModel):
    """The last backup of a device: number, time, folder, folders of the store in it, and bytes written.

    `unreadable`: folders of the store that the disk of the device did not return, and which are not in it.
    """

    model_config = ConfigDict(frozen=True)

    number: int
    made_at: datetime
    folder: str
    units: int
    written_bytes: int
    unreadable: tuple[str, ...] = ()


class BackupKey(BaseModel):
    """Key of the backups of one device: header, secret (hex) of names and seals, and last backup."""

    model_config = ConfigDict(frozen=True)

    header: BackupHeader
    secret: str = Field(pattern=r"^[0-9a-f]{64}$")
    last: LastBackup | None = None

    def name(self, fingerprint: bytes) -> str:
        """Return the name (HMAC-SHA256, hex) of a content with this fingerprint."""
        return _mac(self.secret, b"name", fingerprint).hex()

    def seal(self, content: bytes) -> bytes:
        """Return the seal (HMAC-SHA256, SEAL_BYTES) of a content."""
        return _seal(self.secret, content)

    def sealed(self, content: bytes) -> bytes:
        """Return content with the seal behind it, which `tar` ignores."""
        return content + self.seal(content)

    @property
    def line(self) -> str:
        """Line for the file of each secret key, a comment for age; `key_in` reads it."""
        return f"{_line_begin(self.header)}{self.secret}"


def key_for_recipients(recipients: Sequence[str]) -> BackupKey:
    """Return a new key for holders of secret keys elsewhere; BackupKeyWrong if one is no public key of age."""
    try:
        return BackupKey(header=BackupHeader(id=_new_id(), recipients=tuple(recipients)), secret=_new_secret())
    except ValueError as error:  # its value is not shown: it may be a secret key
        raise BackupKeyWrong("a recipient is no public key of age", "Give a key that begins with age1.") from error


def key_for_passphrase(passphrase: str) -> BackupKey:
    """Return a new key whose secret half is encrypted with a passphrase; BackupKeyWrong if that is too short.

    Takes some seconds and up to 512 MB, because scrypt makes guesses expensive.
    """
    if len(passphrase) < MIN_PASSPHRASE:
        raise BackupKeyWrong("the passphrase is too short", f"Use {MIN_PASSPHRASE} characters or more.")
    identity, secret = pyrage.x25519.Identity.generate(), _new_secret()
    sealed = base64.b64encode(pyrage.passphrase.encrypt(f"{identity}\n{secret}".encode(), passphrase)).decode()
    header = BackupHeader(id=_new_id(), recipients=(str(identity.to_public()),), sealed_identity=sealed)
    return BackupKey(header=header, secret=secret)


def read_key(store: Path) -> BackupKey | None:
    """Return the key in the folder of a store; None if none is set, BackupDamaged if it cannot be read."""
    return read_model(store / KEY_FILE, BackupKey) if (store / KEY_FILE).exists() else None


def write_key(store: Path, key: BackupKey) -> None:
    """Write the key into the folder of a store, atomically; OSError if the disk refuses."""
    atomic_io.write_atomically(store / KEY_FILE, encoded_model(key))


def read_header(folder: Path) -> BackupHeader:
    """Return the header of a folder of backups, from the first of two copies that can be read, else BackupDamaged."""
    for name in HEADER_FILES[:-1]:
        with suppress(BackupDamaged):
            return read_model(folder / name, BackupHeader)
    return read_model(folder / HEADER_FILES[-1], BackupHeader)


def encoded_model(model: BaseModel) -> bytes:
    """Return a model as JSON with a digest, for `read_model`."""
    return digested_json.encoded(model.model_dump(mode="json"))


def read_model(path: Path, model: type[Model]) -> Model:
    """Return the content of a JSON file as a model; BackupDamaged if it cannot be read, or if one bit has changed."""
    try:
        return model.model_validate(digested_json.decoded(path.read_bytes()))
    except (OSError, ValueError) as error:
        raise BackupDamaged(f"{path} cannot be read: {str(error).splitlines()[0]}") from error


def key_of_passphrase(header: BackupHeader, passphrase: str) -> SecretKey:
    """Return the secret key of backups; BackupKeyWrong for another passphrase, or if there is none."""
    if not header.sealed_identity:
        raise BackupKeyWrong("these backups have no passphrase", "Give the file of the secret key with --identity.")
    try:
        content = pyrage.passphrase.decrypt(base64.b64decode(header.sealed_identity), passphrase)
    except (pyrage.DecryptError, ValueError) as error:
        raise BackupKeyWrong("the passphrase is not that of these backups") from error
    identity, _, secret = content.decode().partition("\n")
    return SecretKey(identity, secret)


def key_in(path: Path, header: BackupHeader) -> SecretKey:
    """Return the secret key in a file of `age-keygen` with the `BackupKey.line` of these backups.

    BackupKeyWrong if one of the two is missing.
    """
    try:
        lines = read_text(path).splitlines()
    except SpecError as error:
        raise BackupKeyWrong(error.message, error.remedy) from error
    identities = [line for line in lines if line.startswith("AGE-SECRET-KEY-")]
    if not identities:
        raise BackupKeyWrong(f"{path} has no secret key of age")
    begin = _line_begin(header)
    secrets_of_seals = [line.removeprefix(begin) for line in lines if line.startswith(begin)]
    if not secrets_of_seals:
        raise BackupKeyWrong(
            f"{path} has no line that begins with {begin.strip()!r}",
            "Add the line that the first of these backups printed: without it a forged backup looks like a true one.",
        )
    return SecretKey(identities[0], secrets_of_seals[0])


def _new_id() -> str:
    return secrets.token_hex(4)


def _new_secret() -> str:
    return secrets.token_hex(32)


def _line_begin(header: BackupHeader) -> str:
    return f"# diffuscope backups {header.id} "


def _seal(secret: str, content: bytes) -> bytes:
    return _mac(secret, b"seal", content)


def _mac(secret: str, use: bytes, content: bytes) -> bytes:
    return hmac.new(secret.encode(), use + content, hashlib.sha256).digest()
