"""Golden tests of stored files: the present code reads them as before and writes the same."""

import shutil
from pathlib import Path

import pytest

from tests.golden import compare, files


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """Return a copy of the recorded files."""
    return Path(shutil.copytree(files.KEPT, tmp_path / "kept"))


def test_the_recorded_files_are_read_as_before(kept: Path) -> None:
    difference = compare.difference(compare.read("files")["read"], files.read_all(kept))
    assert not difference, difference


def test_what_is_read_is_written_again_to_the_same_bytes(kept: Path, tmp_path: Path) -> None:
    same = files.written_again(kept, tmp_path)
    assert same == dict.fromkeys(same, True)


def test_the_present_code_writes_files_and_rows_of_the_same_shape(kept: Path, tmp_path: Path) -> None:
    files.make(tmp_path / "present")
    difference = compare.difference(compare.read("files")["shape"], files.shape(tmp_path / "present"))
    assert not difference, difference
    assert files.schema(tmp_path / "present" / "data") == files.SCHEMA.read_text(encoding="utf-8")
    assert files.schema(kept / "data") == files.SCHEMA.read_text(encoding="utf-8")
