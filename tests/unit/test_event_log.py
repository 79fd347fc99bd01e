"""Event log: order, restarts, incomplete lines, rotation and export."""

import json
import logging
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest

from services.health.event_log import FILE_BYTES, FILE_NAME, FILES, EventLog

log = logging.getLogger("services.instrument.example")


@pytest.fixture
def event_log(tmp_path: Path) -> Iterator[EventLog]:
    event_log = EventLog(tmp_path)
    yield event_log
    event_log.close()


def test_entries_are_newest_first_with_code_and_id(event_log: EventLog) -> None:
    log.info("a picture was kept", extra={"about": "20260101T000000-OD-abc"})
    log.warning("press failed: %s", "the camera is gone", extra={"code": "camera.missing"})
    log.debug("below the level of the log")
    new, old = event_log.entries(10)
    assert (new.level, new.text, new.code) == ("warning", "press failed: the camera is gone", "camera.missing")
    assert (old.about, old.detail) == ("20260101T000000-OD-abc", None)
    assert event_log.entries(10, about="20260101T000000-OD-abc") == [old]
    assert event_log.entries(1) == [new]


def test_a_traceback_is_separate_from_the_message(event_log: EventLog) -> None:
    try:
        raise KeyError("psf")
    except KeyError:
        log.exception("the head stopped")
    (entry,) = event_log.entries(5)
    assert entry.text == "the head stopped"
    assert "KeyError: 'psf'" in entry.detail


def test_an_incomplete_line_is_skipped_and_entries_persist_across_a_restart(tmp_path: Path) -> None:
    first = EventLog(tmp_path)
    log.info("before the power cut")
    first.close()
    with (tmp_path / FILE_NAME).open("a") as out:
        out.write('{"at": "2026-\n')
    second = EventLog(tmp_path)
    log.info("நோயாளி: after it")  # non-Latin script
    second.close()
    assert [entry.text for entry in second.entries(9)] == ["நோயாளி: after it", "before the power cut"]


def test_rotation_limits_the_size(event_log: EventLog, tmp_path: Path) -> None:
    for k in range(4 * FILE_BYTES * FILES // 2000 // 3):
        log.info("%d %s", k, "x" * 4000)
    kept = sorted(tmp_path.iterdir())
    assert len(kept) == FILES
    assert sum(path.stat().st_size for path in kept) <= FILES * FILE_BYTES
    numbers = [int(entry.text.split()[0]) for entry in event_log.entries(10_000)]
    assert numbers == sorted(numbers, reverse=True)
    assert len(numbers) > 500


def test_messages_of_libraries_and_after_close_are_not_logged(tmp_path: Path) -> None:
    event_log = EventLog(tmp_path)
    logging.getLogger("uvicorn").error("not ours")
    event_log.close()
    log.info("too late")
    assert event_log.entries(9) == []


def test_the_text_form_is_oldest_first_with_indented_tracebacks(event_log: EventLog) -> None:
    log.info("a picture was kept", extra={"about": "20260101T000000-OD-abc"})
    try:
        raise KeyError("psf")
    except KeyError:
        log.exception("the head stopped", extra={"code": "camera.missing"})
    kept, stopped, *trace = event_log.as_text().decode().splitlines()
    assert kept.endswith("  a picture was kept (20260101T000000-OD-abc)")
    assert stopped.endswith("  ERROR: the head stopped (camera.missing)")
    assert all(line.startswith("    ") for line in trace)
    assert "KeyError: 'psf'" in trace[-1]
    entries = [asdict(entry) for entry in event_log.entries(10)[::-1]]
    assert [json.loads(line) for line in event_log.as_jsonl().splitlines()] == entries
