"""`make channel`: a signed test bundle on an update channel of the loopback, and the page that finds it.

The updater, its signatures and the page are the real ones; boot slots and RAUC are stand-ins (`tests/updates.py`), so
that nothing of this computer is written or restarted.
"""

import hashlib
import json
import subprocess
import sys
from contextlib import ExitStack, suppress
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

from device.clock import SystemClock
from services.update.channel import CHANNEL_FILE
from services.update.ipc import REQUEST_FILE
from tests.project_files import BIN, ROOT
from tests.site import identity, serve, signed
from tests.updates import DEVICE, Board

OFFERED = "99.0"
STEPS = """The channel {channel} offers version {offered}, signed with test keys.
Open {page}/technician, open Update and tap "Look for an update".
Real here: page, requests, updater, signature of the channel, size and SHA-256 of the download.
A laptop has no second boot slot, no RAUC and no firmware to try it: these are stand-ins, the restart is only noted.
With real ones: make bundle, make test-appliance, make test-boot (services/update/README.md). Ctrl-C ends it.
"""


def offer(keys: Path, bundle: bytes) -> bytes:
    """Return the signed channel file of a bundle."""
    content = {
        "compatible": DEVICE,
        "version": OFFERED,
        "bundle": "test.raucb",
        "bytes": len(bundle),
        "sha256": hashlib.sha256(bundle).hexdigest(),
        "number": 1,
        "expires": "9999-12-31",
    }
    return signed(keys, json.dumps(content).encode())


def main(port: int) -> None:
    """Serve page and channel until Ctrl-C; carry out what the page asks of the updater."""
    page = f"http://127.0.0.1:{port}"
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        keys = folder / "keys"
        subprocess.run([ROOT / "systemd" / "image" / "keys", keys], check=True)
        board = Board.new(folder / "board", page)
        (board.folder / "ca.crt").write_bytes((keys / "ca.crt").read_bytes())
        path = board.bundle("test.raucb", OFFERED)
        bundle = path.read_bytes()
        path.unlink()  # the channel has it, not the drive
        certificate, key = identity(folder)
        site = stack.enter_context(serve(certificate, key))
        site.files |= {"test.raucb": bundle, CHANNEL_FILE: offer(keys, bundle)}
        words = ["run", "--port", str(port), "--data", str(folder / "data")]
        words += ["--updates", str(board.state), "--update-requests", str(board.requests)]
        instrument = stack.enter_context(subprocess.Popen([BIN / "diffuscope", *words]))
        stack.callback(instrument.terminate)
        print(STEPS.format(channel=site.url, offered=OFFERED, page=page), flush=True)
        updater = board.updater(version("diffuscope"), channel=site.url, authority=certificate)
        while instrument.poll() is None:
            SystemClock().sleep(0.2)
            if (board.requests / REQUEST_FILE).exists():
                updater.answer()


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main(int(sys.argv[1]))
