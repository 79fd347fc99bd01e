"""Settings of a card: valid, invalid and interrupted; the password leaves the boot partition."""

import configparser
import json
import re
import shutil
import stat
import subprocess
import tomllib
from pathlib import Path

import pytest

from services.identity import card_settings
from services.identity.apply_settings import CardBoot, ethernet_profile, wifi_profile
from services.identity.card_settings import CardSettings, Ethernet, Wifi, kept_settings, take_settings
from services.identity.ssh_keys import decide, fingerprint
from tests.companions import apple_double
from tests.project_files import ROOT, text

KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGJcPFbe5hVKaLZ4yKkYbCzW1Sxd0hNnT0y0vN3hX4bQ me@laptop"
PASSWORD = "ganga 2026"
GOOD = f"""\
country = "KE"
time_zone = "Asia/Kolkata"
head = "imx477"
[wifi]
name = "Clinic"
password = "{PASSWORD}"   # of the router
[ssh]
keys = ["{KEY}"]
"""


@pytest.fixture
def card(tmp_path: Path) -> CardBoot:
    """Root file system of a card with a data partition, the heads of the release, and one time zone."""
    for name in ("boot/chooser", "data/captures", "opt/diffuscope", "etc/diffuscope", "usr/share/zoneinfo/Asia"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "usr/share/zoneinfo/Asia/Kolkata").touch()
    (tmp_path / "usr/share/zoneinfo/iso3166.tab").write_text("# codes\nIN\tIndia\nKE\tKenya\n")
    (tmp_path / "opt/diffuscope/hardware").symlink_to(ROOT / "hardware")
    return CardBoot(tmp_path)


def write(card: CardBoot, content: str) -> Path:
    file = card.root / "boot/chooser/diffuscope.toml"
    file.write_text(content)
    return file


def volatile(card: CardBoot) -> None:
    """Forget what a boot forgets: the root is under a tmpfs."""
    shutil.rmtree(card.root / "run", ignore_errors=True)


def files_with(folder: Path, secret: str) -> list[str]:
    found = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return sorted(str(path.relative_to(folder)) for path in found if secret.encode() in path.read_bytes())


def test_settings_are_taken_kept_and_applied_at_every_boot(card: CardBoot) -> None:
    """The second boot has the stars, the third no file at all, as after an update of the boot partition."""
    file = write(card, GOOD)
    decide(card.root / "data/captures", fingerprint(KEY), confirmed=True)
    for boot in range(3):
        volatile(card)
        assert card.run() is None, boot
        profile = card.root / "run/NetworkManager/system-connections/wifi.nmconnection"
        assert f"psk={PASSWORD}\n" in profile.read_text()
        assert stat.S_IMODE(profile.stat().st_mode) == 0o600
        assert (card.root / "etc/localtime").readlink() == Path("/usr/share/zoneinfo/Asia/Kolkata")
        arguments = card.root / "run/diffuscope-settings/instrument.env"
        assert arguments.read_text() == "HEAD=/opt/diffuscope/hardware/heads/imx477.toml\n"
        assert stat.S_IMODE(arguments.stat().st_mode) == 0o644
        assert (arguments.parent / "country.env").read_text() == "COUNTRY=KE\n"
        assert (card.root / "run/diffuscope-ssh/authorized_keys").read_text() == f"{KEY}\n"
        assert not (card.root / "run/diffuscope-settings/problem.json").exists()
        if boot == 1:
            file.unlink()
    assert kept_settings(card.kept).wifi == Wifi(name="Clinic", password=PASSWORD)
    assert stat.S_IMODE(card.kept.stat().st_mode) == 0o700


def test_the_password_leaves_the_boot_partition(card: CardBoot) -> None:
    file = write(card, GOOD)
    card.run()
    assert len(file.read_text()) == len(GOOD), "overwritten in place"
    assert tomllib.loads(file.read_text())["wifi"]["password"] == "*" * len(PASSWORD)
    assert "# of the router" in file.read_text()
    assert files_with(card.root, PASSWORD) == [
        "data/settings/diffuscope.toml",
        "run/NetworkManager/system-connections/wifi.nmconnection",
    ]


