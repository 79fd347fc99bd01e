"""Files between page and updater: every content that the other side may write, and its handling."""

import json
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.clock import boot_id
from services.errors import UpdateRequestInvalid
from services.update.ipc import (
    MAX_REQUEST_BYTES,
    REQUEST_FILE,
    STATE_FILE,
    FoundUpdate,
    StoredError,
    UpdateRequest,
    UpdateState,
    read_state,
    stage_of,
    take_request,
    write_request,
    write_state,
)

FOUND = FoundUpdate(id="0123456789abcdef", where="stick", stick="A", name="two.raucb", bytes=7, version="2.0")
WHOLE = UpdateState(
    state="went back", version="2.0", trouble=StoredError(code="a", message="b", remedy="c"), found=(FOUND,)
)


def test_journal_is_read_back_and_readable_by_every_user(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        write_state(tmp_path, WHOLE)
    finally:
        os.umask(before)
    assert read_state(tmp_path) == WHOLE
    assert (tmp_path / STATE_FILE).stat().st_mode & 0o777 == 0o644
    assert [path.name for path in tmp_path.iterdir()] == [STATE_FILE]


def test_journal_with_fields_of_a_later_release_is_read(tmp_path: Path) -> None:
    """The previous version reads it after a rollback."""
    fields = WHOLE.model_dump() | {"mood": "good"}
    (tmp_path / STATE_FILE).write_text(json.dumps(fields))
    assert read_state(tmp_path) == WHOLE


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[]",
        "null",
        '{"form": 2}',
        '{"state": "on fire"}',
        '{"share": 7}',
        '{"share": "NaN"}',
        '{"found": [{"id": "../../etc/passwd", "where": "stick", "bytes": 1}]}',
        json.dumps({"version": "x" * 70_000}),
        WHOLE.model_dump_json()[:-9],
    ],
)
def test_unreadable_journal_counts_as_the_default(tmp_path: Path, content: str) -> None:
    (tmp_path / STATE_FILE).write_text(content)
    assert read_state(tmp_path) == UpdateState()


@pytest.mark.parametrize(
    "update_request",
    [UpdateRequest(do="check"), UpdateRequest(do="restart"), UpdateRequest(do="install", id="0123456789abcdef")],
)
def test_request_is_taken_once(tmp_path: Path, update_request: UpdateRequest) -> None:
    write_request(tmp_path, update_request)
    assert take_request(tmp_path) == update_request
    assert take_request(tmp_path) is None
    assert list(tmp_path.iterdir()) == []


HOSTILE = [
    "",
    "{",
    "[]",
    '{"do": "check"',
    '{"do": "check", "form": 2}',
    '{"do": "reboot"}',
    '{"do": "install"}',
    '{"do": "check", "id": "0123456789abcdef"}',
    '{"do": "install", "id": "../../../etc/shadow"}',
    '{"do": "install", "id": "/media/STICK/two.raucb"}',
    '{"do": "install", "id": "0123456789ABCDEF"}',
    '{"do": "install", "id": "0123456789abcdef\\n"}',
    '{"do": "check", "path": "/etc/shadow"}',
    "\x00" * 10,
    json.dumps({"do": "check"}) + " " * MAX_REQUEST_BYTES,
]


@pytest.mark.parametrize("content", HOSTILE)
def test_invalid_request_is_refused_and_removed(tmp_path: Path, content: str) -> None:
    (tmp_path / REQUEST_FILE).write_text(content)
    with pytest.raises(UpdateRequestInvalid) as caught:
        take_request(tmp_path)
    assert "look for updates" in caught.value.remedy
    assert take_request(tmp_path) is None


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_refused_and_removed(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    folder = tmp_path_factory.mktemp("requests")
    (folder / REQUEST_FILE).write_bytes(content)
    with pytest.raises(UpdateRequestInvalid):
        take_request(folder)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_irregular_file_is_not_followed(tmp_path: Path, kind: str) -> None:
    """The folder belongs to an unprivileged process, and root reads it."""
    secret, path = tmp_path / "secret", tmp_path / "requests" / REQUEST_FILE
    secret.write_text(UpdateRequest(do="check").model_dump_json())
    path.parent.mkdir()
    {"link": lambda: path.symlink_to(secret), "pipe": lambda: os.mkfifo(path), "folder": path.mkdir}[kind]()
    with pytest.raises(UpdateRequestInvalid):
        take_request(path.parent)
    assert secret.exists()
    assert path.exists() == (kind == "folder")


def test_unfinished_request_file_is_ignored(tmp_path: Path) -> None:
    (tmp_path / f".{REQUEST_FILE}.part").write_text('{"do": "ins')
    assert take_request(tmp_path) is None
    write_request(tmp_path, UpdateRequest(do="check"))
    assert take_request(tmp_path) == UpdateRequest(do="check")


@pytest.mark.parametrize(
    ("state", "version", "same", "expected"),
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
        ("committed", "2.0", False, "none"),  # the card was exchanged
        ("went back", "2.0", False, "went back"),
        ("refused", "", False, "refused"),
    ],
)
def test_stage_depends_on_running_version_and_boot(state: str, version: str, same: bool, expected: str) -> None:
    entry = UpdateState.model_validate({"state": state, "version": version, "boot": "this" if same else "one before"})
    assert stage_of(entry, "1.0", "this") == expected


def test_each_boot_has_an_id() -> None:
    assert len(boot_id()) == 36


def test_commit_missing_in_the_journal_is_shown_as_committed() -> None:
    """Power cut between `autoboot.txt` and the journal: the tried version runs in another boot."""
    tried = UpdateState(state="trying", version="2.0", boot="one", settling=True)
    assert [stage_of(tried, "2.0", boot) for boot in ("one", "two")] == ["trying", "committed"]
    assert (
        stage_of(tried.model_copy(update={"settling": False}), "2.0", "two") == "trying"
    )  # its settle has not started
    assert stage_of(tried, "1.0", "two") == "lost"
