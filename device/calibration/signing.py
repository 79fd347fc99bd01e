"""Signed export file of one calibration (Ed25519), for transport between service centre and head.

    diffuscope-calibration 1      type and format version
    <64 hexadecimal digits>       SHA-256 of the signer's public key
    <name>                        the signer's own name; not used for trust
    <128 hexadecimal digits>      Ed25519 signature of everything else in the file
    a zip archive                 the files exactly as they are stored, uncompressed

Nothing behind the signature is parsed before the signature is verified. A calibration contains no patient data.
"""

import hashlib
import io
import os
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_ssh_private_key,
    load_ssh_public_key,
)

from device import atomic_io
from device.errors import CalibrationDamaged, CalibrationFormat, CalibrationUntrusted, SettingError

MAGIC = "diffuscope-calibration"
FORMAT = 1
MAX_BYTES = 2**30  # eleven PSFs of 3040 x 4056 float32 are half of it
SIGNATURE = re.compile("[0-9a-f]{128}")
MAX_FILES, LONGEST_LINE = 64, 256
RETRY_REMEDY = "Copy the file again, or ask the service centre for it again."


@dataclass(frozen=True)
class Signer:
    """Signer of calibrations: a display name and the public key."""

    name: str
    key: Ed25519PublicKey

    @property
    def fingerprint(self) -> str:
        """Return the fingerprint: SHA-256 of the key, 64 hexadecimal digits; the first sixteen are shown to people."""
        return hashlib.sha256(self.key.public_bytes_raw()).hexdigest()


def create_key_pair(path: Path, name: str) -> Signer:
    """Create a key pair: `path` (private, mode 0600) and `path`.pub, one line with the name at its end.

    Both are in OpenSSH format. SettingError if one of the files exists or cannot be written, or for an unsuitable name.
    """
    signer_name = _checked_name(name)
    key = Ed25519PrivateKey.generate()
    signer = Signer(signer_name, key.public_key())
    beside = _public_path(path)
    if path.exists() or beside.exists():
        raise SettingError(f"{path} or {beside} is there already", "Choose another name: a key is never overwritten.")
    try:
        private = key.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, NoEncryption())
        atomic_io.write_file(path, private)
        line = signer.key.public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH)
        atomic_io.write_file(beside, line + f" {signer_name}\n".encode(), mode=None)
        atomic_io.fsync_folder(path.parent)
    except OSError as error:
        raise SettingError(f"{path} cannot be written: {error.strerror}", "Choose another folder.") from error
    return signer


def read_signer(path: Path) -> Signer:
    """Return the signer whose public key is in a file, as `create_key_pair` writes it; SettingError if it has none."""
    try:
        line = path.read_bytes()
        key = load_ssh_public_key(line)
        words = line.decode("utf-8").split(None, 2)
    except OSError as error:
        raise SettingError(f"{path} cannot be read: {error.strerror}", "Give the file that ends in .pub.") from error
    except (ValueError, UnsupportedAlgorithm) as error:
        raise SettingError(f"{path} is no public key", "Give the file that ends in .pub.") from error
    if not isinstance(key, Ed25519PublicKey):
        raise SettingError(f"{path} is a key of another kind than Ed25519", "Make one with `calibrations new-key`.")
    return Signer(_checked_name(words[2].strip() if len(words) > 2 else path.stem), key)


def export(files: Mapping[str, bytes], path: Path, private: Path) -> Signer:
    """Write files of a calibration as one file, signed with the key in `private`, atomically; return the signer."""
    key = _private_key(private)
    signer = read_signer(_public_path(private))
    if signer.key != key.public_key():
        raise SettingError(
            f"{_public_path(private)} is not the public key of {private}", "Put the right one beside it."
        )
    packed = _zip_archive(files)
    if len(packed) > MAX_BYTES - 4 * LONGEST_LINE:
        raise SettingError(
            f"this calibration has {len(packed) / 1e6:.0f} MB, too many for one file", "Keep fewer PSFs."
        )
    header = f"{MAGIC} {FORMAT}\n{signer.fingerprint}\n{signer.name}\n".encode()
    try:
        atomic_io.write_atomically(path, header + key.sign(header + packed).hex().encode() + b"\n" + packed, mode=None)
    except OSError as error:
        raise SettingError(f"{path} cannot be written: {error.strerror}", "Choose another folder.") from error
    return signer