def test_a_power_cut_before_the_stars_is_completed_by_the_next_boot(card: CardBoot) -> None:
    """The settings are durable before the password is overwritten, so neither is lost."""
    file = write(card, GOOD)
    card.run()
    file.write_text(GOOD)  # as if the cut came before the stars
    assert card.run() is None
    assert PASSWORD not in file.read_text()
    assert kept_settings(card.kept).wifi == Wifi(name="Clinic", password=PASSWORD)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("[wifi", "is not TOML"),
        (GOOD.replace("name", "nmae"), "did you mean 'wifi.name'|'wifi.nmae'"),
        (GOOD.replace(PASSWORD, "short"), "8 to 63"),
        (GOOD.replace("ssh-ed25519", "-----BEGIN"), "id_ed25519.pub"),
        (GOOD.replace("Kolkata", "Kalkutta"), "Asia/Kalkutta"),
        (GOOD.replace("KE", "UK"), "'UK' is none"),
        (GOOD.replace("KE", "Kenya"), "country"),
        (GOOD.replace("imx477", "imx999"), "no head file 'imx999.toml'.*imx296, .*imx296_power"),
        (f'programme = "mine.toml"\n{GOOD}', "mine.toml"),
        (GOOD.replace("Clinic", "Other").replace(PASSWORD, "*" * 10), "no password"),
        (GOOD.replace(PASSWORD, 'ga\\"ga 2026'), "removed"),
        ('wifi = { name = "Clinic", password = "ganga 2026" }', "removed"),
        ("\x00\x01\x02", "diffuscope.toml"),
        (GOOD.replace("[ssh]", "[sshd]"), "sshd"),
        (GOOD.replace("imx477", "../../etc/shadow"), "head"),
    ],
)
def test_nonsense_is_reported_and_the_kept_settings_stay(card: CardBoot, change: str, named: str) -> None:
    """It boots; console and page say why; nothing that was kept changes."""
    write(card, GOOD)
    card.run()
    before = (card.kept / "diffuscope.toml").read_bytes()
    volatile(card)
    write(card, change)
    problem = card.run()
    assert problem is not None
    assert re.search(named, problem.message + problem.remedy), problem.message
    assert (card.kept / "diffuscope.toml").read_bytes() == before
    assert f"psk={PASSWORD}\n" in (card.root / "run/NetworkManager/system-connections/wifi.nmconnection").read_text()
    assert problem.message in (card.root / "run/issue.d/settings.issue").read_text()
    published = json.loads((card.root / "run/diffuscope-settings/problem.json").read_text())
    assert published == {"message": problem.message, "remedy": problem.remedy}
    write(card, GOOD)
    assert card.run() is None
    assert not (card.root / "run/diffuscope-settings/problem.json").exists()


def ssh_keys_of_boot(card: CardBoot, settings: str) -> tuple[list[str], list[str]]:
    """Boot with these settings; return the keys that are asked for, and those that may log in."""
    volatile(card)
    write(card, settings)
    assert card.run() is None
    asked = json.loads((card.root / "run/diffuscope-settings/ssh-keys.json").read_text())
    applied = card.root / "run/diffuscope-ssh/authorized_keys"
    return asked, applied.read_text().splitlines() if applied.exists() else []


