"""Update sources over real HTTPS: complete, resumed, failed and altered downloads; channel, versions, settings."""

import hashlib
import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from datetime import date, timedelta
from pathlib import Path

import pytest

from device.clock import VirtualClock
from services.errors import (
    UpdateDamaged,
    UpdateFailed,
    UpdateNoRoom,
    UpdateNotFound,
    UpdateOlder,
    UpdateStale,
    UpdateUnreachable,
    UpdateUntrusted,
    UpdateWrongDevice,
)
from services.update.available_updates import AvailableUpdates
from services.update.channel import Offer, refuse_stale, verify_channel
from services.update.channel_memory import FILES, ChannelMemory, SeenChannel
from services.update.preconditions import parse_version, refuse_unsuitable
from services.update.rauc import Rauc, Release
from services.update.settings import UpdateSettings, load_settings
from services.update.signers import bundle_certificates, refuse_other_purpose, refuse_revoked
from services.update.sources import BACKOFF_S, UpdateServer, find_bundle
from services.update.state import StateFile
from tests.project_files import ROOT
from tests.site import Site, identity, serve, signed


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    subprocess.run([ROOT / "systemd" / "image" / "keys", folder], check=True)
    identity(folder)
    return folder


@pytest.fixture
def site(keys: Path) -> Iterator[Site]:
    with serve(keys / "web.crt", keys / "web.key") as site:
        yield site


LAST_DAY = date(2026, 12, 31)


def offer(content: bytes, version: str = "2.0") -> Offer:
    return Offer(
        compatible="diffuscope-pi5",
        version=version,
        bundle="two.raucb",
        bytes=len(content),
        sha256=hashlib.sha256(content).hexdigest(),
        number=7,
        expires=LAST_DAY,
    )


def silent(share: float, what: str) -> None:
    assert 0 <= share <= 1
    assert what == "fetching"


CONTENT = bytes(range(256)) * 40_000


def test_download_resumes_after_two_lost_connections_with_backoff(site: Site, keys: Path, tmp_path: Path) -> None:
    site.files, site.cuts, clock = {"two.raucb": CONTENT}, [3_000_000, 4_000_000], VirtualClock()
    fetched = UpdateServer(site.url, keys / "web.crt", clock).download(offer(CONTENT), tmp_path, silent)
    assert fetched.read_bytes() == CONTENT
    assert site.requested_ranges == ["all", "bytes=3000000-", "bytes=7000000-"]
    assert clock.now_s() == BACKOFF_S[0] + BACKOFF_S[1]


def test_download_is_given_up_after_the_last_try_and_its_part_is_kept(site: Site, keys: Path, tmp_path: Path) -> None:
    site.files, site.cuts = {"two.raucb": CONTENT}, [5_000_000] + [0] * len(BACKOFF_S)
    web = UpdateServer(site.url, keys / "web.crt", VirtualClock())
    with pytest.raises(UpdateUnreachable, match="5000000 of 10240000") as caught:
        web.download(offer(CONTENT), tmp_path, silent)
    assert "goes on from there" in caught.value.remedy
    assert web.download(offer(CONTENT), tmp_path, silent).read_bytes() == CONTENT
    assert site.requested_ranges[-1] == "bytes=5000000-"


def test_download_restarts_if_the_server_has_no_ranges(site: Site, keys: Path, tmp_path: Path) -> None:
    site.files, site.cuts, site.supports_ranges = {"two.raucb": CONTENT}, [5_000_000], False
    web = UpdateServer(site.url, keys / "web.crt", VirtualClock())
    assert web.download(offer(CONTENT), tmp_path, silent).read_bytes() == CONTENT


def test_download_with_another_sha256_is_removed(site: Site, keys: Path, tmp_path: Path) -> None:
    site.files = {"two.raucb": CONTENT[:-1] + b"x"}
    with pytest.raises(UpdateDamaged, match="SHA-256"):
        UpdateServer(site.url, keys / "web.crt", VirtualClock()).download(offer(CONTENT), tmp_path, silent)
    assert list(tmp_path.iterdir()) == []


def test_resumed_download_with_wrong_content_is_fetched_again(site: Site, keys: Path, tmp_path: Path) -> None:
    """A power cut may leave zeros instead of content, which is no reason to report a damaged file."""
    (tmp_path / "two.raucb.part").write_bytes(bytes(4_000_000))
    site.files = {"two.raucb": CONTENT}
    assert UpdateServer(site.url, keys / "web.crt", VirtualClock()).download(offer(CONTENT), tmp_path, silent).exists()
    assert site.requested_ranges == ["bytes=4000000-", "all"]


def test_complete_download_is_not_requested_again(site: Site, keys: Path, tmp_path: Path) -> None:
    (tmp_path / "update.raucb").write_bytes(CONTENT)
    (tmp_path / "one.raucb.part").write_bytes(b"of an older version")
    assert UpdateServer(site.url, keys / "web.crt", VirtualClock()).download(offer(CONTENT), tmp_path, silent).exists()
    assert (site.requested_ranges, list(tmp_path.glob("*.part"))) == ([], [])


