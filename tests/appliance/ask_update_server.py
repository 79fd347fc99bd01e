"""Program of the wrong-clock test: verify a channel file, then read it from an HTTPS server; run at another date."""

import sys
from pathlib import Path

from device.clock import VirtualClock
from services.errors import UpdateUnreachable
from services.update.channel import verify_channel
from services.update.sources import UpdateServer


def main(url: str, authority: str, channel: str, keyring: str) -> None:
    """Print the offered version, and the remedy if the server cannot be reached."""
    sys.stdout.write(f"{verify_channel(Path(channel).read_bytes(), Path(keyring)).version}\n")
    try:
        UpdateServer(url, Path(authority), VirtualClock()).read_small_file("channel.cms")
    except UpdateUnreachable as error:
        sys.stdout.write(error.remedy)


if __name__ == "__main__":
    main(*sys.argv[1:])