def test_a_key_for_ssh_is_applied_after_a_confirmation_only_and_a_changed_one_asks_again(card: CardBoot) -> None:
    """A person with the card writes a key into its unsigned file."""
    data, other, without = card.root / "data/captures", KEY.replace("bQ me", "bA me"), GOOD.partition("[ssh]")[0]
    two = GOOD.replace(KEY, f'{KEY}", "{other}')
    assert ssh_keys_of_boot(card, GOOD) == ([KEY], [])
    decide(data, fingerprint(KEY), confirmed=True)
    assert ssh_keys_of_boot(card, GOOD) == ([KEY], [KEY])
    assert ssh_keys_of_boot(card, two) == ([KEY, other], [KEY])
    decide(data, fingerprint(other), confirmed=False)
    assert ssh_keys_of_boot(card, two) == ([KEY, other], [KEY])
    assert ssh_keys_of_boot(card, GOOD.replace(KEY, other)) == ([other], [])
    assert ssh_keys_of_boot(card, GOOD) == ([KEY], []), "the key was changed meanwhile"
    decide(data, fingerprint(KEY), confirmed=True)
    assert ssh_keys_of_boot(card, without) == ([], [])
    assert ssh_keys_of_boot(card, GOOD) == ([KEY], []), "the key was removed meanwhile"
    (data / "ssh-keys.json").write_text("no JSON")
    assert ssh_keys_of_boot(card, GOOD) == ([KEY], [])


def test_the_fingerprint_is_that_of_ssh_keygen(tmp_path: Path) -> None:
    (tmp_path / "key.pub").write_text(KEY)
    words = ["ssh-keygen", "-lf", str(tmp_path / "key.pub")]
    assert fingerprint(KEY) in subprocess.run(words, capture_output=True, text=True, check=True).stdout


def test_a_card_without_settings_boots_with_its_defaults_and_no_ssh(card: CardBoot) -> None:
    shutil.copyfile(ROOT / "systemd/image/card/diffuscope.toml", card.root / "boot/chooser/diffuscope.toml")
    assert card.run() is None
    assert kept_settings(card.kept) == CardSettings()
    assert (card.root / "run/diffuscope-settings/instrument.env").read_text() == ""
    assert not (card.root / "run/diffuscope-ssh").exists()
    assert not (card.root / "run/NetworkManager").exists()


@pytest.mark.parametrize(("settings", "own_wifi"), [("network = true\n", True), (f"network = true\n{GOOD}", False)])
def test_the_network_is_served_only_where_the_settings_say_so(card: CardBoot, settings: str, own_wifi: bool) -> None:
    """Sockets and avahi have the file as a condition; the access point is for a device that joins no Wi-Fi."""
    written = card.root / "run/diffuscope-settings/network"
    profile = card.root / "run/NetworkManager/system-connections/access-point.nmconnection"
    for text_of_card, is_served in ((settings, True), ("", False)):
        volatile(card)
        profile.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / "systemd/image/access-point.nmconnection", profile)
        write(card, text_of_card)
        assert card.run() is None
        assert written.exists() is is_served
        assert ("autoconnect=true" in profile.read_text()) is (is_served and own_wifi)
    for unit in ("diffuscope-network.socket", "diffuscope-pairing.socket", "image/avahi-condition.conf"):
        assert f"ConditionPathExists=/{written.relative_to(card.root)}\n" in text(f"systemd/{unit}")
    announced = re.findall(r"<type>(.*)</type>\s*<port>(.*)</port>", text("systemd/image/avahi.service"))
    assert announced == [("_https._tcp", "443")]
    assert "ListenStream=443\n" in text("systemd/diffuscope-network.socket")


def test_every_example_of_the_template_is_valid(card: CardBoot) -> None:
    """The file on the card, with every mark # removed before a key or a table."""
    lines = text("systemd/image/card/diffuscope.toml").replace("AAAAC3Nza...", KEY.split()[1]).splitlines()
    plain = "\n".join(re.sub(r"^# (?=\[|\w+ = )", "", line) for line in lines)
    shutil.copyfile(ROOT / "services/records/programme.toml", card.root / "boot/chooser/programme.toml")
    write(card, plain)
    assert card.run() is None
    settings = kept_settings(card.kept)
    assert all(value is not None for value in dict(settings).values())
    arguments = (card.root / "run/diffuscope-settings/instrument.env").read_text()
    assert "PROGRAMME=--programme /run/diffuscope-settings/programme.toml\n" in arguments
    assert (card.root / "run/diffuscope-settings/programme.toml").exists()