def test_a_redirect_is_followed_to_https_only(site: Site, keys: Path) -> None:
    site.files = {"elsewhere": b"signed"}
    web = UpdateServer(site.url, keys / "web.crt", VirtualClock())
    site.moved = {"channel.cms": f"{site.url}/elsewhere"}
    assert web.read_small_file("channel.cms") == b"signed"
    site.moved = {"channel.cms": "http://localhost:9/channel.cms"}
    with pytest.raises(UpdateUnreachable, match="only https"):
        web.read_small_file("channel.cms")


def test_untrusted_certificate_has_a_remedy_about_the_clock(site: Site, tmp_path: Path) -> None:
    """The usual cause on a device without a battery-backed clock: the certificate seems expired."""
    with pytest.raises(UpdateUnreachable) as caught:
        UpdateServer(site.url, None, VirtualClock()).read_small_file("channel.cms")
    assert "date and time" in caught.value.remedy


def test_missing_file_is_an_error_with_its_url(site: Site, keys: Path) -> None:
    with pytest.raises(UpdateUnreachable, match=r"channel\.cms: 404"):
        UpdateServer(site.url, keys / "web.crt", VirtualClock()).read_small_file("channel.cms")


def test_channel_is_accepted_with_a_valid_signature_only(keys: Path, tmp_path: Path) -> None:
    fields = offer(CONTENT).model_dump(mode="json") | {"of a later release": 1}
    channel = signed(keys, json.dumps(fields).encode())
    assert verify_channel(channel, keys / "ca.crt") == offer(CONTENT)
    stranger = tmp_path / "stranger"
    subprocess.run([ROOT / "systemd" / "image" / "keys", stranger], check=True)
    with pytest.raises(UpdateUntrusted):
        verify_channel(channel, stranger / "ca.crt")
    changed = channel.replace(b'"version": "2.0"', b'"version": "9.0"')
    assert changed != channel
    with pytest.raises(UpdateDamaged):
        verify_channel(changed, keys / "ca.crt")
    with pytest.raises(UpdateDamaged):
        verify_channel(b"<html>log in to this network</html>", keys / "ca.crt")
    with pytest.raises(UpdateDamaged, match="nothing that can be used"):
        verify_channel(signed(keys, b'{"version": "2.0"}'), keys / "ca.crt")
    with pytest.raises(UpdateDamaged):
        verify_channel(signed(keys, json.dumps(fields | {"bundle": "../../etc/x.raucb"}).encode()), keys / "ca.crt")


def test_an_old_file_of_the_channel_is_refused() -> None:
    for seen in (0, 6, 7):
        refuse_stale(offer(CONTENT), seen, LAST_DAY)
    with pytest.raises(UpdateStale, match="file 7, and this device has seen file 8"):
        refuse_stale(offer(CONTENT), 8, LAST_DAY)
    with pytest.raises(UpdateStale, match="until 2026-12-31, and today is 2027-01-01"):
        refuse_stale(offer(CONTENT), 7, LAST_DAY + timedelta(days=1))


def test_the_device_keeps_number_and_revoked_keys_of_the_channel(keys: Path, site: Site, tmp_path: Path) -> None:
    settings = UpdateSettings(channel=site.url, authority=keys / "web.crt", keyring=keys / "ca.crt", folder=tmp_path)
    available = AvailableUpdates(settings, VirtualClock(), Rauc(["no-such-rauc"]), "1.0")

    def answer(number: int, *revoked: str) -> None:
        fields = offer(CONTENT).model_dump(mode="json") | {
            "number": number,
            "revoked": revoked,
            "expires": "9999-12-31",
        }
        site.files["channel.cms"] = signed(keys, json.dumps(fields).encode())
        available.newer_offer()

    answer(7, "a" * 64)
    answer(8, "b" * 64)
    with pytest.raises(UpdateStale):
        answer(7)
    assert ChannelMemory(tmp_path).read() == SeenChannel(number=8, revoked=("a" * 64, "b" * 64))
    answer(9, key_of(keys))
    for name in FILES:
        with pytest.raises(UpdateUntrusted, match="is revoked"):
            answer(10)
        (tmp_path / name).write_bytes(b"{}")
    with pytest.raises(UpdateFailed, match="revoked keys cannot be read"):
        answer(10)


def key_of(keys: Path) -> str:
    """Return the SHA-256 of the public key of the signer, as services/update/README.md describes."""
    command = f"openssl x509 -in {keys}/signer.crt -pubkey -noout | openssl pkey -pubin -outform DER | sha256sum"
    return subprocess.run(command, shell=True, check=True, capture_output=True, text=True).stdout[:64]


