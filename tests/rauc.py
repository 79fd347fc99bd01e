"""Fake RAUC for machines without boot slots: prints recorded output of RAUC 1.8, and calls our boot chooser.

    python -IS tests/rauc.py FOLDER info --output-format=json BUNDLE        (status, install, ... as in RAUC)

FOLDER is that of `tests/updates.py`. A bundle is a line of JSON and padding. Standard library only, for a fast start.
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
    """Run one RAUC command; return the exit status."""
    chooser = BootChooser(folder / "chooser/autoboot.txt", folder / "state", folder / "word", folder / "cmdline")
    match words:
        case ["info", "--output-format=json", path]:
            return print_info(Path(path))
        case ["status", "--output-format=json"]:
            print_line(json.dumps({"compatible": "diffuscope-pi5"}))
        case ["status", "mark-good", "booted"]:
            chooser.set_good(chooser.booted())
        case ["status", "mark-bad", "booted"]:
            chooser.set_bad(chooser.booted())
        case ["status", "mark-active", "other"]:
            chooser.set_primary(other(chooser.booted()))
        case ["install", path]:
            return install(folder, chooser, Path(path))
        case _:
            raise ValueError(f"the stand-in does not know {words}")
    return 0


def print_info(path: Path) -> int:
    manifest = content(path)
    if manifest is None or manifest["signer"] != "ours":
        sys.stderr.write(BROKEN if manifest is None else FOREIGN)
        return 1
    print_line(
        json.dumps(
            manifest | {"description": f"updates from {manifest['minimum']} or newer", "build": None, "images": []}
        )
    )
    return 0


def install(folder: Path, chooser: BootChooser, path: Path) -> int:
    slot, manifest = other(chooser.booted()), content(path)
    assert manifest is not None
    chooser.set_bad(slot)
    for step in STEPS:
        print_line(step)
    while (folder / "hold").exists():
        time.sleep(0.02)
    if manifest["slot"] == "small":
        print_line("100% Installing failed.\nLastError: Slot 'rootfs.1' is too small for the image")
        return 1
    print_line("100% Installing done.")
    chooser.set_primary(slot)
    return 0


def content(path: Path) -> dict[str, str] | None:
    try:
        return dict(json.loads(path.read_bytes().split(b"\n")[0]))
    except ValueError:
        return None


def print_line(words: str) -> None:
    sys.stdout.write(f"{words}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
