"""What the device has seen of the channel: the highest number of its files, and all keys that they revoked.

Kept in two files, each with its digest. If both are damaged, no channel and no bundle is accepted: a revoked key would
be trusted again.
"""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from device import atomic_io
from services.errors import UpdateFailed, UpdateNoRoom
from services.records import digested_json

FILES = ("channel.json", "channel-copy.json")


class SeenChannel(BaseModel):
    """Highest number of the channel's files, and SHA-256 of all revoked public keys."""

    model_config = ConfigDict(frozen=True)
    number: int = Field(default=0, ge=0)
    revoked: tuple[str, ...] = ()


class ChannelMemory:
    """Files of the memory of the channel in `folder`; the newer of two different copies counts."""

    def __init__(self, folder: Path) -> None:
        self._paths = [folder / name for name in FILES]

    def read(self) -> SeenChannel:
        """Return what was seen, nothing before the first file of a channel; UpdateFailed if both copies are damaged."""
        present = [path for path in self._paths if path.exists()]
        whole = [seen for path in present if (seen := _read(path)) is not None]
        if present and not whole:
            raise UpdateFailed(
                "the list of revoked keys cannot be read", f"Tell the maker. A technician removes {present[0].parent}."
            )
        return max(whole, key=lambda seen: (seen.number, len(seen.revoked)), default=SeenChannel())

    def write(self, seen: SeenChannel) -> None:
        """Write both copies durably; UpdateNoRoom or UpdateFailed if the disk refuses."""
        try:
            for path in self._paths:
                atomic_io.write_atomically(path, digested_json.encoded(seen.model_dump(mode="json")))
        except OSError as error:
            kind = UpdateNoRoom if atomic_io.is_full(error) else UpdateFailed
            raise kind(f"the list of revoked keys cannot be written: {error.strerror or error}") from error


def _read(path: Path) -> SeenChannel | None:
    try:
        return SeenChannel.model_validate(digested_json.decoded(path.read_bytes()))
    except (OSError, ValueError):
        return None
