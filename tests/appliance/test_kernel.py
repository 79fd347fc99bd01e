"""Mount, udev, module and device rules of the image against Debian's kernels; no boot."""

import re
from pathlib import Path

import pytest

from tests.debian_kernel import CONFIG, DEVICES, FILE_SYSTEMS, LACKS, MODULES, SUBSYSTEMS
from tests.project_files import ROOT

pytestmark = [pytest.mark.systemd, pytest.mark.parametrize("arch", sorted(CONFIG))]

IMAGE = ROOT / "systemd/image"


def lines(path: Path) -> list[str]:
    """Return the lines of a configuration file without comments and empty lines."""
    return [line for line in path.read_text().splitlines() if line and not line.startswith("#")]


def has(arch: str, option: str) -> bool:
    """Return whether the kernel has the option, or is known to lack it."""
    return CONFIG[arch][option] in "ym" or option in LACKS[arch]


def test_kernel_mounts_every_file_system_of_card_and_drives(arch: str) -> None:
    types = {line.split()[2] for line in lines(IMAGE / "fstab")} - {"none"}
    types |= set(re.findall(r'ID_FS_TYPE}=="([\w|]+)"', (IMAGE / "stick.rules").read_text())[0].split("|"))
    types |= set(re.findall(r"rootfstype=(\w+)", (IMAGE / "card/cmdline.txt").read_text()))
    types |= set(re.findall(r"systemd.volatile=(\w+)", (IMAGE / "card/cmdline.txt").read_text()))
    types |= set(re.findall(r"^Format=(\w+)", (IMAGE / "repart.conf").read_text(), re.M))
    assert types == FILE_SYSTEMS.keys()
    for name in types:
        assert has(arch, FILE_SYSTEMS[name]), name
    assert CONFIG[arch]["SQUASHFS_ZSTD"] == "y"
    assert {CONFIG[arch][name] for name in ("NLS_ASCII", "NLS_CODEPAGE_437")} <= {"y", "m"}, "names on FAT"


def test_kernel_has_every_subsystem_and_device_of_the_rules(arch: str) -> None:
    subsystems = set(re.findall(r'SUBSYSTEM=="([\w-]+)"', "\n".join(lines(IMAGE / "devices.rules"))))
    assert subsystems == SUBSYSTEMS.keys()
    devices = set(re.findall(r"DeviceAllow=char-(\w+) rw", (ROOT / "systemd/diffuscope.service").read_text()))
    assert devices == DEVICES.keys()
    for option in [*SUBSYSTEMS.values(), *DEVICES.values()]:
        assert has(arch, option), option


def test_kernel_has_every_module_that_is_loaded_at_boot(arch: str) -> None:
    names = lines(IMAGE / "modules-load.conf")
    assert set(names) == MODULES.keys()
    for name in names:
        assert has(arch, MODULES[name]), name


def test_kernel_has_what_bundles_and_the_encrypted_data_partition_need(arch: str) -> None:
    for option in ("BLK_DEV_LOOP", "DM_VERITY", "DM_CRYPT", "USB_STORAGE", "MMC_SDHCI"):
        assert has(arch, option), option
