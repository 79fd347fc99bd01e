"""Refusals of a device, with real RAUC: each has its error and remedy, and changes nothing."""

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

from device.atomic_io import RESERVE_BYTES
from services.errors import (
    UpdateBusy,
    UpdateDamaged,
    UpdateError,
    UpdateFailed,
    UpdateNoRoom,
    UpdateNotFound,
    UpdateOlder,
    UpdateSourceRemoved,
    UpdateStepMissing,
    UpdateUncommitted,
    UpdateUnreachable,
    UpdateUntrusted,
    UpdateWrongDevice,
)
from services.update import preconditions
from services.update.rauc import Rauc
from tests.appliance import bench as benches
from tests.appliance import releases
from tests.appliance.bench import BOOT_KB, Bench
from tests.appliance.device import run
from tests.appliance.releases import Workshop
from tests.project_files import ROOT
from tests.site import identity, serve, signed

pytestmark = pytest.mark.systemd


@dataclass(frozen=True)
class Bundles:
    """Prebuilt bundles and the workshop with their keys."""

    workshop: Workshop
    good: Path
    newer: Path


@pytest.fixture(scope="module")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Bundles:
    workshop = releases.opened(tmp_path_factory.mktemp("workshop"))
    return Bundles(workshop, workshop.small("one", "1.0"), workshop.small("two", "2.0"))


@pytest.fixture
def bench(bundles: Bundles, tmp_path: Path) -> Iterator[Bench]:
    """Version 1.0 runs in the committed slot A."""
    with benches.opened(tmp_path / "bench", bundles.workshop) as bench:
        bench.fill("A", bundles.good)
        yield bench


def at(date: str) -> tuple[str, ...]:
    """Return prefix words that run a program at another date.

    They load the library of faketime, not its wrapper: the wrapper keeps a semaphore named after its process when it
    is terminated, as the service of RAUC is here, and fails when the process number comes again.
    """
    words = ("env", "LD_PRELOAD=/usr/$LIB/faketime/libfaketime.so.1", f"FAKETIME=@{date} 12:00:00")
    assert run(*words, "date", "+%F").strip() == date
    return words


def refused(bench: Bench, place: Path | None, kind: type[UpdateError], **changed: object) -> str:
    """Check that an install is refused, changes nothing and is reported with its remedy; return the message."""
    before = bench.chooser.committed(), bench.version(bench.chooser.committed())
    with bench.service(), pytest.raises(kind) as caught:
        bench.updater(**changed).install(place)
    assert (bench.chooser.committed(), bench.version(bench.chooser.committed())) == before
    assert bench.chooser.primary() == before[0]
    entry, words = bench.updater().status()
    assert entry.state == "refused"
    assert caught.value.remedy in words
    return caught.value.message


def test_update_is_installed_tried_and_committed(bench: Bench, bundles: Bundles) -> None:
    with bench.service():
        bench.updater().install(bundles.newer)
    assert (bench.version("A"), bench.version("B")) == ("1.0", "2.0")
    assert bench.boot() == "B"
    assert "2.0 is being tried" in bench.updater("2.0").status()[1]
    with bench.service():
        Rauc(bench.rauc()).mark("good")
    assert [bench.boot(), bench.boot()] == ["B", "B"]


def test_bundle_of_another_signer_is_refused(bench: Bench, bundles: Bundles, tmp_path: Path) -> None:
    stranger = releases.opened(tmp_path / "stranger")
    message = refused(bench, stranger.small("foreign", "2.0"), UpdateUntrusted)
    assert "issuer" in message


def test_other_device_older_version_and_skipped_version_are_refused(
    bench: Bench, bundles: Bundles, tmp_path: Path
) -> None:
    other = bundles.workshop.small(f"{tmp_path.name}-other", "2.0", compatible="toaster")
    far = bundles.workshop.small(f"{tmp_path.name}-far", "3.0", minimum="2.5")
    assert "toaster" in refused(bench, other, UpdateWrongDevice)
    assert "2.5" in refused(bench, far, UpdateStepMissing)
    assert "1.0" in refused(bench, bundles.good, UpdateOlder)
    assert "2.0" in refused(bench, bundles.newer, UpdateOlder, runs="2.0.1")


