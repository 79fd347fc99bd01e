"""Update channel: one small signed file on a web server that names the newest bundle, its size and its SHA-256.

`channel.cms` is JSON in a CMS signature by the signer of the bundles, made with `openssl cms -sign -nodetach -binary
-outform DER`. The validity period of the certificate is not checked: the device has no trusted clock. An older file
that was signed once is refused by its number, which only grows, and by its last day.
"""

import hashlib
import subprocess
from collections.abc import Collection
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from services.errors import UpdateDamaged, UpdateStale, UpdateUntrusted
from services.update import signers
from services.update.ipc import FoundUpdate

CHANNEL_FILE = "channel.cms"


class Offer(BaseModel):
    """Content of the channel file: device type, version, file name, size and SHA-256 of the newest bundle.

    `number`: of the file, higher in each later one. `expires`: last day of the file. `revoked`: SHA-256 of the public
    keys of signers that are not trusted any more.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)  # later releases may add fields
    compatible: str
    version: str
    bundle: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*\.raucb$")
    bytes: int = Field(gt=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    number: int = Field(gt=0)
    expires: date
    revoked: tuple[Annotated[str, Field(pattern="^[0-9a-f]{64}$")], ...] = ()


def verify_channel(signed: bytes, keyring: Path, revoked: Collection[str] = ()) -> Offer:
    """Return the offer in `signed` (CMS, DER); `keyring` is the file of trusted CA certificates.

    `revoked`: keys as in `Offer`. UpdateUntrusted for a signer outside the keyring, of another purpose than the signing
    of code, or whose key is revoked; UpdateDamaged for another signature error or invalid content.
    """
    command = ["openssl", "cms", "-verify", "-inform", "DER", "-binary", "-CAfile", str(keyring), "-no_check_time"]
    with TemporaryDirectory() as folder:
        signer = Path(folder) / "signer"
        command += ["-purpose", "any", "-signer", str(signer)]
        done = subprocess.run(command, input=signed, capture_output=True, timeout=30)
        certificates = signer.read_bytes() if signer.exists() else b""
    if done.returncode != 0:
        stderr = done.stderr.decode(errors="replace")
        kind = UpdateUntrusted if "certificate verify error" in stderr or "issuer" in stderr else UpdateDamaged
        raise kind(
            f"the channel's signature does not hold: {stderr.strip().splitlines()[-1] if stderr.strip() else ''}"
        )
    signers.refuse_other_purpose(certificates)
    signers.refuse_revoked(certificates, revoked)
    try:
        return Offer.model_validate_json(done.stdout)
    except ValidationError as error:
        raise UpdateDamaged(f"the channel is signed and says nothing that can be used: {error}") from error


def refuse_stale(offer: Offer, number: int, today: date) -> None:
    """Raise UpdateStale for a channel file that is older than one seen before, of `number`, or after its last day."""
    if offer.number < number:
        raise UpdateStale(f"the channel has its file {offer.number}, and this device has seen file {number}")
    if today > offer.expires:
        raise UpdateStale(f"the channel's file was valid until {offer.expires}, and today is {today}")


def as_found_update(offer: Offer) -> FoundUpdate:
    """Return an offer as an entry of the list of found updates; its id is a hash of version and SHA-256."""
    id = hashlib.sha256(f"channel {offer.version} {offer.sha256}".encode()).hexdigest()[:16]
    return FoundUpdate(id=id, where="channel", name=offer.bundle, bytes=offer.bytes, version=offer.version)
