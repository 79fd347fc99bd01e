"""Everything that a device refuses, with real RAUC: each a named error with its words, and nothing changed."""

import hashlib
import json
import os
import random
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from device.errors import (
    UpdateBusy,
    UpdateDamaged,
    UpdateError,
    UpdateFailed,
    UpdateForeign,
    UpdateNoRoom,
    UpdateNowhere,
    UpdateOlder,
    UpdateSourceGone,
    UpdateTooFar,
    UpdateUncommitted,
    UpdateUnreachable,
    UpdateWrongDevice,
)  # fmt: skip
from services.records.disk import RESERVE_BYTES
from services.update import gate
from services.update.engine import Rauc
from tests.appliance import bench as benches
from tests.appliance import releases
from tests.appliance.bench import BOOT_KB, Bench
from tests.appliance.device import run
from tests.appliance.releases import Workshop
from tests.house import ROOT
from tests.site import identity, served, signed

pytestmark = [pytest.mark.systemd, pytest.mark.timeout(120)]


@dataclass(frozen=True)
class Shelf:
    """Bundles that lie on the bench, and whose keys they were signed with."""

    workshop: Workshop
    good: Path
    newer: Path


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Shelf:
    workshop = releases.opened(tmp_path_factory.mktemp("workshop"))
    return Shelf(workshop, workshop.small("one", "1.0"), workshop.small("two", "2.0"))


@pytest.fixture
def bench(shelf: Shelf, tmp_path: Path) -> Iterator[Bench]:
    """Version 1.0 runs in the committed slot A."""
    with benches.opened(tmp_path / "bench", shelf.workshop) as bench:
        bench.fill("A", shelf.good)
        yield bench


def refused(bench: Bench, place: Path | None, kind: type[UpdateError], **changed: object) -> str:
    """The refusal's message; slots, choice and the wish for the next boot are as before, and status says why."""
    before = bench.chooser.committed(), bench.version(bench.chooser.committed())
    with bench.service(), pytest.raises(kind) as caught:
        bench.updater(**changed).install(place)
    assert (bench.chooser.committed(), bench.version(bench.chooser.committed())) == before
    assert bench.chooser.primary() == before[0]
    entry, words = bench.updater().status()
    assert entry.state == "refused"
    assert caught.value.remedy in words
    return caught.value.message


def test_an_update_is_installed_tried_and_committed(bench: Bench, shelf: Shelf) -> None:
    with bench.service():
        bench.updater().install(shelf.newer)
    assert (bench.version("A"), bench.version("B")) == ("1.0", "2.0")
    assert bench.boot() == "B"
    assert "2.0 is being tried" in bench.updater("2.0").status()[1]
    with bench.service():
        Rauc(bench.rauc()).mark("good")
    assert [bench.boot(), bench.boot()] == ["B", "B"]


def test_what_a_stranger_signed_is_foreign(bench: Bench, shelf: Shelf, tmp_path: Path) -> None:
    stranger = releases.opened(tmp_path / "stranger")
    message = refused(bench, stranger.small("foreign", "2.0"), UpdateForeign)
    assert "issuer" in message


def test_another_device_an_older_version_and_one_step_too_many(bench: Bench, shelf: Shelf, tmp_path: Path) -> None:
    other = shelf.workshop.small(f"{tmp_path.name}-other", "2.0", compatible="toaster")
    far = shelf.workshop.small(f"{tmp_path.name}-far", "3.0", minimum="2.5")
    assert "toaster" in refused(bench, other, UpdateWrongDevice)
    assert "2.5" in refused(bench, far, UpdateTooFar)
    assert "1.0" in refused(bench, shelf.good, UpdateOlder)
    assert "2.0" in refused(bench, shelf.newer, UpdateOlder, runs="2.0.1")


