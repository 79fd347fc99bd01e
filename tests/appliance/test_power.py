"""Power cut after each system call of an update, with loss of unsynced data: the boot slot and the reported state.

RAUC and the slots are real; the disk states after a cut are computed from the recorded calls (tests/hard/power.py): the
data partition is journalled, the chooser is FAT, a slot is a raw device, and /run is lost. The firmware is emulated by
tests/firmware.py.
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
from services.errors import UpdateNotFound
from services.instrument.update_requests import UpdateRequests
from services.update.bootchooser import BootChooser
from services.update.ipc import TABLET
from services.update.settings import UpdateSettings
from services.update.updater import Updater
from tests import firmware
from tests.appliance import bench as benches
from tests.appliance import releases
from tests.appliance.bench import NOWHERE, Bench
from tests.hard.power import Disk, record_calls, write_tree
from tests.project_files import ROOT

pytestmark = pytest.mark.systemd

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
    """One recorded update: bench, disk contents before it, all calls, and the images of the new version."""

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
            bench.fill(slot, one)  # the target slot holds another complete version
        (bench.here / "state" / TABLET).mkdir()
        shutil.copy(two, bench.here / "media")
        before = folder / "before"
        before.mkdir()
        for name in PARTS:
            subprocess.run(["cp", "-a", str(bench.here / name), str(before)], check=True)
        words = [sys.executable, "-m", "tests.appliance.power", str(bench.here), str(workshop.folder)]
        words += [bench.loops["A"], bench.loops["B"], bench.bus]
        devices = {bench.loops[name]: bench.here / f"{name}.img" for name in ("B", "boot-b")}
        calls = record_calls(words, bench.here, ROOT, devices)
        image = subprocess.run(["unsquashfs", "-cat", str(two), "rootfs.img"], capture_output=True, check=True).stdout
        yield Recording(bench, before, calls, {"B.img": image, "boot-b.img": KERNEL})


def cuts(recording: Recording, draw: random.Random) -> Iterator[tuple[str, dict[str, bytes | None]]]:
    """Yield the marks printed so far and a possible disk state, after each call that changed something."""
    disk = Disk(recording.bench.here, recording.before, fat=("chooser",), parts=PARTS)
    for call in ["", *recording.calls]:
        if not call or disk.follow(call):
            yield from ((disk.output, left) for left in disk.cuts(draw, DRAWS))
    for name in PARTS[1:]:
        real = recording.bench.here / name
        for path in [real] if real.is_file() else real.rglob("*"):
            if path.is_file():
                assert disk.as_seen()["/" + str(path.relative_to(recording.bench.here))] == path.read_bytes()


def check_disk(left: Path, marks: str, images: dict[str, bytes]) -> str:
    """Check every guarantee of an update on one disk state; return the kind of the reported state."""
    autoboot = (left / "chooser/autoboot.txt").read_bytes()
    assert {firmware.partition(autoboot), firmware.partition(autoboot, tried=True)} == {2, 3}
    slot = firmware.boots(autoboot)
    whole = all((left / name).read_bytes().startswith(image) for name, image in images.items())
    assert slot == ("A" if "<installed>" not in marks else "B" if "<committed>" in marks else slot)
    assert whole or slot == "A"
    (left / "cmdline").write_text(f"rauc.slot={slot}\n")
    chooser = BootChooser(left / "chooser/autoboot.txt", left / "state", left / "word", left / "cmdline")
    known = {"sticks": left / "media", "folder": left / "state", "requests": left, "keyring": left}
    settings = UpdateSettings(**known, rauc=("true",), restart=("true",), instrument=NOWHERE)  # type: ignore[arg-type]
    runs = "1.0" if slot == "A" else "2.0"
    updater = Updater(settings, SystemClock(), [].append, chooser, runs)
    (outcome,) = [kind for words, kind in WORDS.items() if re.fullmatch(words, updater.status()[1])]
    assert UpdateRequests(left / "state", left, SystemClock(), runs, boot="another").status().state == SHOWN[outcome]
    try:
        updater.restart()
        assert whole  # a partly written slot is never tried
    except UpdateNotFound:
        pass
    updater.tidy()
    assert not list((left / "state").glob(".copy*"))
    return outcome


def test_every_disk_state_after_a_power_cut_boots_and_reports_the_outcome(recording: Recording) -> None:
    seen, outcomes = set[int](), Counter[str]()
    for marks, left in cuts(recording, random.Random(1)):
        if (disk_hash := hash((tuple(left.items()), "<installed>" in marks, "<committed>" in marks))) in seen:
            continue
        seen.add(disk_hash)
        with TemporaryDirectory(dir="/dev/shm") as place:
            outcomes[check_disk(write_tree(left, Path(place) / "left"), marks, recording.images)] += 1
    print(f"{len(seen)} disks: {dict(outcomes)}")  # noqa: T201  # figures quoted in the README
    assert set(outcomes) == set(SHOWN)


def test_rauc_installs_again_with_any_state_of_its_status_file(recording: Recording) -> None:
    """RAUC does not sync its status file, so after a power cut it may be missing, empty or incomplete."""
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
    print(f"{len(left_of_it)} notes of RAUC, and half of one")  # noqa: T201  # figure quoted in the README
