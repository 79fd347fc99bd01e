"""The channel: one small signed file on a web server that says which bundle is the newest, and what it must be.

`channel.cms` is JSON inside a CMS signature by the same signer as the bundles, made with
`openssl cms -sign -nodetach -binary -outform DER`. Its validity in time is not judged: the device has no trusted clock.
"""

import hashlib
import subprocess
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from device.errors import UpdateDamaged, UpdateForeign
from services.records.update_notes import Found

NAME = "channel.cms"


class Offer(BaseModel):
    """What a channel offers."""

    model_config = ConfigDict(extra="ignore", frozen=True)  # a later release may say more
    compatible: str
    version: str
    bundle: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*\.raucb$")
    bytes: int = Field(gt=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


def opened(signed: bytes, keyring: Path) -> Offer:
    """The offer inside a signed file; UpdateForeign if somebody else signed it, UpdateDamaged if it cannot be read."""
    words = ["openssl", "cms", "-verify", "-inform", "DER", "-binary", "-CAfile", str(keyring), "-no_check_time"]
    done = subprocess.run(words, input=signed, capture_output=True, timeout=30)
    if done.returncode != 0:
        said = done.stderr.decode(errors="replace")
        kind = UpdateForeign if "certificate verify error" in said or "issuer" in said else UpdateDamaged
        raise kind(f"the channel's signature does not hold: {said.strip().splitlines()[-1] if said.strip() else ''}")
    try:
        return Offer.model_validate_json(done.stdout)
    except ValidationError as error:
        raise UpdateDamaged(f"the channel is signed and says nothing that can be used: {error}") from error


def as_found(offer: Offer) -> Found:
    """An offer as a technician chooses it, by a name that only this offer has."""
    id = hashlib.sha256(f"channel {offer.version} {offer.sha256}".encode()).hexdigest()[:16]
    return Found(id=id, where="channel", name=offer.bundle, bytes=offer.bytes, version=offer.version)
