"""Signers of a channel or bundle: the public keys of their certificates, and the refusal of revoked ones."""

import hashlib
import os
import subprocess
from collections.abc import Collection
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from cryptography.x509.oid import ExtendedKeyUsageOID

from services.errors import UpdateUntrusted

LENGTH_BYTES = 8  # big-endian length of the signature, the end of a bundle (RAUC's formats plain and verity)
MAX_SIGNATURE_BYTES, MAX_NAME_CHARS = 1 << 20, 100


def refuse_revoked(certificates: bytes, revoked: Collection[str]) -> None:
    """Raise UpdateUntrusted if the public key of one of these certificates (PEM) is revoked, or if there is none.

    `revoked`: SHA-256 (hexadecimal) of public keys (SubjectPublicKeyInfo, DER), so that no further certificate of a
    leaked key is accepted.
    """
    for certificate in _parsed(certificates):
        key = certificate.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
        if hashlib.sha256(key).hexdigest() in revoked:
            raise UpdateUntrusted(f"the key of its signer, {_name(certificate)}, is revoked")


def refuse_other_purpose(certificates: bytes) -> None:
    """Raise UpdateUntrusted unless each of these certificates (PEM) is for the signing of code."""
    for certificate in _parsed(certificates):
        try:
            purposes = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        except x509.ExtensionNotFound:
            purposes = x509.ExtendedKeyUsage([])
        if ExtendedKeyUsageOID.CODE_SIGNING not in purposes:
            raise UpdateUntrusted(f"its signer, {_name(certificate)}, may not sign code")


def bundle_certificates(bundle: Path) -> bytes:
    """Return the certificates (PEM) in the signature of a bundle; empty for a file without one that can be read."""
    with bundle.open("rb") as file:
        length = file.seek(0, os.SEEK_END)
        file.seek(max(0, length - LENGTH_BYTES))
        signature_bytes = int.from_bytes(file.read(), "big")
        if not 0 < signature_bytes <= min(MAX_SIGNATURE_BYTES, length - LENGTH_BYTES):
            return b""
        file.seek(length - LENGTH_BYTES - signature_bytes)
        signature = file.read(signature_bytes)
    command = ["openssl", "pkcs7", "-inform", "DER", "-print_certs"]
    return subprocess.run(command, input=signature, capture_output=True, timeout=30).stdout


def _parsed(certificates: bytes) -> list[x509.Certificate]:
    """Return the certificates in PEM; UpdateUntrusted if there is none that can be read."""
    try:
        return x509.load_pem_x509_certificates(certificates)
    except ValueError as error:
        raise UpdateUntrusted("its signer cannot be read") from error


def _name(certificate: x509.Certificate) -> str:
    return certificate.subject.rfc4514_string()[:MAX_NAME_CHARS]
