"""Card, units, presets and wheels against the facts of Raspberry Pi's software in tests/raspberry_pi.py."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from device.config.head_file import load_head
from device.config.sensors import known_sensors
from device.drivers.raw_counts import black_dn
from tests import raspberry_pi
from tests.project_files import ROOT, text

IMAGE = "systemd/image"
BUILT_FOR_ANOTHER_NUMPY = 'raise ValueError("numpy.dtype size changed, may indicate binary incompatibility")\n'
# Runs what changes the test's own files only: lines of config.txt and modules-load.d.
SUDO = """\
#!/bin/sh
echo "$@" >>{log}
case "$*" in
"tee -a {config}") exec "$@" ;;
"tee "*) exec cat ;;
esac
"""
OPEN_ALL = """\
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from device.config.head_file import load_head
from device.drivers.chips import I2cBus
from device.drivers.gpio import OutputLine
from device.drivers.pi_camera import PiCamera
from device.drivers.ring import Apa102Ring
from device.errors import HardwareError
spec = load_head(Path(sys.argv[2]))
for driver, arguments in ((PiCamera, (spec.camera, None)), (Apa102Ring, (spec.light.chain, None, 1.0)),
                          (I2cBus, ("/dev/i2c-1",)), (OutputLine, ("/dev/gpiochip0", 17))):
    try:
        driver(*arguments)
    except HardwareError as error:
        print(error.code, "size changed" in error.message, bool(error.remedy))