def test_a_head_file_beside_comes_with_its_sensor(card: CardBoot) -> None:
    boot = card.root / "boot/chooser"
    shutil.copyfile(ROOT / "device/config/sensor_presets/imx296.toml", boot / "mine.toml")
    head = (ROOT / "hardware/heads/imx296.toml").read_text().replace('sensor = "imx296"', 'sensor = "mine.toml"')
    (boot / "head.toml").write_text(head)
    write(card, 'head = "head.toml"\n')
    assert card.run() is None
    output = card.root / "run/diffuscope-settings"
    assert (output / "instrument.env").read_text() == "HEAD=/run/diffuscope-settings/head.toml\n"
    assert (output / "mine.toml").exists()


def test_files_that_the_settings_do_not_name_are_not_read(card: CardBoot) -> None:
    """Companions of macOS, and a note in another encoding, are there and do not matter."""
    boot = card.root / "boot/chooser"
    (boot / "._diffuscope.toml").write_bytes(apple_double())
    (boot / "notes.toml").write_bytes("# clínica".encode("latin-1"))
    write(card, GOOD)
    assert card.run() is None
    assert [path.name for path in card.kept.glob("*.toml")] == ["diffuscope.toml"]


def test_what_the_settings_no_longer_name_is_forgotten(card: CardBoot) -> None:
    boot = card.root / "boot/chooser"
    shutil.copyfile(ROOT / "services/records/programme.toml", boot / "programme.toml")
    write(card, f'programme = "programme.toml"\n{GOOD}')
    assert card.run() is None
    (card.kept / "update.toml").write_text('channel = "https://updates.example.org/diffuscope"\n')
    (card.kept / "._old.toml").write_bytes(apple_double())
    (card.kept / "folder.toml").mkdir()
    write(card, GOOD)
    volatile(card)
    assert card.run() is None
    assert sorted(path.name for path in card.kept.glob("*.toml")) == ["diffuscope.toml", "update.toml"]
    assert not (card.root / "run/diffuscope-settings/programme.toml").exists()


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "latin-1"])
def test_settings_in_another_encoding_are_named_and_a_mark_is_read(card: CardBoot, encoding: str) -> None:
    write(card, GOOD).write_bytes(f"# clínica\n{GOOD}".encode(encoding))
    problem = card.run()
    expected = {"utf-8-sig": None, "latin-1": "line 1: the byte 0xED .*Latin-1"}.get(encoding, "UTF-16")
    if expected is None:
        assert problem is None
        assert files_with(card.root / "boot", PASSWORD) == []
        return
    assert problem is not None
    assert re.search(expected, problem.message)
    assert "UTF-8" in problem.remedy
    assert "still holds the Wi-Fi password" in problem.remedy


@pytest.mark.parametrize(
    ("content", "holds"),
    [
        (GOOD.replace("KE", "UK"), True),
        ('wifi = { name = "Clinic", password = "ganga 2026" }', True),
        ("[wifi]\npassword = ganga2026\n", True),
        (GOOD.replace("KE", "UK").replace(PASSWORD, "*" * 10), False),
        ('country = "UK"\n', False),
        ('[wifi]\nname = "Clinic"\npassword = ""\ncolour = 1\n', False),
    ],
)
def test_a_refused_file_keeps_its_password_and_the_report_says_so(card: CardBoot, content: str, holds: bool) -> None:
    """Nothing else has the password of a file that was not taken."""
    file = write(card, content)
    problem = card.run()
    assert problem is not None
    assert ("still holds the Wi-Fi password" in problem.remedy) is holds
    assert "still holds" in (card.root / "run/issue.d/settings.issue").read_text() or not holds
    assert PASSWORD not in problem.message + problem.remedy
    assert file.read_text() == content


