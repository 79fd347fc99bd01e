"""A calibration as one file, for the way between service centre and head: what was kept, and who vouches for it.

    diffuscope-calibration 1      what this is, and in which format
    <64 hexadecimal digits>       SHA-256 of the signer's public key
    <name>                        what the signer calls himself; nothing rests on it
    <128 hexadecimal digits>      Ed25519 signature of everything else in the file
    a zip archive                 the files exactly as they are kept, uncompressed

Nothing behind the signature is looked at before it fits. A calibration says nothing about any patient.
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

from device.calibration.archive import sync_folder, write_synced
from device.errors import CalibrationDamaged, CalibrationFormat, CalibrationUntrusted, SettingError

MAGIC, FORMAT = "diffuscope-calibration", 1
MOST_BYTES = 2**30  # eleven PSFs of twelve megapixels are 0.6 of it
SIGNATURE = re.compile("[0-9a-f]{128}")
MOST_FILES, LONGEST_LINE = 64, 256
AGAIN = "Copy the file again, or ask the service centre for it again."


@dataclass(frozen=True)
class Signer:
    """Someone who may vouch for calibrations: a name for people, and the public key."""

    name: str
    key: Ed25519PublicKey

    @property
    def mark(self) -> str:
        """SHA-256 of the key, 64 hexadecimal digits; people compare the first sixteen."""
        return hashlib.sha256(self.key.public_bytes_raw()).hexdigest()


def new_key(path: Path, name: str) -> Signer:
    """Make a key pair: `path` (private, readable by its owner only) and `path`.pub, one line with the name behind it.

    Both are as OpenSSH keeps them. SettingError where something stands there already.
    """
    signer_name = _checked(name)
    key = Ed25519PrivateKey.generate()
    signer, beside = Signer(signer_name, key.public_key()), _public(path)
    if path.exists() or beside.exists():
        raise SettingError(f"{path} or {beside} is there already", "Choose another name: a key is never overwritten.")
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
            out.write(key.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, NoEncryption()))
            out.flush()
            os.fsync(out.fileno())
        line = signer.key.public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH)
        write_synced(beside, line + f" {signer_name}\n".encode())
        sync_folder(path.parent)
    except OSError as error:
        raise SettingError(f"{path} cannot be written: {error.strerror}", "Choose another folder.") from error
    return signer


def read_signer(path: Path) -> Signer:
    """The public key in a file of one line, as `new_key` writes it; SettingError if it is none."""
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
    return Signer(_checked(words[2].strip() if len(words) > 2 else path.stem), key)


def export(files: Mapping[str, bytes], path: Path, private: Path) -> Signer:
    """Write files of a calibration as one signed file, whole or not at all; returns who has signed."""
    key = _private_key(private)
    signer = read_signer(_public(private))
    if signer.key != key.public_key():
        raise SettingError(f"{_public(private)} is not the public key of {private}", "Put the right one beside it.")
    packed = _packed(files)
    if len(packed) > MOST_BYTES - 4 * LONGEST_LINE:
        raise SettingError(
            f"this calibration has {len(packed) / 1e6:.0f} MB, too many for one file", "Keep fewer PSFs."
        )
    said = f"{MAGIC} {FORMAT}\n{signer.mark}\n{signer.name}\n".encode()
    part = path.with_name(f".{path.name}.part")
    try:
        write_synced(part, said + key.sign(said + packed).hex().encode() + b"\n" + packed)
        part.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise SettingError(f"{path} cannot be written: {error.strerror}", "Choose another folder.") from error
    return signer


def read_export(path: Path, trusted: tuple[Signer, ...]) -> tuple[dict[str, bytes], Signer]:
    """The files in a signed file, and who of the trusted has signed it.

    Raises CalibrationUntrusted, CalibrationFormat or CalibrationDamaged before anything that it holds is believed.
    """
    try:
        with path.open("rb") as file:
            whole = file.read(MOST_BYTES + 1) if os.fstat(file.fileno()).st_size <= MOST_BYTES else None
    except OSError as error:
        raise SettingError(f"{path} cannot be read: {error.strerror}", "Give the path of an exported file.") from error
    if whole is None or len(whole) > MOST_BYTES:
        raise CalibrationDamaged(f"{path} is larger than {MOST_BYTES / 1e6:.0f} MB, as no calibration is", AGAIN)
    return opened(whole, path.name, trusted)


def opened(whole: bytes, name: str, trusted: tuple[Signer, ...]) -> tuple[dict[str, bytes], Signer]:
    """The same from memory."""
    magic, mark, called, signature, packed = _parts(whole, name)
    if magic != f"{MAGIC} {FORMAT}":
        raise CalibrationFormat(f"{name} says '{magic}', and what is read here is '{MAGIC} {FORMAT}'")
    signer = next((one for one in trusted if one.mark == mark), None)
    if signer is None:
        raise CalibrationUntrusted(
            f"{name} is signed by nobody who is trusted here: it says '{called}', key {mark[:16]}",
            "If you know that this is the service centre's key, give its public key with --trust. Else do not use it.",
        )
    try:
        said = whole[: len(whole) - len(packed) - len(signature) - 1]
        if not SIGNATURE.fullmatch(signature):
            raise ValueError("not a signature")
        signer.key.verify(bytes.fromhex(signature), said + packed)
    except (InvalidSignature, ValueError) as error:
        raise CalibrationUntrusted(
            f"{name} is not what {signer.name} has signed: it was damaged or changed on its way", AGAIN
        ) from error
    return _unpacked(packed, name), signer


def _parts(whole: bytes, name: str) -> tuple[str, str, str, str, bytes]:
    lines, at = [], 0
    for _ in range(4):
        end = whole.find(b"\n", at, at + LONGEST_LINE)
        if end < 0:
            raise CalibrationDamaged(f"{name} is not an exported calibration, or only a part of one", AGAIN)
        lines.append(whole[at:end].decode("utf-8", "replace"))
        at = end + 1
    magic, mark, called, signature = lines
    if magic.split(" ")[0] != MAGIC:
        raise CalibrationDamaged(f"{name} is not an exported calibration", AGAIN)
    shown = "".join(letter if letter.isprintable() else "?" for letter in called)
    return magic[:40], mark, shown[:100], signature, whole[at:]


def _packed(files: Mapping[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return out.getvalue()


def _unpacked(packed: bytes, name: str) -> dict[str, bytes]:
    """Even a trusted signer may be careless: no more files and bytes than there can be, none compressed, none twice."""
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as archive:
            held = archive.infolist()
            if len(held) > MOST_FILES or len({one.filename for one in held}) < len(held):
                raise CalibrationDamaged(f"{name} holds more files than a calibration has", AGAIN)
            if any(one.compress_type != zipfile.ZIP_STORED for one in held):
                raise CalibrationDamaged(f"{name} holds compressed files, as no calibration does", AGAIN)
            if sum(one.file_size for one in held) > len(packed):
                raise CalibrationDamaged(f"{name} promises more bytes than it has", AGAIN)
            return {one.filename: archive.read(one) for one in held}
    except (zipfile.BadZipFile, ValueError, EOFError, OSError, NotImplementedError, RuntimeError) as error:
        raise CalibrationDamaged(f"{name} was signed, but holds no files: {error}", AGAIN) from error


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


def _public(private: Path) -> Path:
    return private.with_name(private.name + ".pub")


def _checked(name: str) -> str:
    if not 0 < len(name.encode()) <= LONGEST_LINE // 2 or not name.isprintable() or name != name.strip():
        raise SettingError(f"{name!r} is no name that a signature can carry", "Give a name of one short line.")
    return name