def test_release_without_kernel_is_refused_and_with_kernel_both_are_written(
    bench: Bench, bundles: Bundles, tmp_path: Path
) -> None:
    """On a device whose kernel has modules, root and kernel are written into the same slot, or neither."""
    modules, kernels = tmp_path / "modules", [random.randbytes(40_000) for _ in range(2)]
    (modules / os.uname().release).mkdir(parents=True)
    for slot in ("a", "b"):
        (bench.here / f"boot-{slot}.img").write_bytes(kernels[0].ljust(BOOT_KB * 1024, b"\0"))
    assert os.uname().release in refused(bench, bundles.newer, UpdateWrongDevice, modules=modules)
    whole = bundles.workshop.small(f"{tmp_path.name}-whole", "2.0", boot=kernels[1])
    with bench.service():
        bench.updater(modules=modules).install(whole)
    assert (bench.version("A"), bench.version("B")) == ("1.0", "2.0")
    written = {slot: Path(bench.loops[slot]).read_bytes() for slot in ("boot-a", "boot-b")}
    assert written["boot-a"].startswith(kernels[0])
    assert written["boot-b"].startswith(kernels[1])


@pytest.mark.parametrize("harm", ["bit flip", "truncated", "last byte", "empty", "text"])
def test_damaged_bundle_is_refused(bench: Bench, bundles: Bundles, tmp_path: Path, harm: str) -> None:
    whole = bytearray(bundles.newer.read_bytes())
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


def test_full_disk_and_small_slot_are_refused(bench: Bench, bundles: Bundles, tmp_path: Path) -> None:
    """The data partition keeps its reserve for captures; a slot that is too small is detected before the write."""
    card = tmp_path / "card.img"
    run("truncate", "-s", f"{RESERVE_BYTES // 1_000_000 + 10}M", card)
    run("mkfs.ext4", "-q", card)
    state = bench.here / "state"
    run("mount", "-o", "loop", card, state)
    try:
        assert "are free" in refused(bench, bundles.newer, UpdateNoRoom)
        assert not list(state.glob("*.part"))
    finally:
        run("umount", state)
    run("truncate", "-s", "4M", bench.here / "B.img")
    run("losetup", "-c", bench.loops["B"])
    refused(bench, bundles.newer, UpdateNoRoom)


def test_removed_usb_drive_is_refused(bench: Bench, bundles: Bundles, tmp_path: Path) -> None:
    """The drive is a loop device whose backing file is truncated during the read, so the kernel returns EIO."""
    backing_file, stick = tmp_path / "stick.img", bench.here / "media" / "stick"
    stick.mkdir()
    run("truncate", "-s", "40M", backing_file)
    run("mkfs.ext4", "-q", backing_file)
    run("mount", "-o", "loop", backing_file, stick)
    try:
        shutil.copy(bundles.newer, stick)
        run("umount", stick)
        run("mount", "-o", "loop,ro", backing_file, stick)
        assert (stick / bundles.newer.name).stat().st_size > 12_000_000
        run("truncate", "-s", "8M", backing_file)
        run("losetup", "-c", run("findmnt", "-n", "-o", "SOURCE", stick).strip())
        assert "cannot be read" in refused(bench, None, UpdateSourceRemoved)
    finally:
        run("umount", stick)
    assert not list((bench.here / "state").glob("*.raucb*"))


def test_missing_and_ambiguous_bundles_are_refused(bench: Bench, bundles: Bundles) -> None:
    assert "holds no file" in refused(bench, None, UpdateNotFound)
    for name in ("a.raucb", "b.raucb"):
        shutil.copy(bundles.newer, bench.here / "media" / name)
    assert "several" in refused(bench, None, UpdateNotFound)


