"""Files of people: lists without hidden companions, and text whose encoding is read or named."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from device.config.head_file import load_head
from device.config.sensors import sensor_profile
from device.errors import DiffuscopeError, SpecError
from device.optics.light_path import load_light_path
from device.sim.replay import find_recording
from device.user_files import files_in, read_text
from services import resources
from services.archive.plan import read_plan
from services.delivery.uploader import load_settings as load_upload_settings
from services.http.static_files import StaticFiles
from services.records.programme import load_programme
from services.update.settings import load_settings as load_update_settings
from services.update.sources import find_bundle, list_bundles
from tests.companions import add_companions, apple_double

TEXT = '# clínica\nname = "á"\n'
READERS: dict[str, Callable[[Path], Any]] = {
    "head": load_head,
    "sensor": lambda path: sensor_profile(path.name, path.parent),
    "light path": load_light_path,
    "programme": load_programme,
    "upload": load_upload_settings,
    "update": load_update_settings,
    "plan": read_plan,
}


def test_a_list_has_no_hidden_files_and_none_of_hidden_folders(tmp_path: Path) -> None:
    for name in ("b.tiff", "a.tiff", "notes.txt", "stick/c.tiff", ".Trashes/501/d.tiff"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "._a.tiff").touch()
    assert [path.name for path in files_in(tmp_path)] == ["a.tiff", "b.tiff", "notes.txt", "stick"]
    assert [path.name for path in files_in(tmp_path, "*.tiff", "*/*.tiff")] == ["a.tiff", "b.tiff", "c.tiff"]
    assert [path.name for path in files_in(tmp_path, "**/*.tiff")] == ["a.tiff", "b.tiff", "c.tiff"]
    assert files_in(tmp_path / "nothing", "*.tiff") == []


def test_a_list_of_a_folder_whose_own_name_is_hidden_is_whole(tmp_path: Path) -> None:
    """A data folder may lie below ~/.local."""
    folder = tmp_path / ".local/share"
    folder.mkdir(parents=True)
    (folder / "a.tiff").touch()
    assert [path.name for path in files_in(folder)] == ["a.tiff"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_utf_8_is_read_with_and_without_a_mark(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "a.toml").write_bytes(TEXT.encode(encoding))
    assert read_text(tmp_path / "a.toml") == TEXT


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (TEXT.encode("utf-16"), "saved as UTF-16"),
        (TEXT.encode("utf-16-le"), "saved as UTF-16"),
        (TEXT.encode("utf-16-be"), "saved as UTF-16"),
        (TEXT.encode("utf-32"), "saved as UTF-16"),
        (b"\xfe\xff" + TEXT.encode("utf-16-be"), "saved as UTF-16"),
        (TEXT.encode("latin-1"), "line 1: the byte 0xED is not UTF-8, .* Latin-1"),
        (b"a = 1\n" + TEXT.encode("cp1252"), "line 2: the byte 0xED"),
        (b"a = 1\n" + bytes(4096), "zero bytes"),
        (apple_double(), "companion that macOS wrote"),
    ],
)
@pytest.mark.parametrize("reader", READERS)
def test_every_reader_says_what_is_wrong_with_the_text(
    tmp_path: Path, reader: str, content: bytes, reason: str
) -> None:
    (tmp_path / "mine.toml").write_bytes(content)
    with pytest.raises(DiffuscopeError, match=reason) as raised:
        READERS[reader](tmp_path / "mine.toml")
    assert "damaged" not in raised.value.message + raised.value.remedy


@pytest.mark.parametrize("reader", [name for name in READERS if name != "plan"])
def test_every_reader_names_a_wrong_key_with_its_line(tmp_path: Path, reader: str) -> None:
    (tmp_path / "mine.toml").write_text("\ufeff# first\nnonsense = 1\n", encoding="utf-8")
    with pytest.raises(SpecError, match="line 2: 'nonsense' is not a known key"):
        READERS[reader](tmp_path / "mine.toml")


def test_a_shipped_head_with_a_mark_is_the_same_head(tmp_path: Path) -> None:
    original = resources.HEADS / "sim.toml"
    (tmp_path / "sim.toml").write_text(original.read_text(encoding="utf-8"), encoding="utf-8-sig")
    assert load_head(tmp_path / "sim.toml") == load_head(original)


def test_companions_are_no_recording_no_bundle_and_no_page(tmp_path: Path) -> None:
    for name in ("raw.tiff", "psf.tiff"):
        tifffile.imwrite(tmp_path / name, np.full((8, 8), 9, np.uint16))
    (tmp_path / "CLINIC").mkdir()
    (tmp_path / "CLINIC/two.raucb").write_bytes(b"hsqs")
    shutil.copytree(resources.WEB, tmp_path / "web")
    assert add_companions(tmp_path) > 3
    recording = find_recording(tmp_path)
    assert (recording.raws, recording.psfs) == ((tmp_path / "raw.tiff",), (tmp_path / "psf.tiff",))
    assert find_bundle(tmp_path) == tmp_path / "CLINIC/two.raucb"
    assert [entry.name for entry, _ in list_bundles(tmp_path, tmp_path / "tablet")] == ["two.raucb"]
    StaticFiles(tmp_path / "web")
