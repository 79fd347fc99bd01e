"""Record of the exports of visits to USB drives: which finished state was copied, and read back, at last.

`exports/<visit>.json` in the folder of the store. A visit that was changed since has another `finished_at`.
"""

from datetime import datetime
from pathlib import Path

from device import atomic_io
from services.records import digested_json, row_validation
from services.records.storage_errors import storage_errors


class ExportRecords:
    """Exports of the visits of the store in `folder`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "exports"

    def write(self, visit: str, finished_at: datetime, exported_at: datetime) -> None:
        """Record the export of a visit as finished at a moment; durable on return. StoreError if the disk refuses."""
        entries = {"finished_at": finished_at.isoformat(), "exported_at": exported_at.isoformat()}
        with storage_errors():
            atomic_io.make_folder(self._folder)
            atomic_io.write_atomically(self._folder / f"{visit}.json", digested_json.encoded(entries))

    def exported_state(self, visit: str) -> datetime | None:
        """Return the `finished_at` of the exported state; None without one, or if the record cannot be read."""
        try:
            entries = digested_json.decoded((self._folder / f"{visit}.json").read_bytes())
            return row_validation.timestamp(entries["finished_at"])
        except (OSError, ValueError, KeyError):
            return None