"""


def settings(name: str) -> list[str]:
    """Return the lines of a configuration file without comments and empty lines."""
    return [line for line in text(name).splitlines() if line and not line.startswith("#")]


def test_every_squashfs_is_compressed_as_the_kernel_reads() -> None:
    """Defect 1: a root of lz4 is never mounted."""
    known = {
        option.removeprefix("SQUASHFS_").lower() for option in raspberry_pi.KERNEL if option.startswith("SQUASHFS_")
    }
    card = re.search(r'compression = "(\w+)"', text(f"{IMAGE}/card/image/genimage.cfg"))
    bundle = re.search(r"-comp (\w+)", text(f"{IMAGE}/bundle"))
    for found in (card, bundle):
        assert found is not None
        assert found[1] in known - {"xattr"}
    assert "SQUASHFS_LZ4" in raspberry_pi.KERNEL_LACKS


def test_bundles_overlay_and_encryption_find_their_drivers() -> None:
    """`format=verity` and its loop device, the overlay over the root, FAT and exFAT drives, LUKS2 on ext4."""
    needed = "DM_VERITY", "BLK_DEV_LOOP", "OVERLAY_FS", "SQUASHFS", "VFAT_FS", "EXFAT_FS", "DM_CRYPT", "EXT4_FS"
    assert set(needed) <= set(raspberry_pi.KERNEL)


def test_modules_behind_device_nodes_are_loaded_at_boot() -> None:
    """Defect 4: dtparam=i2c_arm=on gives a bus and no /dev/i2c-1."""
    loaded = settings(f"{IMAGE}/modules-load.conf")
    assert loaded == [name for option, name in raspberry_pi.MODULES.items() if raspberry_pi.KERNEL[option] == "m"]


def test_every_group_of_the_instrument_owns_its_device_nodes() -> None:
    """Defect 3: no rule of Debian gives SPI, I2C, GPIO or frame memory to a group."""
    rules = "\n".join(settings(f"{IMAGE}/devices.rules"))
    found = dict(re.findall(r'SUBSYSTEM=="([\w-]+)".*GROUP="(\w+)", MODE="0660"', rules))
    assert found == raspberry_pi.GROUPS
    unit = text("systemd/diffuscope.service")
    members = set(re.findall(r"SupplementaryGroups=(.*)", unit)[0].split())
    assert {*found.values(), *raspberry_pi.DEBIAN_GROUPS.values()} <= members
    allowed = set(re.findall(r"DeviceAllow=char-(\w+) rw", unit))
    assert allowed == {"spi", "i2c", "gpiochip", "video4linux", "media", "dma_heap"}


def test_the_led_bus_starts_the_blanker() -> None:
    """Defect 7: the bus is a module, so it appears after systemd-udev-trigger.service has ended."""
    assert raspberry_pi.KERNEL["SPI_DW_MMIO"] == raspberry_pi.KERNEL["SPI_SPIDEV"] == "m"
    [rule] = [line for line in settings(f"{IMAGE}/devices.rules") if '"spidev"' in line]
    assert 'TAG+="systemd"' in rule
    assert 'ENV{SYSTEMD_WANTS}+="diffuscope-blank.service"' in rule


def test_the_clock_cell_of_the_parts_list_is_charged() -> None:
    """Defect 9: the board keeps the time while it is off only with a cell, which it does not charge by itself."""
    [cell] = [line for line in text("hardware/parts.csv").splitlines() if "clock cell" in line]
    assert "rechargeable" in cell
    assert f"dtparam=rtc_bbat_vchg={raspberry_pi.CLOCK_CELL_UV}" in settings(f"{IMAGE}/card/config.txt")


def test_presets_have_the_black_level_of_libcamera() -> None:
    """Defect 13: the driver refuses a head file whose black level is half or twice that of libcamera."""
    for name, level in raspberry_pi.BLACK_LEVELS.items():
        sensor = known_sensors()[name]
        if name == "imx296":  # the preset has the 12 bits of the data sheet; Raspberry Pi's driver gives 10 of them
            camera = load_head(ROOT / "hardware/heads/imx296.toml").camera
            assert camera.black_dn == black_dn(level, camera.bit_depth)
        else:
            assert sensor.black_dn == black_dn(level, sensor.bit_depth), name


def test_presets_that_libcamera_does_not_know_say_so() -> None:
    for name in known_sensors().keys() - raspberry_pi.BLACK_LEVELS.keys() - {"quantalux"}:
        assert "through V4L2 only" in text(f"device/config/sensor_presets/{name}.toml")


def test_libraries_of_the_drivers_are_wheels_of_the_image_or_packages_of_the_card() -> None:
    """Defects 5 and 6: Debian's gpiod may be version 1, and its simplejpeg is built for another numpy."""
    locked = set(re.findall(r"^([\w-]+)==", text(f"{IMAGE}/requirements.lock"), re.M))
    assert {"gpiod", "smbus2", "simplejpeg"} <= locked
    layer = settings(f"{IMAGE}/card/layer/diffuscope.yaml")
    packages = {line.strip().removeprefix("- ") for line in layer}
    assert {"python3-libcamera", "python3-picamera2", "python3-spidev"} <= packages
    assert not {"python3-smbus2", "python3-libgpiod"} & packages


def test_any_failure_of_an_import_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    """Defect 5: a compiled part for another numpy raises ValueError, not ImportError."""
    for name in ("picamera2", "spidev", "smbus2", "gpiod"):
        (tmp_path / f"{name}.py").write_text(BUILT_FOR_ANOTHER_NUMPY)
    words = [sys.executable, "-c", OPEN_ALL, str(tmp_path), str(ROOT / "hardware/heads/imx296.toml")]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT)
    codes = ["camera.missing", "light.fault", "bus.fault", "bus.fault"]
    assert done.stdout.splitlines() == [f"{code} True True" for code in codes]


