"""Card image: its files as read by firmware, rpi-image-gen, systemd, NetworkManager and avahi.

No Raspberry Pi and no package archive is needed; checks with the real programs are in `tests/systemd/` and
`tests/appliance/`.
"""

import configparser
import os
import re
import subprocess
from pathlib import Path

import pytest
import yaml

from device.config.head_file import load_head
from services.identity.apply_settings import OUTPUT
from services.identity.certificates import ACCESS_POINT_ADDRESS, SHARED_HOST_NAMES
from tests.project_files import ROOT, text

CARD = "systemd/image/card"
LAYERS = {"layer/diffuscope.yaml": "diffuscope", "image/diffuscope-card.yaml": "diffuscope-card"}
# Layers of rpi-image-gen that are used here, as listed in its documentation in August 2026.
THEIRS = {
    "rpi5",
    "image-base",
    "debian-trixie-arm64-multi",
    "rpi-debian-trixie",
    "rpi-essential-base",
    "systemd-min",
    "network-manager",
}
# Package of a program that is called on the card, and the file that calls it.
PROGRAMS = {
    "qrencode": ("qrencode", "services/identity/apply_at_boot.py"),
    "ssh-keygen": ("openssh-server", "services/identity/apply_settings.py"),
    "NetworkManager": ("network-manager", "services/identity/apply_settings.py"),
    "rpi-fw-crypto": ("rpifwcrypto", f"{CARD}/luks/diffuscope-key.service"),
    "iw": ("iw", "systemd/diffuscope-country.service"),
    "unsquashfs": ("squashfs-tools", "systemd/diffuscope-update-request.service"),
}
RULES = r"bool|dir|file|string(-or-empty)?|size|int(:\d+-\d+)?|regex:.+|keywords:[\w,-]+|list:[\w,-]+|[\w-]+(,[\w-]+)+"


def metadata(name: str) -> dict[str, str]:
    """Return the fields between METABEGIN and METAEND, with continued lines joined."""
    block = re.search(r"^# METABEGIN\n(.*?)^# METAEND$", text(f"{CARD}/{name}"), re.M | re.S)
    assert block is not None, "no metadata"
    lines = re.sub(r"\n# {2,}", " ", block[1]).splitlines()
    rows = [re.fullmatch(r"# (X-Env-[\w-]+): *(.*)", line) for line in lines if line != "#"]
    assert all(rows), "a line that rpi-image-gen cannot read"
    return {row[1]: row[2] for row in rows if row}


@pytest.mark.parametrize("name", LAYERS)
def test_layer_metadata_has_the_fields_of_rpi_image_gen(name: str) -> None:
    fields = metadata(name)
    assert fields["X-Env-Layer-Name"] == LAYERS[name]
    assert {"X-Env-Layer-Category", "X-Env-Layer-Desc", "X-Env-VarPrefix"} <= set(fields)
    assert re.fullmatch(r"\d+\.\d+\.\d+", fields["X-Env-Layer-Version"])
    assert set(fields["X-Env-Layer-Requires"].split(",")) <= THEIRS
    variables = {match[1] for key in fields if (match := re.fullmatch(r"X-Env-Var-([a-z_]+)", key))}
    for variable in variables:
        about = {what: fields[f"X-Env-Var-{variable}-{what}"] for what in ("Desc", "Required", "Valid", "Set")}
        assert about["Required"] in ("y", "n")
        assert about["Set"] in ("y", "n", "lazy", "force")
        assert re.fullmatch(RULES, about["Valid"]), f"{variable}: {about['Valid']}"


def test_every_checked_file_system_has_its_checker_on_the_card() -> None:
    """systemd skips the check of a file system whose fsck is missing."""
    packages = yaml.safe_load(text(f"{CARD}/layer/diffuscope.yaml"))["mmdebstrap"]["packages"]
    rows = [line.split() for line in text("systemd/image/fstab").splitlines() if line and line[0] != "#"]
    checked = {row[2] for row in rows if len(row) == 6 and row[5] != "0"}
    assert {"ext4": "e2fsprogs", "vfat": "dosfstools"}.keys() == checked
    assert {"e2fsprogs", "dosfstools"} <= set(packages)


def test_boot_that_fails_before_the_health_check_restarts() -> None:
    """Otherwise a tried version waits in an emergency shell, which no password opens, and does not go back."""
    words = text(f"{CARD}/cmdline.txt").split()
    assert {"rd.shell=0", "rd.emergency=reboot", "panic=10"} <= set(words)
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.read_string(text("systemd/image/emergency.conf"))
    assert unit["Service"]["ExecStart"].endswith("systemctl --force reboot'")
    assert "emergency.conf etc/systemd/system/emergency.service.d/" in text("systemd/image/release")


