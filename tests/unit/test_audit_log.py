"""Audit log: entries are chained, and every edit, deletion, truncation and swap is found."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from device.clock import VirtualClock
from services import cli
from services.errors import StoreDamaged
from services.identity.audit_key import FILES, load_or_create_audit_key, read_audit_key
from services.records.audit_log import HEAD, LOG, TAIL_BYTES, AuditFinding, AuditLog

TRIALS = 1000
KEY = bytes(range(32))
Damage = Callable[[Path, random.Random], None]


def filled(folder: Path, entries: int = 30) -> AuditLog:
    folder.mkdir(exist_ok=True)
    log = AuditLog(folder, KEY, VirtualClock())
    for number in range(entries):
        log.append(
            ("Asha", "Ravi")[number % 2], ("view", "answer")[number % 3 == 0], f"visit-{number % 5}", field="age"
        )
    return log


def test_two_processes_continue_one_chain(tmp_path: Path) -> None:
    running, command = filled(tmp_path), AuditLog(tmp_path, KEY, VirtualClock())
    for log in (command, running, command, command, running):
        log.append("Asha", "view", "visit-1")
    assert running.check() == AuditFinding(35, None)


def edit(folder: Path, chance: random.Random) -> None:
    """Change one bit of the log or of the head."""
    path = folder / chance.choice((LOG, LOG, LOG, HEAD))
    content = bytearray(path.read_bytes())
    content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    path.write_bytes(content)


def leave_out(folder: Path, chance: random.Random) -> None:
    lines = (folder / LOG).read_bytes().splitlines(keepends=True)
    del lines[chance.randrange(len(lines))]
    (folder / LOG).write_bytes(b"".join(lines))


def cut(folder: Path, chance: random.Random) -> None:
    content = (folder / LOG).read_bytes()
    (folder / LOG).write_bytes(content[: chance.randrange(len(content))])


def swap(folder: Path, chance: random.Random) -> None:
    lines = (folder / LOG).read_bytes().splitlines(keepends=True)
    one, other = chance.sample(range(len(lines)), 2)
    lines[one], lines[other] = lines[other], lines[one]
    (folder / LOG).write_bytes(b"".join(lines))


def repeat(folder: Path, chance: random.Random) -> None:
    lines = (folder / LOG).read_bytes().splitlines(keepends=True)
    lines.insert(chance.randrange(len(lines) + 1), chance.choice(lines))
    (folder / LOG).write_bytes(b"".join(lines))


def forge(folder: Path, chance: random.Random) -> None:
    """Append entries that another key has signed."""
    foreign = AuditLog(folder, KEY[::-1], VirtualClock())
    for _ in range(chance.randrange(1, 4)):
        foreign.append("Eve", "view", "visit-1")


DAMAGES: tuple[Damage, ...] = (edit, edit, leave_out, cut, swap, repeat, forge)


def test_every_damage_of_a_thousand_is_found(tmp_path: Path) -> None:
    whole = filled(tmp_path / "whole")
    assert whole.check().problem is None
    missed = []
    for seed in range(TRIALS):
        folder = tmp_path / "damaged"
        shutil.copytree(tmp_path / "whole", folder)
        chance = random.Random(seed)
        damage = chance.choice(DAMAGES)
        damage(folder, chance)
        if AuditLog(folder, KEY, VirtualClock()).check().problem is None:
            missed.append((seed, damage.__name__))
        shutil.rmtree(folder)
    assert missed == []


def test_a_gap_stays_visible_after_further_entries(tmp_path: Path) -> None:
    filled(tmp_path)
    lines = (tmp_path / LOG).read_bytes().splitlines(keepends=True)
    (tmp_path / LOG).write_bytes(b"".join(lines[:20]))
    later = AuditLog(tmp_path, KEY, VirtualClock())
    later.append("Asha", "view", "visit-1")
    assert later.check().problem is not None
    assert later.entries(1)[0].number == 31


def test_the_newest_entries_are_listed_and_checked_without_the_rest(tmp_path: Path) -> None:
    log = filled(tmp_path, 60)
    content = (tmp_path / LOG).read_bytes()
    part = len(content) // 2
    assert log.check(2 * part + 9) == log.check() == AuditFinding(60, None)
    checked = log.check(part)
    assert checked.problem is None
    assert 25 < checked.entries < 31
    lines = content.splitlines(keepends=True)
    for number in (5, 50):
        (tmp_path / LOG).write_bytes(b"".join(lines[:number]) + b"\n" + b"".join(lines[number:]))
        assert log.check().entries == number
        assert (log.check(part).problem is None) is (number == 5), "an early change is found by the whole check"


def test_a_list_and_a_start_read_a_part_of_a_long_log(tmp_path: Path) -> None:
    filled(tmp_path, 20)
    line = (tmp_path / LOG).read_bytes().splitlines(keepends=True)[-1]
    with open(tmp_path / LOG, "r+b") as file:
        file.seek(3_000_000_000)  # a hole: more than may be read
        file.write(b"\n" + line)
    log = AuditLog(tmp_path, KEY, VirtualClock())
    log.append("Asha", "sign-in")
    assert [entry.number for entry in log.entries(3)] == [21, 20]
    assert log.check(TAIL_BYTES) == AuditFinding(1, None)


def test_archived_entries_are_in_the_file_and_the_chain_goes_on(tmp_path: Path) -> None:
    log = filled(tmp_path / "store")
    content = (tmp_path / "store" / LOG).read_bytes()
    assert log.archive(tmp_path / "old") == 30
    assert (tmp_path / "old").read_bytes() == content
    for again in (log, AuditLog(tmp_path / "store", KEY, VirtualClock())):
        again.append("Asha", "sign-in")
        assert again.check().problem is None
    assert [entry.number for entry in log.entries(9)] == [32, 31]
    (tmp_path / "store" / LOG).write_bytes(content + (tmp_path / "store" / LOG).read_bytes())
    assert log.check().problem is not None, "what is archived does not come back"
    with pytest.raises(StoreDamaged, match="not as it was written"):
        log.archive(tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_a_power_cut_while_entries_are_archived_loses_none(tmp_path: Path) -> None:
    log = filled(tmp_path)
    content = (tmp_path / LOG).read_bytes()
    log.archive(tmp_path / "old")
    (tmp_path / LOG).write_bytes(content)  # the head is written, and the log is as before
    restarted = AuditLog(tmp_path, KEY, VirtualClock())
    restarted.append("Asha", "sign-in")
    assert restarted.check() == AuditFinding(1, None)


def test_a_power_cut_between_an_entry_and_its_head_or_within_a_line_is_no_damage(tmp_path: Path) -> None:
    log = filled(tmp_path)
    head, content = (tmp_path / HEAD).read_bytes(), (tmp_path / LOG).read_bytes()
    log.append("Asha", "view", "visit-1")
    (tmp_path / HEAD).write_bytes(head)
    assert AuditLog(tmp_path, KEY, VirtualClock()).check() == log.check()
    assert log.check().problem is None
    (tmp_path / LOG).write_bytes(content + b'{"number": 31, "at"')
    restarted = AuditLog(tmp_path, KEY, VirtualClock())
    restarted.append("Asha", "view", "visit-1")
    assert restarted.check().problem is None
    assert restarted.check().entries == 31


def test_entries_are_filtered_newest_first_and_hold_no_long_text(tmp_path: Path) -> None:
    log = filled(tmp_path)
    assert [entry.number for entry in log.entries(3)] == [30, 29, 28]
    assert {entry.user for entry in log.entries(100, user="Ravi")} == {"Ravi"}
    assert [entry.number for entry in log.entries(100, action="answer", record="visit-0")] == [16, 1]
    log.append("x" * 1000, "view", "y" * 1000, field="z" * 1000)
    assert len((tmp_path / LOG).read_bytes().splitlines()[-1]) < 1000


def test_a_log_without_its_key_is_damaged_and_the_key_is_made_once(tmp_path: Path) -> None:
    key = load_or_create_audit_key(tmp_path)
    assert load_or_create_audit_key(tmp_path) == read_audit_key(tmp_path) == key
    AuditLog(tmp_path, key, VirtualClock()).append("Asha", "view")
    for path in (copies := [tmp_path / "access" / name for name in FILES]):
        whole = path.read_bytes()
        for damaged in (whole[:-1], whole.replace(b"a", b"b"), b""):
            path.write_bytes(damaged)
            assert read_audit_key(tmp_path) == key, "the other copy is enough"
            assert load_or_create_audit_key(tmp_path) == key
            assert path.read_bytes() == whole, "the copy is written again"
    for path in copies:
        path.write_bytes(b"")
    with pytest.raises(StoreDamaged, match="damaged"):
        load_or_create_audit_key(tmp_path)
    for path in copies:
        path.unlink()
    with pytest.raises(StoreDamaged, match="missing"):
        load_or_create_audit_key(tmp_path)


def test_the_command_verifies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    AuditLog(tmp_path, load_or_create_audit_key(tmp_path), VirtualClock()).append("Asha", "view")

    def verified() -> tuple[object, str]:
        with pytest.raises(SystemExit) as ended:
            cli.main(["audit", "verify", "--data", str(tmp_path)])
        return ended.value.code, capsys.readouterr().out

    assert verified() == (0, "1 entries are as they were written.\n")
    (tmp_path / LOG).write_bytes(b"")
    code, shown = verified()
    assert (code, "there are 0 entries, and there were 1" in shown) == (1, True)