def read_export(path: Path, trusted: tuple[Signer, ...]) -> tuple[dict[str, bytes], Signer]:
    """Return the files in a signed file by name, and the trusted signer of the file.

    Raises SettingError if the file cannot be read; CalibrationUntrusted, CalibrationFormat or CalibrationDamaged before
    any content is used.
    """
    try:
        with path.open("rb") as file:
            whole = file.read(MAX_BYTES + 1) if os.fstat(file.fileno()).st_size <= MAX_BYTES else None
    except OSError as error:
        raise SettingError(f"{path} cannot be read: {error.strerror}", "Give the path of an exported file.") from error
    if whole is None or len(whole) > MAX_BYTES:
        raise CalibrationDamaged(f"{path} is larger than {MAX_BYTES / 1e6:.0f} MB, as no calibration is", RETRY_REMEDY)
    return verify_export(whole, path.name, trusted)


def verify_export(whole: bytes, name: str, trusted: tuple[Signer, ...]) -> tuple[dict[str, bytes], Signer]:
    """Return the files by name, and the signer, of a signed file in memory, after verifying the signature.

    Raises CalibrationUntrusted, CalibrationFormat or CalibrationDamaged; messages name the file `name`.
    """
    magic, mark, claimed_name, signature, packed = _split_header(whole, name)
    if magic != f"{MAGIC} {FORMAT}":
        raise CalibrationFormat(f"{name} says '{magic}', and what is read here is '{MAGIC} {FORMAT}'")
    signer = next((key for key in trusted if key.fingerprint == mark), None)
    if signer is None:
        raise CalibrationUntrusted(
            f"{name} is signed with a key that is not trusted here: it names '{claimed_name}', key {mark[:16]}",
            "If you know that this is the service centre's key, give its public key with --trust. Else do not use it.",
        )
    try:
        header = whole[: len(whole) - len(packed) - len(signature) - 1]
        if not SIGNATURE.fullmatch(signature):
            raise ValueError("not a signature")
        signer.key.verify(bytes.fromhex(signature), header + packed)
    except (InvalidSignature, ValueError) as error:
        raise CalibrationUntrusted(
            f"{name} is not what {signer.name} has signed: it was damaged or changed on its way", RETRY_REMEDY
        ) from error
    return _unzip(packed, name), signer


def _split_header(whole: bytes, name: str) -> tuple[str, str, str, str, bytes]:
    """Return type line, fingerprint, displayable signer name, signature and zip archive.

    CalibrationDamaged if a line is missing or too long, or the first one names another type of file.
    """
    lines = []
    at = 0
    for _ in range(4):
        end = whole.find(b"\n", at, at + LONGEST_LINE)
        if end < 0:
            raise CalibrationDamaged(f"{name} is not an exported calibration, or only a part of one", RETRY_REMEDY)
        lines.append(whole[at:end].decode("utf-8", "replace"))
        at = end + 1
    magic, mark, called, signature = lines
    if magic.split(" ")[0] != MAGIC:
        raise CalibrationDamaged(f"{name} is not an exported calibration", RETRY_REMEDY)
    shown = "".join(letter if letter.isprintable() else "?" for letter in called)
    return magic[:40], mark, shown[:100], signature, whole[at:]


def _zip_archive(files: Mapping[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return out.getvalue()


def _unzip(packed: bytes, name: str) -> dict[str, bytes]:
    """Return the files of the zip archive; CalibrationDamaged for too many, duplicate, compressed or oversized files.

    The limits hold for trusted signers too: a signed file may be wrong.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as archive:
            held = archive.infolist()
            if len(held) > MAX_FILES or len({member.filename for member in held}) < len(held):
                raise CalibrationDamaged(f"{name} holds more files than a calibration has", RETRY_REMEDY)
            if any(member.compress_type != zipfile.ZIP_STORED for member in held):
                raise CalibrationDamaged(f"{name} holds compressed files, as no calibration does", RETRY_REMEDY)
            if sum(member.file_size for member in held) > len(packed):
                raise CalibrationDamaged(f"{name} promises more bytes than it has", RETRY_REMEDY)
            return {member.filename: archive.read(member) for member in held}
    except (zipfile.BadZipFile, ValueError, EOFError, OSError, NotImplementedError, RuntimeError) as error:
        raise CalibrationDamaged(f"{name} was signed, but holds no files: {error}", RETRY_REMEDY) from error


def _private_key(path: Path) -> Ed25519PrivateKey:
    try:
        key = load_ssh_private_key(path.read_bytes(), None)
    except OSError as error:
        raise SettingError(
            f"{path} cannot be read: {error.strerror}", "Make a key with `calibrations new-key`."
        ) from error
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise SettingError(f"{path} is no private key without a password", "Make one with `new-key`.") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise SettingError(f"{path} is a key of another kind than Ed25519", "Make one with `calibrations new-key`.")
    return key


def _public_path(private: Path) -> Path:
    return private.with_name(private.name + ".pub")


def _checked_name(name: str) -> str:
    if not 0 < len(name.encode()) <= LONGEST_LINE // 2 or not name.isprintable() or name != name.strip():
        raise SettingError(f"{name!r} is no name that a signature can carry", "Give a name of one short line.")
    return name
