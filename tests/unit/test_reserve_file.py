"""Reserve file: space that is really allocated, and released once for a write that must end."""

from pathlib import Path

import pytest

from device.errors import StoreFull
from services.records.capture_store import CaptureStore
from services.records.reserve_file import LENGTH_BYTES, NAME, ReserveFile


class FullDisk:
    """A write that fails until the reserve file is gone."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.tries = folder, 0

    def write(self) -> str:
        self.tries += 1
        if (self.folder / NAME).exists() or self.tries > 2:
            raise StoreFull("full")
        return "written"


def test_the_file_has_all_of_its_blocks(tmp_path: Path) -> None:
    ReserveFile(tmp_path).allocate_if_room(1, 10**9)
    assert (tmp_path / NAME).stat().st_blocks * 512 >= LENGTH_BYTES


def test_a_short_file_is_allocated_again(tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(b"short")
    ReserveFile(tmp_path).allocate_if_room(1, 10**9)
    assert (tmp_path / NAME).stat().st_size == LENGTH_BYTES


def test_a_disk_that_refuses_the_file_does_not_prevent_the_opening(tmp_path: Path) -> None:
    (tmp_path / NAME).mkdir()
    CaptureStore(tmp_path).close()


def test_a_write_on_a_full_disk_is_repeated_without_the_reserve(tmp_path: Path) -> None:
    disk, reserve = FullDisk(tmp_path), ReserveFile(tmp_path)
    reserve.allocate_if_room(1, 10**9)
    assert reserve.retried(disk.write) == "written"
    assert (disk.tries, (tmp_path / NAME).exists()) == (2, False)
    with pytest.raises(StoreFull):
        reserve.retried(disk.write)
    assert disk.tries == 3, "without a reserve there is no second try"


@pytest.mark.parametrize(("free_bytes", "is_allocated"), [(10**9, True), (200_000_000, False)])
def test_an_opening_allocates_it_where_there_is_room(tmp_path: Path, free_bytes: int, is_allocated: bool) -> None:
    CaptureStore(tmp_path / "store", free_bytes=lambda _: free_bytes).close()
    assert (tmp_path / "store" / NAME).exists() == is_allocated
