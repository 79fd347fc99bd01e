"""A stand-in for RAUC, where there are no slots: it says what RAUC 1.8 was heard to say, and asks our boot chooser.

    python -IS tests/rauc.py FOLDER info --output-format=json BUNDLE        (status, install, ... as RAUC knows them)

FOLDER is that of `tests/updates.py`. A bundle is a line of JSON and some padding. Standard library only, to be quick.
"""

import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from services.update.bootchooser import BootChooser, other

FOREIGN = "signature verification failed: Verify error: unable to get local issuer certificate"
BROKEN = "Invalid bundle format: Signature size (8679598066140476448) exceeds bundle size"
STEPS = ("  0% Installing", " 20% Checking bundle", " 40% Checking bundle done.", " 80% Updating slots")


def main(folder: Path, words: list[str]) -> int:
    """Say and do what was asked; the exit status."""
    chooser = BootChooser(folder / "chooser/autoboot.txt", folder / "state", folder / "word", folder / "cmdline")
    match words:
        case ["info", "--output-format=json", path]:
            return told(Path(path))
        case ["status", "--output-format=json"]:
            say(json.dumps({"compatible": "diffuscope-pi5"}))
        case ["status", "mark-good", "booted"]:
            chooser.set_good(chooser.booted())
        case ["status", "mark-bad", "booted"]:
            chooser.set_bad(chooser.booted())
        case ["status", "mark-active", "other"]:
            chooser.set_primary(other(chooser.booted()))
        case ["install", path]:
            return installed(folder, chooser, Path(path))
        case _:
            raise ValueError(f"the stand-in does not know {words}")
    return 0


def told(path: Path) -> int:
    said = content(path)
    if said is None or said["signer"] != "ours":
        sys.stderr.write(BROKEN if said is None else FOREIGN)
        return 1
    say(json.dumps(said | {"description": f"updates from {said['minimum']} or newer", "build": None, "images": []}))
    return 0


def installed(folder: Path, chooser: BootChooser, path: Path) -> int:
    slot, said = other(chooser.booted()), content(path)
    assert said is not None
    chooser.set_bad(slot)
    for step in STEPS:
        say(step)
    while (folder / "hold").exists():
        time.sleep(0.02)
    if said["slot"] == "small":
        say("100% Installing failed.\nLastError: Slot 'rootfs.1' is too small for the image")
        return 1
    say("100% Installing done.")
    chooser.set_primary(slot)
    return 0


def content(path: Path) -> dict[str, str] | None:
    try:
        return dict(json.loads(path.read_bytes().split(b"\n")[0]))
    except ValueError:
        return None


def say(words: str) -> None:
    sys.stdout.write(f"{words}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
