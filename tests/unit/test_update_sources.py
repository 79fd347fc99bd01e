"""Fetching over real HTTPS: whole, cut and gone on with, given up, changed on its way; and what a channel may say."""

import hashlib
import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.errors import (
    UpdateDamaged,
    UpdateFailed,
    UpdateForeign,
    UpdateNoRoom,
    UpdateNowhere,
    UpdateOlder,
    UpdateUnreachable,
    UpdateWrongDevice,
)  # fmt: skip
from services.update.channel import Offer, opened
from services.update.engine import Release
from services.update.gate import number, refuse_wrong
from services.update.journal import Journal
from services.update.settings import UpdateSettings, load
from services.update.sources import WAITS_S, Web, on_stick
from tests.house import ROOT
from tests.site import Site, identity, served, signed


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    subprocess.run([ROOT / "systemd" / "image" / "keys", folder], check=True)
    identity(folder)
    return folder


@pytest.fixture
def site(keys: Path) -> Iterator[Site]:
    with served(keys / "web.crt", keys / "web.key") as site:
        yield site


def offer(content: bytes, version: str = "2.0") -> Offer:
    return Offer(
        compatible="diffuscope-pi5", version=version, bundle="two.raucb", bytes=len(content),
        sha256=hashlib.sha256(content).hexdigest(),
    )  # fmt: skip


def silent(share: float, what: str) -> None:
    assert 0 <= share <= 1
    assert what == "fetching"


CONTENT = bytes(range(256)) * 40_000


def test_a_link_that_is_lost_twice_is_taken_up_where_it_was_lost(site: Site, keys: Path, tmp_path: Path) -> None:
    site.files, site.cuts, clock = {"two.raucb": CONTENT}, [3_000_000, 4_000_000], VirtualClock()
    fetched = Web(site.at, keys / "web.crt", clock).download(offer(CONTENT), tmp_path, silent)
    assert fetched.read_bytes() == CONTENT
    assert site.asked == ["all", "bytes=3000000-", "bytes=7000000-"]
    assert clock.now_s() == WAITS_S[0] + WAITS_S[1]


def test_a_link_that_stays_lost_is_given_up_and_what_arrived_is_kept(site: Site, keys: Path, tmp_path: Path) -> None:
    site.files, site.cuts = {"two.raucb": CONTENT}, [5_000_000] + [0] * len(WAITS_S)
    web = Web(site.at, keys / "web.crt", VirtualClock())
    with pytest.raises(UpdateUnreachable, match="5000000 of 10240000") as caught:
        web.download(offer(CONTENT), tmp_path, silent)
    assert "goes on from there" in caught.value.remedy
    assert web.download(offer(CONTENT), tmp_path, silent).read_bytes() == CONTENT
    assert site.asked[-1] == "bytes=5000000-"


def test_a_server_that_cannot_go_on_begins_anew(site: Site, keys: Path, tmp_path: Path) -> None:
    site.files, site.cuts, site.knows_ranges = {"two.raucb": CONTENT}, [5_000_000], False
    web = Web(site.at, keys / "web.crt", VirtualClock())
    assert web.download(offer(CONTENT), tmp_path, silent).read_bytes() == CONTENT


def test_what_is_not_what_the_channel_promised_is_removed(site: Site, keys: Path, tmp_path: Path) -> None:
    site.files = {"two.raucb": CONTENT[:-1] + b"x"}
    with pytest.raises(UpdateDamaged, match="SHA-256"):
        Web(site.at, keys / "web.crt", VirtualClock()).download(offer(CONTENT), tmp_path, silent)
    assert list(tmp_path.iterdir()) == []


def test_what_a_power_cut_kept_by_its_length_only_is_fetched_anew(site: Site, keys: Path, tmp_path: Path) -> None:
    """Zeros where the content was not written yet; who waited for hours for it is not told that the file is damaged."""
    (tmp_path / "two.raucb.part").write_bytes(bytes(4_000_000))
    site.files = {"two.raucb": CONTENT}
    assert Web(site.at, keys / "web.crt", VirtualClock()).download(offer(CONTENT), tmp_path, silent).exists()
    assert site.asked == ["bytes=4000000-", "all"]


def test_what_is_there_already_is_not_asked_for_again(site: Site, keys: Path, tmp_path: Path) -> None:
    (tmp_path / "update.raucb").write_bytes(CONTENT)
    (tmp_path / "one.raucb.part").write_bytes(b"of an older version")
    assert Web(site.at, keys / "web.crt", VirtualClock()).download(offer(CONTENT), tmp_path, silent).exists()
    assert (site.asked, list(tmp_path.glob("*.part"))) == ([], [])


def test_a_server_that_nobody_vouches_for_hints_at_the_clock(site: Site, tmp_path: Path) -> None:
    """The commonest cause on a device without a clock of its own: its certificate seems to be of another time."""
    with pytest.raises(UpdateUnreachable) as caught:
        Web(site.at, None, VirtualClock()).small("channel.cms")
    assert "date and time" in caught.value.remedy