def test_programs_that_a_boot_calls_are_packages_of_the_card() -> None:
    """Defect 2: without qrencode and sshd the label and the only login are missing, and nothing fails."""
    packages = {*yaml.safe_load(text(f"{CARD}/layer/diffuscope.yaml"))["mmdebstrap"]["packages"], *THEIRS}
    for program, (package, caller) in PROGRAMS.items():
        assert program in text(caller), caller
        assert package in packages, program


def test_what_the_volatile_root_would_forget_is_on_the_data_partition() -> None:
    """Defects 9 and 16: networks, upload settings and the last known time were lost at every boot."""
    rows = [line.split() for line in text("systemd/image/fstab").splitlines() if line.startswith("/data/")]
    bound = {target: source for source, target, *_ in rows}
    assert bound["/etc/NetworkManager/system-connections"] == "/data/network"
    assert bound["/var/lib/systemd/timesync"] == "/data/timesync"
    assert all("bind" in row[3].split(",") for row in rows)
    made = re.findall(r"^MakeDirectories=(.*)", text("systemd/image/repart.conf"), re.M)[0].split()
    assert {source.removeprefix("/data") for source in bound.values()} <= set(made)
    places = re.findall(r'^mkdir -p "\$root"/{(.*)}', text("systemd/image/release"), re.M)[0].split(",")
    assert {target.removeprefix("/") for target in bound} <= set(places), "a bind mount needs its folder"
    links = re.findall(r"^L (\S+) .* (\S+)$", text("systemd/image/send.tmpfiles"), re.M)
    names = "send.env", "send.toml", "send.token", "send.crt"
    assert links == [(f"/etc/diffuscope/{name}", f"/data/send/{name}") for name in names]


def test_first_boot_may_take_longer_than_the_default_timeout_of_a_device() -> None:
    """/data appears only when systemd-repart has made it."""
    [row] = [line.split() for line in text("systemd/image/fstab").splitlines() if line.startswith("LABEL=data ")]
    assert "x-systemd.device-timeout=5min" in row[3].split(",")


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts need root")
@pytest.mark.parametrize("is_busy", [False, True])
def test_unfinished_root_is_not_removed_through_a_mount(tmp_path: Path, is_busy: bool) -> None:
    """An interrupted build leaves mounts; here a folder is mounted in a mount namespace, and a process may be in it."""
    machine, root = tmp_path / "machine", tmp_path / "a root"
    for folder in (machine, root / "dev"):
        folder.mkdir(parents=True)
    (machine / "null").touch()
    body = 'mount --bind "$1" "$2/dev"; [ "$3" = no ] || cd "$2/dev"; exec "$0" "$2"'
    words = ["sh", "-ec", body, ROOT / "systemd/image/discard", machine, root, "yes" if is_busy else "no"]
    done = subprocess.run(["unshare", "--mount", *words], capture_output=True, text=True, check=False)
    assert (machine / "null").exists()
    assert root.exists() is is_busy
    assert ("still mounted" in done.stderr) is is_busy, done.stderr
    assert done.returncode == is_busy


def test_layer_hooks_name_existing_scripts_and_variables() -> None:
    fields = metadata("layer/diffuscope.yaml")
    body = yaml.safe_load(text(f"{CARD}/layer/diffuscope.yaml"))
    assert body["mmdebstrap"]["packages"] == list(dict.fromkeys(body["mmdebstrap"]["packages"]))
    hooks = "\n".join(body["mmdebstrap"]["customize-hooks"])
    for script in re.findall(r"\$IGconf_diffuscope_checkout/(\S+)", hooks):
        assert (ROOT / script).stat().st_mode & 0o111, f"{script} is not there, or cannot be run"
    for variable in re.findall(r"\$IGconf_diffuscope_([a-z]+)", hooks):
        assert f"X-Env-Var-{variable}" in fields
    assert text("pyproject.toml").split('version = "')[1].startswith(fields["X-Env-Var-version"] + '"')


def test_configuration_names_existing_layers() -> None:
    named = yaml.safe_load(text(f"{CARD}/config/diffuscope.yaml"))
    layers = {named["device"]["layer"], named["image"]["layer"], *named["layer"].values()}
    assert layers <= {*LAYERS.values(), *THEIRS}
    assert f"image {named['image']['name']}.img {{" in text(f"{CARD}/image/genimage.cfg")


