"""Boot chooser and an emulated firmware that reads its files: a slot is tried once, then committed or rolled back."""

import subprocess
import sys
from pathlib import Path

import pytest

from services.update.bootchooser import SECTOR_BYTES, BootChooser, main
from tests import firmware
from tests.project_files import ROOT


@pytest.fixture
def device(tmp_path: Path) -> BootChooser:
    """A device that runs the committed slot A."""
    return new_chooser(tmp_path)


def new_chooser(folder: Path) -> BootChooser:
    chooser = BootChooser(folder / "autoboot.txt", folder, folder / "reboot-param", folder / "cmdline")
    chooser.autoboot.write_text("[all]\ntryboot_a_b=1\nboot_partition=2\n[tryboot]\nboot_partition=3\n")
    chooser.command_line.write_text("console=tty1 root=/dev/x rauc.slot=A quiet\n")
    return chooser


def restart(device: BootChooser, orderly: bool = True) -> str:
    """Return the slot that the firmware boots: the reboot argument counts once, after an orderly restart."""
    trying = orderly and device.reboot_argument.exists() and "tryboot" in device.reboot_argument.read_text()
    device.reboot_argument.unlink(missing_ok=True)
    slot = firmware.boots(device.autoboot.read_bytes(), trying)
    device.command_line.write_text(f"rauc.slot={slot}\n")
    return slot


def test_installed_slot_is_tried_once_then_the_committed_slot_boots(device: BootChooser) -> None:
    device.set_bad("B")
    assert not device.is_good("B")
    device.set_primary("B")
    assert (device.primary(), device.committed(), device.is_good("B")) == ("B", "A", True)
    assert restart(device) == "B"
    assert device.is_trying()
    assert restart(device) == "A"
    assert not device.is_trying()


def test_tried_slot_marked_good_is_committed(device: BootChooser) -> None:
    device.set_primary("B")
    restart(device)
    device.set_good("B")
    assert device.committed() == "B"
    assert [restart(device), restart(device, orderly=False)] == ["B", "B"]
    device.set_primary("A")
    assert restart(device) == "A"


def test_power_cut_before_the_restart_boots_the_committed_slot(device: BootChooser) -> None:
    device.set_primary("B")
    assert restart(device, orderly=False) == "A"


def test_committed_slot_cannot_be_marked_bad(device: BootChooser, capsys: pytest.CaptureFixture[str]) -> None:
    """RAUC marks its target bad before it writes; during a try that target is the committed slot."""
    device.set_primary("B")
    restart(device)
    assert main(["set-state", "A", "bad"], device) == 254
    assert "the committed one" in capsys.readouterr().err
    assert device.is_good("A")


def test_selecting_the_committed_slot_cancels_the_try(device: BootChooser) -> None:
    device.set_primary("B")
    device.set_primary("A")
    assert restart(device) == "A"


def test_commands_of_rauc_and_systemd_are_answered(device: BootChooser, capsys: pytest.CaptureFixture[str]) -> None:
    statuses = [
        main(words.split(), device) for words in ("get-primary", "get-state B", "set-state B bad", "get-state B")
    ]
    assert (statuses, capsys.readouterr().out.split()) == ([0, 0, 0, 0], ["A", "good", "bad"])
    assert main(["trying"], device) == 1
    assert main(["set-primary", "B"], device) == 0
    restart(device)
    assert main(["trying"], device) == 0
    assert main(["set-primary", "C"], device) == 254


def test_commit_changes_two_bytes_of_one_sector_in_place(device: BootChooser) -> None:
    """After a power cut the file names a working slot, also if the sector is torn between its bytes."""
    before, inode = device.autoboot.read_bytes(), device.autoboot.stat().st_ino
    device.set_primary("B")
    restart(device)
    device.set_good("B")
    after = device.autoboot.read_bytes()
    assert (device.autoboot.stat().st_ino, len(after)) == (inode, len(before))
    places = [at for at, (old, new) in enumerate(zip(before, after, strict=True)) if old != new]
    assert len(places) == 2
    for some in ((), places[:1], places[1:], places):
        torn = bytearray(before)
        for at in some:
            torn[at] = after[at]
        assert firmware.partition(bytes(torn)) == (3 if places[0] in some else 2)
        assert firmware.partition(bytes(torn), tried=True) in (2, 3)
        device.autoboot.write_bytes(torn)
        assert device.committed() == firmware.boots(bytes(torn))


def test_other_lines_of_autoboot_txt_stay(device: BootChooser) -> None:
    content = (
        "# two slots\r\n[all]\r\ntryboot_a_b=1\r\nboot_partition=2\r\n# the other\r\n[tryboot]\r\nboot_partition=3"
    )
    device.autoboot.write_bytes(content.encode())
    device.command_line.write_text("rauc.slot=B\n")
    device.set_good("B")
    assert device.autoboot.read_bytes().decode() == content.replace("=2", "=x").replace("=3", "=2").replace("=x", "=3")


UNREADABLE = [
    "",
    "[all]\n",
    "[all]\nboot_partition=7\n",
    "[all]\nboot_partition=x\n",
    "[all]\nboot_partition=2\n",
    f"#{'x' * SECTOR_BYTES}\n[all]\nboot_partition=2\n[tryboot]\nboot_partition=3\n",
]


@pytest.mark.parametrize("content", UNREADABLE)
def test_invalid_autoboot_txt_is_an_error(
    device: BootChooser, content: str, capsys: pytest.CaptureFixture[str]
) -> None:
    device.autoboot.write_text(content)
    assert main(["get-primary"], device) == 254
    assert "autoboot.txt" in capsys.readouterr().err


def test_boot_chooser_runs_with_the_standard_library_only() -> None:
    """Without `rauc.slot=` it prints an error and ends with a status that systemd treats as a failed condition."""
    words = [sys.executable, "-I", "-S", str(ROOT / "services" / "update" / "bootchooser.py"), "trying"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (254, "")
    assert "rauc.slot" in done.stderr
