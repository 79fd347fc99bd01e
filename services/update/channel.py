"""Update channel: one small signed file on a web server that names the newest bundle, its size and its SHA-256.

`channel.cms` is JSON in a CMS signature by the signer of the bundles, made with `openssl cms -sign -nodetach -binary
-outform DER`. The validity period is not checked: the device has no trusted clock.
"""

import hashlib
import subprocess
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from services.errors import UpdateDamaged, UpdateUntrusted
from services.update.ipc import FoundUpdate

CHANNEL_FILE = "channel.cms"


class Offer(BaseModel):
    """Content of the channel file: device type, version, file name, size and SHA-256 of the newest bundle."""

    model_config = ConfigDict(extra="ignore", frozen=True)  # later releases may add fields
    compatible: str
    version: str
    bundle: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*\.raucb$")
    bytes: int = Field(gt=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


def verify_channel(signed: bytes, keyring: Path) -> Offer:
    """Return the offer in `signed` (CMS, DER); `keyring` is the file of trusted CA certificates.

    UpdateUntrusted for a signer outside the keyring; UpdateDamaged for another signature error or invalid content.
    """
    command = ["openssl", "cms", "-verify", "-inform", "DER", "-binary", "-CAfile", str(keyring), "-no_check_time"]
    done = subprocess.run(command, input=signed, capture_output=True, timeout=30)
    if done.returncode != 0:
        stderr = done.stderr.decode(errors="replace")
        kind = UpdateUntrusted if "certificate verify error" in stderr or "issuer" in stderr else UpdateDamaged
        raise kind(
            f"the channel's signature does not hold: {stderr.strip().splitlines()[-1] if stderr.strip() else ''}"
        )
    try:
        return Offer.model_validate_json(done.stdout)
    except ValidationError as error:
        raise UpdateDamaged(f"the channel is signed and says nothing that can be used: {error}") from error


def as_found_update(offer: Offer) -> FoundUpdate:
    """Return an offer as an entry of the list of found updates; its id is a hash of version and SHA-256."""
    id = hashlib.sha256(f"channel {offer.version} {offer.sha256}".encode()).hexdigest()[:16]
    return FoundUpdate(id=id, where="channel", name=offer.bundle, bytes=offer.bytes, version=offer.version)