def test_concurrent_update_is_refused(bench: Bench, bundles: Bundles) -> None:
    with preconditions.update_lock(bench.here / "state"):
        with bench.service(), pytest.raises(UpdateBusy):
            bench.updater().install(bundles.newer)
        assert bench.updater().status()[0].state == "none"  # the state of the first one stays


def test_update_during_a_try_is_refused(bench: Bench, bundles: Bundles) -> None:
    bench.fill("B", bundles.newer)
    bench.chooser.set_primary("B")
    bench.boot()
    third = bundles.workshop.small(f"{bench.here.parent.name}-third", "3.0")
    with bench.service():
        with pytest.raises(UpdateUncommitted, match="committed"):
            bench.updater("2.0").install(third)
        with pytest.raises(UpdateFailed):  # RAUC itself refuses it too
            Rauc(bench.rauc()).install(third, lambda share, what: None)
    assert bench.version("A") == "1.0"


def test_channel_update_resumes_after_a_lost_connection(bench: Bench, bundles: Bundles, tmp_path: Path) -> None:
    """Checked as by the timer, downloaded in two parts, installed on request."""
    content = bundles.newer.read_bytes()
    offer = {
        "compatible": "diffuscope-pi5",
        "version": "2.0",
        "bundle": bundles.newer.name,
        "bytes": len(content),
        "sha256": hashlib.sha256(content).hexdigest(),
        "number": 1,
        "expires": "9999-12-31",
    }
    certificate, key = identity(tmp_path)
    with serve(certificate, key) as site, bench.service():
        site.files = {
            "channel.cms": signed(bundles.workshop.keys, json.dumps(offer).encode()),
            bundles.newer.name: content,
        }
        site.cuts = [10_000_000, 7_000_000]  # channel.cms is shorter than the first cut
        updater = bench.updater(channel=site.url, authority=certificate)
        found = updater.check(download=True)
        assert (found and found.version, site.requested_ranges) == ("2.0", ["all", "all", "bytes=7000000-"])
        assert "Version 2.0 is offered" in updater.status()[1]
        updater.install(None)
        assert bench.updater("2.0", channel=site.url, authority=certificate).check() is None
    assert bench.version("B") == "2.0"
    with pytest.raises(UpdateUnreachable):
        bench.updater(channel=site.url, authority=certificate).check()


@pytest.mark.parametrize("date", ["2020-01-01", "2035-01-01"])
def test_wrong_clock_does_not_prevent_an_update(bench: Bench, bundles: Bundles, date: str) -> None:
    """The signature is verified at its signing time, since the device's clock may never have been set."""
    with bench.service(*at(date)):
        bench.updater(rauc=bench.rauc(*at(date))).install(bundles.newer)
    assert bench.version("B") == "2.0"
    assert bench.boot() == "B"


@pytest.mark.parametrize("date", ["2020-01-01", "2035-01-01"])
def test_wrong_clock_accepts_the_channel_and_refuses_its_server_with_a_remedy(
    bundles: Bundles, tmp_path: Path, date: str
) -> None:
    """A signature holds at any date; a web server's certificate does not, and a USB drive needs none."""
    offer = {"compatible": "diffuscope-pi5", "version": "2.0", "bundle": "a.raucb", "bytes": 1, "sha256": "0" * 64}
    offer |= {"number": 1, "expires": "2030-01-01"}
    (tmp_path / "channel.cms").write_bytes(signed(bundles.workshop.keys, json.dumps(offer).encode()))
    certificate, key = identity(tmp_path)
    with serve(certificate, key) as site:
        files = [certificate, tmp_path / "channel.cms", bundles.workshop.keys / "ca.crt"]
        output = run(*at(date), sys.executable, "-m", "tests.appliance.ask_update_server", site.url, *files, cwd=ROOT)
    assert output.startswith("2.0\nLook whether date and time of this device are right")


def test_missing_rauc_is_an_error(bench: Bench, bundles: Bundles) -> None:
    refused(bench, bundles.newer, UpdateFailed, rauc=("no-such-rauc",))