def test_config_txt_is_readable_and_enables_the_head() -> None:
    lines = text(f"{CARD}/config.txt").splitlines()
    for line in lines:
        assert len(line) <= 98, "the firmware reads no more of a line"
        assert re.fullmatch(r"|#.*|\[(all|boot_partition=\d)\]|[a-z0-9_]+=[\w=.,-]+", line), line
    assert lines[-1] == "[all]", "lines added at the end apply to all boards"
    wanted = {"spi=on", "i2c_arm=on", "strict_gpiod", "watchdog=on"}
    assert wanted <= {line.removeprefix("dtparam=") for line in lines}
    head = re.search(r"echo HEAD=(\w+) >", text(f"{CARD}/board"))
    assert head is not None
    spec = load_head(ROOT / f"hardware/heads/{head[1]}.toml")
    assert spec.camera.backend == "picamera2"
    assert f"dtoverlay={head[1]}" in lines
    assert "camera_auto_detect=0" in lines


def test_kernel_command_line_is_one_line() -> None:
    assert text(f"{CARD}/cmdline.txt").count("\n") == 1


def test_access_point_is_off_and_has_no_shared_password() -> None:
    """A released password would be the same on all devices; tests/systemd reads the file with NetworkManager."""
    profile = configparser.ConfigParser(interpolation=None)
    profile.read_string(text("systemd/image/access-point.nmconnection"))
    assert profile["wifi-security"]["psk"] == "@WIFI@"
    assert profile["wifi"]["ssid"] == "@NAME@"
    assert profile["wifi-security"]["key-mgmt"] == "wpa-psk"
    assert profile["connection"]["autoconnect"] == "false", "the page has no sign-in yet"
    assert profile["ipv4"]["address1"] == f"{ACCESS_POINT_ADDRESS}/24"


def test_country_of_the_settings_is_set_when_the_radio_appears() -> None:
    unit = configparser.ConfigParser(interpolation=None, delimiters="=", strict=False)
    unit.read_string(text("systemd/diffuscope-country.service"))
    written = f"/{OUTPUT}/country.env"
    assert unit["Unit"]["ConditionPathExists"] == unit["Service"]["EnvironmentFile"] == written
    assert unit["Unit"]["After"] == "diffuscope-identity.service", "which writes it"
    [rule] = [line for line in text("systemd/image/devices.rules").splitlines() if '"ieee80211"' in line]
    assert 'TAG+="systemd", ENV{SYSTEMD_WANTS}+="diffuscope-country.service"' in rule
    assert "cfg80211.ieee80211_regdom=IN" in text(f"{CARD}/cmdline.txt").split(), "without the key"


def test_avahi_host_name_is_in_the_certificate() -> None:
    conf = configparser.ConfigParser()
    conf.read_string(text("systemd/image/avahi-daemon.conf"))
    assert f"{conf['server']['host-name']}.local" == SHARED_HOST_NAMES[0]


def test_journal_size_is_limited() -> None:
    conf = configparser.ConfigParser()
    conf.optionxform = str  # type: ignore[assignment, method-assign]  # keys of systemd are case-sensitive
    conf.read_string(text("systemd/image/journald.conf"))
    assert conf["Journal"]["Storage"] == "persistent"
    assert int(conf["Journal"]["SystemMaxUse"].removesuffix("M")) <= 200


def test_every_file_beside_the_recipe_is_installed() -> None:
    """Files beside the release recipe must be used by it."""
    recipe = text("systemd/image/release")
    beside = {path.name for path in (ROOT / "systemd/image").iterdir() if path.is_file()}
    brought = {name for name in beside if f"$here/{name}" in recipe}
    tools = {
        "README.md",
        "base",
        "bundle",
        "discard",
        "install",
        "keys",
        "release",
        "requirements.lock",
        "sbom.py",
        "suite",
        "wheels",
    }
    assert beside - tools <= brought
    assert set(re.findall(r"systemctl.*enable (.*)", recipe)[0].split()) == {
        "diffuscope.service",
        "diffuscope-identity.service",
        "diffuscope-settle.service",
        "diffuscope-update.timer",
        "diffuscope-update-request.path",
        "diffuscope-clock.path",
        "diffuscope-certificate.timer",
        "diffuscope-network.socket",
        "diffuscope-pairing.socket",
    }
    assert Path(ROOT / "systemd/diffuscope-identity.service").exists()