def test_make_pi_gives_the_environment_the_camera_of_raspberry_pi_os(tmp_path: Path) -> None:
    """Defect 14: the recipe itself, with a stand-in for sudo; .venv did not see Debian's libcamera."""
    venv, config, log = tmp_path / "venv", tmp_path / "config.txt", tmp_path / "log"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
    config.write_text("dtparam=spi=on\n")
    (venv / "bin/sudo").write_text(SUDO.format(log=log, config=config))
    (venv / "bin/pip").write_text("#!/bin/sh\n")
    for name in ("sudo", "pip"):
        (venv / "bin" / name).chmod(0o755)
    path = f"{venv / 'bin'}:{os.environ['PATH']}"
    for _ in range(2):  # a second run adds no line twice
        words = ["make", "pi", "MAKE=true", f"BIN={venv / 'bin'}", f"PI_CONFIG={config}"]
        subprocess.run(words, cwd=ROOT, env=os.environ | {"PATH": path}, check=True, capture_output=True)
    [site] = venv.glob("lib/python3.*/site-packages")
    assert (site / "debian.pth").read_text() == "/usr/lib/python3/dist-packages\n"
    assert "python3-picamera2 python3-libcamera" in log.read_text()
    assert "\nmake pi " in text("systemd/README.md"), "the installation without a card"
    assert sorted(config.read_text().split()) == ["dtparam=i2c_arm=on", "dtparam=spi=on", "dtparam=strict_gpiod"]


def test_every_part_of_the_image_names_one_debian_and_one_python() -> None:
    """`suite` is the source; the layers of rpi-image-gen cannot read it."""
    suite = dict(line.split("=") for line in settings(f"{IMAGE}/suite"))
    assert suite == {"suite": "trixie", "python": "3.13"}
    requires = re.search(r"Layer-Requires: (.*)", text(f"{IMAGE}/card/layer/diffuscope.yaml"))
    assert requires is not None
    assert {f"debian-{suite['suite']}-arm64-multi", f"rpi-debian-{suite['suite']}"} <= set(requires[1].split(","))
    for name in (f"{IMAGE}/base", f"{IMAGE}/wheels", f"{IMAGE}/release", f"{IMAGE}/card/board", "tests/arm64/run"):
        assert "bookworm" not in text(name), name
        assert not re.search(r"python3?[.=]?3?\.\d+", text(name).replace("$python", "")), name
        assert re.search(r"^\. .*suite$", text(name), re.M), name
    assert {"systemd-repart", "systemd-cryptsetup", "systemd-timesyncd"} <= {
        line.strip().removeprefix("- ") for line in settings(f"{IMAGE}/card/layer/diffuscope.yaml")
    }, "packages of their own since trixie"


def test_the_disk_key_never_leaves_the_firmware() -> None:
    """Defect 11: rpi-otp-private-key is not on the card; rpi-eeprom issue 814 advises against its use."""
    unit = text(f"{IMAGE}/card/luks/diffuscope-key.service")
    assert "rpi-fw-crypto hmac" in unit
    assert "rpi-otp-private-key" not in unit
    assert "lock_device_private_key=1" in settings(f"{IMAGE}/card/config.txt")
    assert "    - rpifwcrypto" in settings(f"{IMAGE}/card/layer/diffuscope.yaml")


@pytest.mark.parametrize("status", [0, 3])
def test_a_board_without_a_key_gets_no_data_partition(tmp_path: Path, status: int) -> None:
    """The unit's own command, with a stand-in for the firmware's program."""
    (tmp_path / "rpi-fw-crypto").write_text(
        f"#!/bin/sh\ncat >{tmp_path}/message\n[ {status} = 0 ] && echo cafe\nexit {status}\n"
    )
    (tmp_path / "rpi-fw-crypto").chmod(0o755)
    command = re.search(r"^ExecStart=/bin/sh -ec '(.*)'$", text(f"{IMAGE}/card/luks/diffuscope-key.service"), re.M)
    assert command is not None
    here = command[1].replace("/run/", f"{tmp_path}/").replace("rpi-fw-crypto", f"{tmp_path}/rpi-fw-crypto")
    done = subprocess.run(["/bin/sh", "-ec", here], capture_output=True, check=False)
    assert (done.returncode == 0) == (status == 0)
    assert (tmp_path / "diffuscope-key").exists() == (status == 0)
    assert (tmp_path / "message").read_text() == "diffuscope-data"