def test_a_revoked_key_signs_neither_channel_nor_bundle(keys: Path, tmp_path: Path) -> None:
    channel = signed(keys, json.dumps(offer(CONTENT).model_dump(mode="json")).encode())
    verify_channel(channel, keys / "ca.crt", {"0" * 64})
    with pytest.raises(UpdateUntrusted, match="is revoked"):
        verify_channel(channel, keys / "ca.crt", {key_of(keys)})
    bundle = tmp_path / "two.raucb"
    bundle.write_bytes(CONTENT + channel + len(channel).to_bytes(8, "big"))  # a signature at its end, as of RAUC
    refuse_revoked(bundle_certificates(bundle), {"0" * 64})
    with pytest.raises(UpdateUntrusted, match="is revoked"):
        refuse_revoked(bundle_certificates(bundle), {key_of(keys)})
    for content in (b"", b"short", CONTENT, CONTENT + (1 << 40).to_bytes(8, "big")):
        bundle.write_bytes(content)
        with pytest.raises(UpdateUntrusted, match="cannot be read"):
            refuse_revoked(bundle_certificates(bundle), {key_of(keys)})


def test_a_channel_of_a_signer_for_another_purpose_is_refused(keys: Path) -> None:
    """The authority of the image may have signed certificates for other uses too."""
    with pytest.raises(UpdateUntrusted, match="may not sign code"):
        refuse_other_purpose((keys / "ca.crt").read_bytes())
    refuse_other_purpose((keys / "signer.crt").read_bytes())


def test_versions_compare_as_numbers(tmp_path: Path) -> None:
    assert (
        parse_version("2.0")
        == parse_version("2")
        < parse_version("2.0.1")
        < parse_version("2.10")
        < parse_version("10")
    )
    for word in ("", "2.0-rc1", "two", "1.2.3.4.5"):
        with pytest.raises(UpdateDamaged):
            parse_version(word)
    release = Release("here", "2.9", "1.0", "")
    refuse_unsuitable(release, "here", "2.8.9", tmp_path)
    with pytest.raises(UpdateOlder):
        refuse_unsuitable(release, "here", "2.10", tmp_path)


def test_release_without_kernel_is_refused_where_the_kernel_has_modules(tmp_path: Path) -> None:
    """Where the running kernel has modules, a release needs its own kernel; elsewhere both kinds are accepted."""
    with_kernel, without = (Release("here", "2.9", "1.0", "", has_kernel=has_kernel) for has_kernel in (True, False))
    for release in (with_kernel, without):
        refuse_unsuitable(release, "here", "2.8", tmp_path)
    (tmp_path / os.uname().release).mkdir()
    refuse_unsuitable(with_kernel, "here", "2.8", tmp_path)
    with pytest.raises(UpdateWrongDevice, match="has no kernel") as caught:
        refuse_unsuitable(without, "here", "2.8", tmp_path)
    assert "it brings its kernel" in caught.value.remedy


def test_settings_refuse_unknown_keys_and_invalid_values(tmp_path: Path) -> None:
    shipped = load_settings(ROOT / "systemd" / "image" / "update.toml")
    assert shipped == UpdateSettings()
    for text in ("chanel = 'x'", "channel = 'http://insecure.example'", "lowest_battery = 2", "= nonsense"):
        (tmp_path / "update.toml").write_text(text)
        with pytest.raises(ValueError, match=r"update\.toml"):
            load_settings(tmp_path / "update.toml")


def test_update_command_imports_no_numerics_driver_or_server() -> None:
    assert not {"numba", "scipy", "pyfftw", "fastapi", "device.head", "device.recon"} & loaded_by(
        "services.update.command"
    )


def test_command_line_imports_neither_database_nor_web_server() -> None:
    assert not {"sqlalchemy", "alembic", "fastapi", "uvicorn", "picamera2"} & loaded_by("services.cli")


def loaded_by(module: str) -> set[str]:
    """Return every module that is loaded once `module` is imported in a new process."""
    asks = f"import sys, {module}; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", asks], cwd=ROOT, check=True, capture_output=True, text=True)
    return set(found.stdout.split())


def test_unwritable_journal_is_logged_and_does_not_hide_a_refusal(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A limit on the file size stands for a full disk; the old entry stays."""
    journal = StateFile(tmp_path)
    journal.write(state="installed", version="2.0")
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, usual[1]))
    try:
        with pytest.raises(UpdateNoRoom):
            journal.write(state="trying")
        with pytest.raises(UpdateNotFound), journal.record_refusals():
            raise UpdateNotFound("no stick")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    assert "cannot be written" in caplog.text
    assert journal.read().state == "installed"
    with pytest.raises(UpdateFailed):
        StateFile(tmp_path / "gone").write(state="trying")


def test_usb_drives_are_searched_one_folder_deep(tmp_path: Path) -> None:
    with pytest.raises(UpdateNotFound):
        find_bundle(tmp_path)
    (tmp_path / "stick").mkdir()
    (tmp_path / "stick" / "two.raucb").write_bytes(b"")
    assert find_bundle(tmp_path) == find_bundle(tmp_path / "stick") == tmp_path / "stick" / "two.raucb"
