"""What page and updater tell one another: everything that the other side may write, and what is made of it."""

import json
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.errors import UpdateNotUnderstood
from services.records.update_notes import (
    JOURNAL,
    MOST_WISH_BYTES,
    WISH,
    Entry,
    Found,
    Trouble,
    Wish,
    leave,
    read_entry,
    stage,
    take,
    this_boot,
    write_entry,
)  # fmt: skip

FOUND = Found(id="0123456789abcdef", where="stick", stick="A", name="two.raucb", bytes=7, version="2.0")
WHOLE = Entry(state="went back", version="2.0", trouble=Trouble(code="a", message="b", remedy="c"), found=(FOUND,))


def test_a_journal_is_read_as_it_was_written_by_everybody(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        write_entry(tmp_path, WHOLE)
    finally:
        os.umask(before)
    assert read_entry(tmp_path) == WHOLE
    assert (tmp_path / JOURNAL).stat().st_mode & 0o777 == 0o644
    assert [path.name for path in tmp_path.iterdir()] == [JOURNAL]


def test_a_journal_of_a_later_release_that_says_more_is_read(tmp_path: Path) -> None:
    """The version before reads it after an update was taken back."""
    said = WHOLE.model_dump() | {"mood": "good"}
    (tmp_path / JOURNAL).write_text(json.dumps(said))
    assert read_entry(tmp_path) == WHOLE


@pytest.mark.parametrize(
    "said",
    [
        "", "{", "[]", "null", '{"form": 2}', '{"state": "on fire"}', '{"share": 7}', '{"share": "NaN"}',
        '{"found": [{"id": "../../etc/passwd", "where": "stick", "bytes": 1}]}', json.dumps({"version": "x" * 70_000}),
        WHOLE.model_dump_json()[:-9],
    ],
)  # fmt: skip
def test_a_journal_that_cannot_be_read_counts_as_none(tmp_path: Path, said: str) -> None:
    (tmp_path / JOURNAL).write_text(said)
    assert read_entry(tmp_path) == Entry()


@pytest.mark.parametrize("wish", [Wish(do="check"), Wish(do="restart"), Wish(do="install", id="0123456789abcdef")])
def test_a_wish_is_taken_once(tmp_path: Path, wish: Wish) -> None:
    leave(tmp_path, wish)
    assert take(tmp_path) == wish
    assert take(tmp_path) is None
    assert list(tmp_path.iterdir()) == []


HOSTILE = [
    "", "{", "[]", '{"do": "check"', '{"do": "check", "form": 2}', '{"do": "reboot"}', '{"do": "install"}',
    '{"do": "check", "id": "0123456789abcdef"}', '{"do": "install", "id": "../../../etc/shadow"}',
    '{"do": "install", "id": "/media/STICK/two.raucb"}', '{"do": "install", "id": "0123456789ABCDEF"}',
    '{"do": "install", "id": "0123456789abcdef\\n"}', '{"do": "check", "path": "/etc/shadow"}', "\x00" * 10,
    json.dumps({"do": "check"}) + " " * MOST_WISH_BYTES,
]  # fmt: skip


@pytest.mark.parametrize("said", HOSTILE)
def test_what_is_no_wish_is_refused_and_gone(tmp_path: Path, said: str) -> None:
    (tmp_path / WISH).write_text(said)
    with pytest.raises(UpdateNotUnderstood) as caught:
        take(tmp_path)
    assert "look for updates" in caught.value.remedy
    assert take(tmp_path) is None


@given(st.binary(max_size=200))
def test_no_bytes_break_the_updater(tmp_path_factory: pytest.TempPathFactory, said: bytes) -> None:
    folder = tmp_path_factory.mktemp("wishes")
    (folder / WISH).write_bytes(said)
    with pytest.raises(UpdateNotUnderstood):
        take(folder)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_what_is_no_plain_file_is_not_followed(tmp_path: Path, kind: str) -> None:
    """The folder belongs to a process that has no rights; what reads it has all of them."""
    secret, wish = tmp_path / "secret", tmp_path / "wishes" / WISH
    secret.write_text(Wish(do="check").model_dump_json())
    wish.parent.mkdir()
    {"link": lambda: wish.symlink_to(secret), "pipe": lambda: os.mkfifo(wish), "folder": wish.mkdir}[kind]()
    with pytest.raises(UpdateNotUnderstood):
        take(wish.parent)
    assert secret.exists()
    assert wish.exists() == (kind == "folder")


def test_a_half_written_wish_is_not_seen(tmp_path: Path) -> None:
    (tmp_path / f".{WISH}.part").write_text('{"do": "ins')
    assert take(tmp_path) is None
    leave(tmp_path, Wish(do="check"))
    assert take(tmp_path) == Wish(do="check")


@pytest.mark.parametrize(
    ("state", "version", "same", "told"),
    [
        ("none", "", True, "none"),
        ("looking", "", True, "looking"),
        ("looking", "", False, "none"),
        ("fetching", "", True, "fetching"),
        ("installing", "2.0", True, "installing"),
        ("installing", "2.0", False, "interrupted"),
        ("installed", "2.0", False, "installed"),
        ("trying", "2.0", True, "restarting"),
        ("trying", "2.0", False, "lost"),
        ("trying", "1.0", True, "trying"),
        ("committed", "1.0", False, "committed"),
        ("committed", "2.0", False, "none"),  # somebody has put another card in
        ("went back", "2.0", False, "went back"),
        ("refused", "", False, "refused"),
    ],
)
def test_what_an_entry_means_depends_on_what_runs_and_since_when(
    state: str, version: str, same: bool, told: str
) -> None:
    entry = Entry.model_validate({"state": state, "version": version, "boot": "this" if same else "one before"})
    assert stage(entry, "1.0", "this") == told


def test_every_start_of_the_computer_has_a_name() -> None:
    assert len(this_boot()) == 36


def test_a_commit_that_the_journal_did_not_see_is_told_as_one() -> None:
    """The power went between `autoboot.txt` and the journal: the version that was tried runs, in another start."""
    tried = Entry(state="trying", version="2.0", boot="one", settling=True)
    assert [stage(tried, "2.0", boot) for boot in ("one", "two")] == ["trying", "committed"]
    assert stage(tried.model_copy(update={"settling": False}), "2.0", "two") == "trying"  # it has only just begun
    assert stage(tried, "1.0", "two") == "lost"
