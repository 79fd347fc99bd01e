"""The diary: sentences that outlive a start, in their order, whatever tears its last line."""

import json
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.instrument.diary import FILE_BYTES, FILES, NAME, Diary

log = logging.getLogger("services.instrument.nobody")


@pytest.fixture
def diary(tmp_path: Path) -> Iterator[Diary]:
    diary = Diary(tmp_path)
    yield diary
    diary.close()


def test_the_newest_sentence_comes_first_with_its_code_and_what_it_is_about(diary: Diary) -> None:
    log.info("a picture was kept", extra={"about": "20260101T000000-OD-abc"})
    log.warning("press failed: %s", "the camera is gone", extra={"code": "camera.missing"})
    log.debug("nobody wants to read this")
    new, old = diary.entries(10)
    assert (new["level"], new["text"], new["code"]) == ("warning", "press failed: the camera is gone", "camera.missing")
    assert (old["about"], old["detail"]) == ("20260101T000000-OD-abc", None)
    assert diary.entries(10, about="20260101T000000-OD-abc") == [old]
    assert diary.entries(1) == [new]


def test_a_traceback_is_kept_apart_from_the_sentence(diary: Diary) -> None:
    try:
        raise KeyError("psf")
    except KeyError:
        log.exception("the head stopped")
    (entry,) = diary.entries(5)
    assert entry["text"] == "the head stopped"
    assert "KeyError: 'psf'" in entry["detail"]


def test_a_torn_line_costs_only_itself_and_what_was_written_outlives_a_start(tmp_path: Path) -> None:
    first = Diary(tmp_path)
    log.info("before the power cut")
    first.close()
    with (tmp_path / NAME).open("a") as out:
        out.write('{"at": "2026-\n')
    second = Diary(tmp_path)
    log.info("நோயாளி: after it")  # any script
    second.close()
    assert [entry["text"] for entry in second.entries(9)] == ["நோயாளி: after it", "before the power cut"]


def test_the_diary_never_fills_the_disk(diary: Diary, tmp_path: Path) -> None:
    for k in range(4 * FILE_BYTES * FILES // 2000 // 3):
        log.info("%d %s", k, "x" * 4000)
    kept = sorted(tmp_path.iterdir())
    assert len(kept) == FILES
    assert sum(path.stat().st_size for path in kept) <= FILES * FILE_BYTES
    numbers = [int(entry["text"].split()[0]) for entry in diary.entries(10_000)]
    assert numbers == sorted(numbers, reverse=True)
    assert len(numbers) > 500


def test_what_libraries_say_is_not_in_it_and_nothing_is_kept_after_the_end(tmp_path: Path) -> None:
    diary = Diary(tmp_path)
    logging.getLogger("uvicorn").error("not ours")
    diary.close()
    log.info("too late")
    assert diary.entries(9) == []


def test_the_whole_of_it_is_told_oldest_first_with_what_went_wrong_set_in(diary: Diary) -> None:
    log.info("a picture was kept", extra={"about": "20260101T000000-OD-abc"})
    try:
        raise KeyError("psf")
    except KeyError:
        log.exception("the head stopped", extra={"code": "camera.missing"})
    kept, stopped, *trace = diary.told().decode().splitlines()
    assert kept.endswith("  a picture was kept (20260101T000000-OD-abc)")
    assert stopped.endswith("  ERROR: the head stopped (camera.missing)")
    assert all(line.startswith("    ") for line in trace)
    assert "KeyError: 'psf'" in trace[-1]
    assert [json.loads(line) for line in diary.kept().splitlines()] == diary.entries(10)[::-1]