def test_a_version_without_its_kernel_is_refused_and_one_with_it_becomes_root_and_kernel(
    bench: Bench, shelf: Shelf, tmp_path: Path
) -> None:
    """Where the kernel that runs has modules: they and it are written into the same slot, or not at all."""
    modules, kernels = tmp_path / "modules", [random.randbytes(40_000) for _ in range(2)]
    (modules / os.uname().release).mkdir(parents=True)
    for slot in ("a", "b"):
        (bench.here / f"boot-{slot}.img").write_bytes(kernels[0].ljust(BOOT_KB * 1024, b"\0"))
    assert os.uname().release in refused(bench, shelf.newer, UpdateWrongDevice, modules=modules)
    whole = shelf.workshop.small(f"{tmp_path.name}-whole", "2.0", boot=kernels[1])
    with bench.service():
        bench.updater(modules=modules).install(whole)
    assert (bench.version("A"), bench.version("B")) == ("1.0", "2.0")
    written = {slot: Path(bench.loops[slot]).read_bytes() for slot in ("boot-a", "boot-b")}
    assert written["boot-a"].startswith(kernels[0])
    assert written["boot-b"].startswith(kernels[1])


@pytest.mark.parametrize("harm", ["bit flip", "truncated", "last byte", "empty", "text"])
def test_what_is_not_whole_is_damaged(bench: Bench, shelf: Shelf, tmp_path: Path, harm: str) -> None:
    whole = bytearray(shelf.newer.read_bytes())
    match harm:
        case "bit flip":
            whole[len(whole) // 2] ^= 1
        case "truncated":
            del whole[len(whole) // 2 :]
        case "last byte":
            del whole[-1]
        case "empty":
            whole.clear()
        case "text":
            whole[:] = b"not an update\n" * 1000
    harmed = tmp_path / "harmed.raucb"
    harmed.write_bytes(whole)
    refused(bench, harmed, UpdateDamaged)


def test_no_room_on_the_disk_and_none_in_the_slot(bench: Bench, shelf: Shelf, tmp_path: Path) -> None:
    """The data partition keeps its reserve for pictures; a slot that is too small is found before it is written."""
    card = tmp_path / "card.img"
    run("truncate", "-s", f"{RESERVE_BYTES // 1_000_000 + 10}M", card)
    run("mkfs.ext4", "-q", card)
    state = bench.here / "state"
    run("mount", "-o", "loop", card, state)
    try:
        assert "are free" in refused(bench, shelf.newer, UpdateNoRoom)
        assert not list(state.glob("*.part"))
    finally:
        run("umount", state)
    run("truncate", "-s", "4M", bench.here / "B.img")
    run("losetup", "-c", bench.loops["B"])
    refused(bench, shelf.newer, UpdateNoRoom)


def test_a_stick_that_is_pulled_out_changes_nothing(bench: Bench, shelf: Shelf, tmp_path: Path) -> None:
    """The stick is a loop device whose ground is taken away while it is read: the kernel answers with EIO."""
    ground, stick = tmp_path / "stick.img", bench.here / "media" / "stick"
    stick.mkdir()
    run("truncate", "-s", "40M", ground)
    run("mkfs.ext4", "-q", ground)
    run("mount", "-o", "loop", ground, stick)
    try:
        shutil.copy(shelf.newer, stick)
        run("umount", stick)
        run("mount", "-o", "loop,ro", ground, stick)
        assert (stick / shelf.newer.name).stat().st_size > 12_000_000
        run("truncate", "-s", "8M", ground)
        run("losetup", "-c", run("findmnt", "-n", "-o", "SOURCE", stick).strip())
        assert "cannot be read" in refused(bench, None, UpdateSourceGone)
    finally:
        run("umount", stick)
    assert not list((bench.here / "state").glob("*.raucb*"))


def test_no_stick_and_two_updates_on_one(bench: Bench, shelf: Shelf) -> None:
    assert "holds no file" in refused(bench, None, UpdateNowhere)
    for name in ("a.raucb", "b.raucb"):
        shutil.copy(shelf.newer, bench.here / "media" / name)
    assert "several" in refused(bench, None, UpdateNowhere)


def test_the_second_of_two_updates_is_busy(bench: Bench, shelf: Shelf) -> None:
    with gate.alone(bench.here / "state"):
        with bench.service(), pytest.raises(UpdateBusy):
            bench.updater().install(shelf.newer)
        assert bench.updater().status()[0].state == "none"  # the first one's journal is not touched


def test_a_version_that_is_being_tried_cannot_be_updated(bench: Bench, shelf: Shelf) -> None:
    bench.fill("B", shelf.newer)
    bench.chooser.set_primary("B")
    bench.boot()
    third = shelf.workshop.small(f"{bench.here.parent.name}-third", "3.0")
    with bench.service():
        with pytest.raises(UpdateUncommitted, match="committed"):
            bench.updater("2.0").install(third)
        with pytest.raises(UpdateFailed):  # nor by asking RAUC itself
            Rauc(bench.rauc()).install(third, lambda share, what: None)
    assert bench.version("A") == "1.0"


def test_a_channel_is_followed_over_a_link_that_is_lost(bench: Bench, shelf: Shelf, tmp_path: Path) -> None:
    """Asked by the timer, fetched in two halves, installed by a person."""
    content = shelf.newer.read_bytes()
    offer = {
        "compatible": "diffuscope-pi5", "version": "2.0", "bundle": shelf.newer.name, "bytes": len(content),
        "sha256": hashlib.sha256(content).hexdigest(),
    }  # fmt: skip
    certificate, key = identity(tmp_path)
    with served(certificate, key) as site, bench.service():
        site.files = {"channel.cms": signed(shelf.workshop.keys, json.dumps(offer).encode()), shelf.newer.name: content}
        site.cuts = [10_000_000, 7_000_000]  # the channel itself is shorter
        updater = bench.updater(channel=site.at, authority=certificate)
        found = updater.check(download=True)
        assert (found and found.version, site.asked) == ("2.0", ["all", "all", "bytes=7000000-"])
        assert "Version 2.0 is offered" in updater.status()[1]
        updater.install(None)
        assert bench.updater("2.0", channel=site.at, authority=certificate).check() is None
    assert bench.version("B") == "2.0"
    with pytest.raises(UpdateUnreachable):
        bench.updater(channel=site.at, authority=certificate).check()


@pytest.mark.parametrize("date", ["2020-01-01", "2035-01-01"])
def test_a_wrong_clock_keeps_nobody_from_an_update(bench: Bench, shelf: Shelf, date: str) -> None:
    """A signature is judged by the time at which it was made, on a device whose clock nobody has set."""
    with bench.service("faketime", date):
        bench.updater(rauc=bench.rauc("faketime", date)).install(shelf.newer)
    assert bench.version("B") == "2.0"
    assert bench.boot() == "B"


ASKS = """
import sys
from pathlib import Path
from device.clock import VirtualClock
from device.errors import UpdateUnreachable
from services.update.channel import opened
from services.update.sources import Web
at, authority, channel, keyring = sys.argv[1:]
print(opened(Path(channel).read_bytes(), Path(keyring)).version)
try:
    Web(at, Path(authority), VirtualClock()).small("channel.cms")
except UpdateUnreachable as error:
    print(error.remedy)
"""


@pytest.mark.parametrize("date", ["2020-01-01", "2035-01-01"])
def test_a_channel_is_believed_by_a_wrong_clock_and_its_server_refused_with_the_reason(
    shelf: Shelf, tmp_path: Path, date: str
) -> None:
    """What is signed has no date of expiry; a web server's certificate has, and no stick needs that."""
    offer = {"compatible": "diffuscope-pi5", "version": "2.0", "bundle": "a.raucb", "bytes": 1, "sha256": "0" * 64}
    (tmp_path / "channel.cms").write_bytes(signed(shelf.workshop.keys, json.dumps(offer).encode()))
    certificate, key = identity(tmp_path)
    with served(certificate, key) as site:
        files = [certificate, tmp_path / "channel.cms", shelf.workshop.keys / "ca.crt"]
        said = run("faketime", date, sys.executable, "-c", ASKS, site.at, *files, cwd=ROOT)
    assert said.startswith("2.0\nLook whether date and time of this device are right")


def test_rauc_that_is_not_there_is_said(bench: Bench, shelf: Shelf) -> None:
    refused(bench, shelf.newer, UpdateFailed, rauc=("no-such-rauc",))
