"""The power goes after any call of an update, and the disk forgets what was not synced: what boots, and what is said.

RAUC is real, and so are the slots; what a cut leaves is worked out from the calls that were made (tests/hard/power.py):
the data partition keeps a journal of its own, the chooser is FAT, a slot is a device without a filesystem, and what is
in /run is gone. The firmware is tests/firmware.py.
"""

import random
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from device.clock import SystemClock
from device.errors import UpdateNowhere
from services.instrument.updating import UpdateDesk
from services.records.update_notes import TABLET
from services.update.bootchooser import BootChooser
from services.update.settings import UpdateSettings
from services.update.updater import Updater
from tests import firmware
from tests.appliance import bench as benches
from tests.appliance import releases
from tests.appliance.bench import NOWHERE, Bench
from tests.hard.power import Disk, noted, written
from tests.house import ROOT

pytestmark = [pytest.mark.systemd, pytest.mark.timeout(240)]

SLOT_KB, NOISE_BYTES = 96, 60_000
DRAWS = 12
KERNEL = random.Random(3).randbytes(20_000)
STATUS = "/state/rauc.status"
PARTS = ("chooser", "state", "B.img", "boot-b.img")
WORDS = {
    r"Version 1.0 runs\.": "nothing",
    r"Version 1.0 runs\. (Version 2.0|Another version) was interrupted: start anew\.": "interrupted",
    r"Version 1.0 runs\. Version 2.0 is installed and waits for `diffuscope update restart`\.": "installed",
    r"Version 1.0 runs\. Version 2.0 did not finish starting, or lost power: 1.0 is back\.": "lost",
    r"Updated to 2.0\. It was tried, found well, and stays\.": "updated",
}
SHOWN = {
    "nothing": "none",
    "interrupted": "interrupted",
    "installed": "installed",
    "lost": "lost",
    "updated": "committed",
}


@dataclass(frozen=True)
class Recording:
    """An update that was done once: the bench, what its disks held before, every call, and the new version's images."""

    bench: Bench
    before: Path
    calls: list[str]
    images: dict[str, bytes]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Recording]:
    folder = tmp_path_factory.mktemp("power")
    workshop = releases.opened(folder / "workshop")
    one = workshop.small("one", "1.0", noise_bytes=NOISE_BYTES)
    two = workshop.small("two", "2.0", noise_bytes=NOISE_BYTES, boot=KERNEL)
    with benches.opened(folder / "bench", workshop, SLOT_KB) as bench:
        for slot in "AB":
            bench.fill(slot, one)  # the slot that is written holds something else, whole
        (bench.here / "state" / TABLET).mkdir()
        shutil.copy(two, bench.here / "media")
        before = folder / "before"
        before.mkdir()
        for name in PARTS:
            subprocess.run(["cp", "-a", str(bench.here / name), str(before)], check=True)
        words = [sys.executable, "-m", "tests.appliance.power", str(bench.here), str(workshop.folder)]
        words += [bench.loops["A"], bench.loops["B"], bench.bus]
        devices = {bench.loops[name]: bench.here / f"{name}.img" for name in ("B", "boot-b")}
        calls = noted(words, bench.here, ROOT, devices)
        image = subprocess.run(["unsquashfs", "-cat", str(two), "rootfs.img"], capture_output=True, check=True).stdout
        yield Recording(bench, before, calls, {"B.img": image, "boot-b.img": KERNEL})


def cuts(recording: Recording, draw: random.Random) -> Iterator[tuple[str, dict[str, bytes | None]]]:
    """What was said to be done, and what may be left, after each call that changed something."""
    disk = Disk(recording.bench.here, recording.before, fat=("chooser",), parts=PARTS)
    for call in ["", *recording.calls]:
        if not call or disk.follow(call):
            yield from ((disk.said, left) for left in disk.cuts(draw, DRAWS))
    for name in PARTS[1:]:
        real = recording.bench.here / name
        for path in [real] if real.is_file() else real.rglob("*"):
            if path.is_file():
                assert disk.as_seen()["/" + str(path.relative_to(recording.bench.here))] == path.read_bytes()


def judged(left: Path, said: str, images: dict[str, bytes]) -> str:
    """What the words tell after a cut; every promise that an update makes is held."""
    autoboot = (left / "chooser/autoboot.txt").read_bytes()
    assert {firmware.partition(autoboot), firmware.partition(autoboot, tried=True)} == {2, 3}
    slot = firmware.boots(autoboot)
    whole = all((left / name).read_bytes().startswith(image) for name, image in images.items())
    assert slot == ("A" if "<installed>" not in said else "B" if "<committed>" in said else slot)
    assert whole or slot == "A"
    (left / "cmdline").write_text(f"rauc.slot={slot}\n")
    chooser = BootChooser(left / "chooser/autoboot.txt", left / "state", left / "word", left / "cmdline")
    known = {"sticks": left / "media", "folder": left / "state", "wishes": left, "keyring": left}
    settings = UpdateSettings(**known, rauc=("true",), restart=("true",), instrument=NOWHERE)  # type: ignore[arg-type]
    runs = "1.0" if slot == "A" else "2.0"
    updater = Updater(settings, SystemClock(), [].append, chooser, runs)
    (told,) = [kind for words, kind in WORDS.items() if re.fullmatch(words, updater.status()[1])]
    assert UpdateDesk(left / "state", left, SystemClock(), runs, boot="another").told()["state"] == SHOWN[told]
    try:
        updater.restart()
        assert whole  # a slot that is half written is never tried
    except UpdateNowhere:
        pass
    updater.tidy()
    assert not list((left / "state").glob(".copy*"))
    return told


def test_whatever_a_power_cut_leaves_of_an_update_boots_and_says_what_happened(recording: Recording) -> None:
    seen, outcomes = set[int](), Counter[str]()
    for said, left in cuts(recording, random.Random(1)):
        if (one := hash((tuple(left.items()), "<installed>" in said, "<committed>" in said))) in seen:
            continue
        seen.add(one)
        with TemporaryDirectory(dir="/dev/shm") as place:
            outcomes[judged(written(left, Path(place) / "left"), said, recording.images)] += 1
    print(f"{len(seen)} disks: {dict(outcomes)}")  # noqa: T201  # the figures that README quotes
    assert set(outcomes) == set(SHOWN)


def test_rauc_updates_again_whatever_is_left_of_its_own_notes(recording: Recording) -> None:
    """It writes them without waiting for the disk: they may be gone, empty or half."""
    bench, left_of_it = recording.bench, {left.get(STATUS) for _, left in cuts(recording, random.Random(2))}
    half = max(left_of_it - {None}, key=len)[:100]
    three = bench.workshop.small("three", "3.0", noise_bytes=NOISE_BYTES)
    for content in sorted({*left_of_it, half}, key=lambda content: content or b""):
        path = bench.here / STATUS.strip("/")
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_bytes(content)
        with bench.service():
            bench.updater("2.0").install(three)
        assert (bench.chooser.primary(), bench.version("A")) == ("A", "3.0")
        bench.chooser.set_primary("B")
    print(f"{len(left_of_it)} notes of RAUC, and half of one")  # noqa: T201  # the figure that README quotes