@pytest.mark.parametrize("broken", ["kept", "zone", "ssh"])
def test_a_step_that_fails_is_reported_and_the_others_are_applied(card: CardBoot, broken: str) -> None:
    """What was in force stays: a damaged programme, a root without zones or a key that cannot be made costs itself."""
    boot = card.root / "boot/chooser"
    shutil.copyfile(ROOT / "services/records/programme.toml", boot / "programme.toml")
    decide(card.root / "data/captures", fingerprint(KEY), confirmed=True)
    file = write(card, f'programme = "programme.toml"\n{GOOD}')
    assert card.run() is None
    file.unlink()
    volatile(card)
    if broken == "kept":
        (card.kept / "programme.toml").write_bytes(b"\xff\xfe\x00")
    elif broken == "zone":
        (card.root / "etc/localtime").unlink()
        (card.root / "etc/localtime").mkdir()
    else:
        (card.kept / "ssh_host_ed25519_key").unlink()
        (card.kept / "ssh_host_ed25519_key").symlink_to("/nowhere/key")
    problem = card.run()
    assert problem is not None
    assert json.loads((card.root / "run/diffuscope-settings/problem.json").read_text())["message"] == problem.message
    assert problem.message in (card.root / "run/issue.d/settings.issue").read_text()
    profile = card.root / "run/NetworkManager/system-connections/wifi.nmconnection"
    assert f"psk={PASSWORD}" in profile.read_text()


def test_a_full_data_partition_is_a_problem_and_no_failed_boot(card: CardBoot) -> None:
    write(card, GOOD)
    (card.root / "data/settings").touch()  # not a folder: what cannot be written
    problem = take_settings(
        card.root / "boot/chooser", card.kept, card.root / "opt/diffuscope", card.root / "usr/share/zoneinfo"
    )
    assert problem is not None
    assert "cannot be kept" in problem.message
    assert PASSWORD in (card.root / "boot/chooser/diffuscope.toml").read_text(), "it is still needed"


def test_update_settings_of_the_data_partition_replace_those_of_the_image(card: CardBoot) -> None:
    """Defect 16: update.toml was in the image only, so that each update reset it."""
    card.kept.mkdir()
    (card.kept / "update.toml").write_text('channel = "https://updates.example.org/diffuscope"\n')
    card.run()
    assert "updates.example.org" in (card.root / "etc/diffuscope/update.toml").read_text()


def test_profiles_are_keyfiles_of_networkmanager() -> None:
    profile = configparser.ConfigParser(interpolation=None)
    profile.read_string(wifi_profile(Wifi(name="Clinic", password="a\\b 12345678")))
    assert profile["wifi-security"]["psk"] == "a\\\\b 12345678", "a backslash is doubled"
    assert "wifi-security" not in wifi_profile(Wifi(name="open"))
    fixed = Ethernet.model_validate({"address": "192.168.1.20/24", "gateway": "192.168.1.1", "dns": ["192.168.1.1"]})
    profile.read_string(ethernet_profile(fixed))
    assert dict(profile["ipv4"]) == {
        "method": "manual",
        "address1": "192.168.1.20/24,192.168.1.1",
        "dns": "192.168.1.1;",
    }


def test_ssh_takes_keys_only_and_is_off_without_one() -> None:
    server, unit = text("systemd/image/sshd.conf"), text("systemd/image/ssh-keys.conf")
    for line in ("AuthenticationMethods publickey", "PasswordAuthentication no", "KbdInteractiveAuthentication no"):
        assert line in server.splitlines()
    keys = "/run/diffuscope-ssh/authorized_keys"
    assert f"AuthorizedKeysFile {keys}" in server
    assert f"ConditionPathExists={keys}" in unit
    assert card_settings.FILE in unit


@pytest.mark.skipif(shutil.which("sshd") is None and not Path("/usr/sbin/sshd").exists(), reason="no sshd")
def test_sshd_accepts_the_configuration(tmp_path: Path) -> None:
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", tmp_path / "key"], check=True)
    here = text("systemd/image/sshd.conf").replace("/data/settings/ssh_host_ed25519_key", str(tmp_path / "key"))
    (tmp_path / "sshd_config").write_text(here)
    words = [shutil.which("sshd") or "/usr/sbin/sshd", "-T", "-f", str(tmp_path / "sshd_config")]
    shown = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert "passwordauthentication no" in shown
