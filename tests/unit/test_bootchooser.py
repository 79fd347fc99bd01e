"""The boot chooser against a firmware that reads what it wrote: tried once, committed or back."""

import subprocess
import sys
from pathlib import Path

import pytest

from services.update.bootchooser import SECTOR_BYTES, BootChooser, main
from tests import firmware
from tests.house import ROOT


@pytest.fixture
def device(tmp_path: Path) -> BootChooser:
    """A device whose committed slot A runs."""
    return placed(tmp_path)


def placed(folder: Path) -> BootChooser:
    chooser = BootChooser(folder / "autoboot.txt", folder, folder / "reboot-param", folder / "cmdline")
    chooser.autoboot.write_text("[all]\ntryboot_a_b=1\nboot_partition=2\n[tryboot]\nboot_partition=3\n")
    chooser.command_line.write_text("console=tty1 root=/dev/x rauc.slot=A quiet\n")
    return chooser


def restart(device: BootChooser, orderly: bool = True) -> str:
    """What the firmware does: the word counts once, and only after an orderly restart."""
    trying = orderly and device.reboot_word.exists() and "tryboot" in device.reboot_word.read_text()
    device.reboot_word.unlink(missing_ok=True)
    slot = firmware.boots(device.autoboot.read_bytes(), trying)
    device.command_line.write_text(f"rauc.slot={slot}\n")
    return slot


def test_an_installed_slot_is_tried_once_and_then_the_committed_one_is_back(device: BootChooser) -> None:
    device.set_bad("B")
    assert not device.is_good("B")
    device.set_primary("B")
    assert (device.primary(), device.committed(), device.is_good("B")) == ("B", "A", True)
    assert restart(device) == "B"
    assert device.is_trying()
    assert restart(device) == "A"
    assert not device.is_trying()


def test_a_tried_slot_that_is_marked_good_is_the_committed_one_from_then_on(device: BootChooser) -> None:
    device.set_primary("B")
    restart(device)
    device.set_good("B")
    assert device.committed() == "B"
    assert [restart(device), restart(device, orderly=False)] == ["B", "B"]
    device.set_primary("A")
    assert restart(device) == "A"


def test_a_power_cut_before_the_restart_tries_nothing(device: BootChooser) -> None:
    device.set_primary("B")
    assert restart(device, orderly=False) == "A"


def test_nobody_overwrites_the_committed_slot(device: BootChooser, capsys: pytest.CaptureFixture[str]) -> None:
    """RAUC marks its target bad before it writes: in a slot that is being tried that target is the committed one."""
    device.set_primary("B")
    restart(device)
    assert main(["set-state", "A", "bad"], device) == 254
    assert "the committed one" in capsys.readouterr().err
    assert device.is_good("A")


def test_the_committed_slot_is_chosen_by_taking_the_try_back(device: BootChooser) -> None:
    device.set_primary("B")
    device.set_primary("A")
    assert restart(device) == "A"


def test_rauc_and_systemd_are_answered(device: BootChooser, capsys: pytest.CaptureFixture[str]) -> None:
    said = [main(words.split(), device) for words in ("get-primary", "get-state B", "set-state B bad", "get-state B")]
    assert (said, capsys.readouterr().out.split()) == ([0, 0, 0, 0], ["A", "good", "bad"])
    assert main(["trying"], device) == 1
    assert main(["set-primary", "B"], device) == 0
    restart(device)
    assert main(["trying"], device) == 0
    assert main(["set-primary", "C"], device) == 254


def test_a_commit_changes_two_bytes_of_one_sector_and_nothing_else_on_that_disk(device: BootChooser) -> None:
    """So that whatever a power cut leaves names a slot: even of a sector that is torn between its bytes."""
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


def test_what_a_technician_wrote_into_the_choice_stays(device: BootChooser) -> None:
    said = "# two slots\r\n[all]\r\ntryboot_a_b=1\r\nboot_partition=2\r\n# the other\r\n[tryboot]\r\nboot_partition=3"
    device.autoboot.write_bytes(said.encode())
    device.command_line.write_text("rauc.slot=B\n")
    device.set_good("B")
    assert device.autoboot.read_bytes().decode() == said.replace("=2", "=x").replace("=3", "=2").replace("=x", "=3")


UNREADABLE = [
    "", "[all]\n", "[all]\nboot_partition=7\n", "[all]\nboot_partition=x\n", "[all]\nboot_partition=2\n",
    f"#{'x' * SECTOR_BYTES}\n[all]\nboot_partition=2\n[tryboot]\nboot_partition=3\n",
]  # fmt: skip


@pytest.mark.parametrize("content", UNREADABLE)
def test_an_unreadable_choice_is_said_and_not_guessed(
    device: BootChooser, content: str, capsys: pytest.CaptureFixture[str]
) -> None:
    device.autoboot.write_text(content)
    assert main(["get-primary"], device) == 254
    assert "autoboot.txt" in capsys.readouterr().err


def test_it_runs_by_itself_with_nothing_but_the_standard_library() -> None:
    """Where no kernel was told, it says so, and ends with a status that systemd takes for a failed condition."""
    words = [sys.executable, "-I", "-S", str(ROOT / "services" / "update" / "bootchooser.py"), "trying"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (254, "")
    assert "rauc.slot" in done.stderr