def test_a_file_that_is_not_there_is_said_with_its_address(site: Site, keys: Path) -> None:
    with pytest.raises(UpdateUnreachable, match=r"channel\.cms: 404"):
        Web(site.at, keys / "web.crt", VirtualClock()).small("channel.cms")


def test_a_channel_is_believed_if_our_signer_signed_it(keys: Path, tmp_path: Path) -> None:
    said = offer(CONTENT).model_dump() | {"of a later release": 1}
    channel = signed(keys, json.dumps(said).encode())
    assert opened(channel, keys / "ca.crt") == offer(CONTENT)
    stranger = tmp_path / "stranger"
    subprocess.run([ROOT / "systemd" / "image" / "keys", stranger], check=True)
    with pytest.raises(UpdateForeign):
        opened(channel, stranger / "ca.crt")
    changed = channel.replace(b'"version": "2.0"', b'"version": "9.0"')
    assert changed != channel
    with pytest.raises(UpdateDamaged):
        opened(changed, keys / "ca.crt")
    with pytest.raises(UpdateDamaged):
        opened(b"<html>log in to this network</html>", keys / "ca.crt")
    with pytest.raises(UpdateDamaged, match="nothing that can be used"):
        opened(signed(keys, b'{"version": "2.0"}'), keys / "ca.crt")
    with pytest.raises(UpdateDamaged):
        opened(signed(keys, json.dumps(said | {"bundle": "../../etc/x.raucb"}).encode()), keys / "ca.crt")


def test_versions_are_numbers_and_not_words(tmp_path: Path) -> None:
    assert number("2.0") == number("2") < number("2.0.1") < number("2.10") < number("10")
    for word in ("", "2.0-rc1", "two", "1.2.3.4.5"):
        with pytest.raises(UpdateDamaged):
            number(word)
    release = Release("here", "2.9", "1.0", "")
    refuse_wrong(release, "here", "2.8.9", tmp_path)
    with pytest.raises(UpdateOlder):
        refuse_wrong(release, "here", "2.10", tmp_path)


def test_a_root_never_meets_the_kernel_of_another(tmp_path: Path) -> None:
    """A device whose kernel has modules takes no version without its kernel; one without modules takes both."""
    with_kernel, without = (Release("here", "2.9", "1.0", "", has_kernel=one) for one in (True, False))
    for release in (with_kernel, without):
        refuse_wrong(release, "here", "2.8", tmp_path)
    (tmp_path / os.uname().release).mkdir()
    refuse_wrong(with_kernel, "here", "2.8", tmp_path)
    with pytest.raises(UpdateWrongDevice, match="has no kernel") as caught:
        refuse_wrong(without, "here", "2.8", tmp_path)
    assert "it brings its kernel" in caught.value.remedy


def test_settings_refuse_what_they_do_not_know(tmp_path: Path) -> None:
    shipped = load(ROOT / "systemd" / "image" / "update.toml")
    assert shipped == UpdateSettings()
    for text in ("chanel = 'x'", "channel = 'http://insecure.example'", "lowest_battery = 2", "= nonsense"):
        (tmp_path / "update.toml").write_text(text)
        with pytest.raises(ValueError, match=r"update\.toml"):
            load(tmp_path / "update.toml")


def test_what_judges_a_version_loads_none_of_what_it_judges() -> None:
    assert not {"numba", "scipy", "pyfftw", "fastapi", "device.head", "device.recon"} & loaded_by(
        "services.update.command"
    )


def test_the_command_line_loads_neither_database_nor_web_server() -> None:
    assert not {"sqlalchemy", "alembic", "fastapi", "uvicorn", "picamera2"} & loaded_by("services.cli")


def loaded_by(module: str) -> set[str]:
    """Every module that is loaded once `module` is imported in a new process."""
    asks = f"import sys, {module}; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", asks], cwd=ROOT, check=True, capture_output=True, text=True)
    return set(found.stdout.split())


def test_a_journal_that_cannot_be_written_is_said_and_hides_no_refusal(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A limit on the length of files is what a full disk is: the old entry stays."""
    journal = Journal(tmp_path)
    journal.write(state="installed", version="2.0")
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, usual[1]))
    try:
        with pytest.raises(UpdateNoRoom):
            journal.write(state="trying")
        with pytest.raises(UpdateNowhere), journal.refusals():
            raise UpdateNowhere("no stick")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    assert "cannot be written" in caplog.text
    assert journal.read().state == "installed"
    with pytest.raises(UpdateFailed):
        Journal(tmp_path / "gone").write(state="trying")


def test_sticks_are_looked_at_one_folder_deep(tmp_path: Path) -> None:
    with pytest.raises(UpdateNowhere):
        on_stick(tmp_path)
    (tmp_path / "stick").mkdir()
    (tmp_path / "stick" / "two.raucb").write_bytes(b"")
    assert on_stick(tmp_path) == on_stick(tmp_path / "stick") == tmp_path / "stick" / "two.raucb"
