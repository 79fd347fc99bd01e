"""The diary of the instrument: what it logs, as sentences with a moment, kept across starts for a technician to read.

    FOLDER/diary.jsonl, diary.jsonl.1 ...    one line of JSON for each sentence, the newest last; the oldest file goes

It holds no name of a person: whoever logs says which capture, never whose.
"""

import json
import logging
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import islice
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any

NAME = "diary.jsonl"
FILE_BYTES, FILES = 500_000, 4  # some months of an ordinary clinic
OWN = ("device", "services")  # whose sentences are worth keeping; libraries' belong into the system's journal
MOST_CHARS = 2000


class Diary:
    """Keeps what `device` and `services` log, from INFO on, while it is open; reading works at any time."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / NAME
        self._handler = RotatingFileHandler(self._path, maxBytes=FILE_BYTES, backupCount=FILES - 1, encoding="utf-8")
        self._handler.setFormatter(_Line())
        self._levels = {name: logging.getLogger(name).level for name in OWN}
        for name in OWN:
            logging.getLogger(name).addHandler(self._handler)
            logging.getLogger(name).setLevel(logging.INFO)

    def close(self) -> None:
        """Keep nothing from now on."""
        for name, level in self._levels.items():
            logging.getLogger(name).removeHandler(self._handler)
            logging.getLogger(name).setLevel(level)
        self._handler.close()

    def entries(self, limit: int, about: str | None = None) -> list[dict[str, Any]]:
        """The newest sentences, newest first: `at`, `level`, `text`, `code`, `about` (a capture), `detail`."""
        return list(islice((entry for entry in self._newest_first() if about in (None, entry["about"])), limit))

    def kept(self) -> bytes:
        """All of it, one line of JSON for each sentence, the oldest first."""
        return "".join(f"{json.dumps(entry)}\n" for entry in self._oldest_first()).encode()

    def told(self) -> bytes:
        """All of it as sentences, one on a line with its moment, the oldest first; details stand below, set in."""
        return "".join(_sentence(entry) for entry in self._oldest_first()).encode()

    def _oldest_first(self) -> list[dict[str, Any]]:
        return list(self._newest_first())[::-1]

    def _newest_first(self) -> Iterator[dict[str, Any]]:
        for path in (self._path, *(Path(f"{self._path}.{k}") for k in range(1, FILES))):
            if not path.is_file():
                return
            for line in reversed(path.read_text("utf-8", "replace").split("\n")):
                try:
                    yield json.loads(line)
                except ValueError:  # a power cut tears the line that is being written
                    continue


def _sentence(entry: dict[str, Any]) -> str:
    """One entry for people: moment, what is the matter, sentence, code and capture in brackets."""
    level = "" if entry["level"] == "info" else f"{entry['level'].upper()}: "
    more = ", ".join(filter(None, (entry["code"], entry["about"])))
    detail = "".join(f"    {line}\n" for line in (entry["detail"] or "").splitlines())
    return f"{entry['at']}  {level}{entry['text']}{f' ({more})' if more else ''}\n{detail}"


class _Line(logging.Formatter):
    """One record as one line of JSON; what it says besides its sentence comes from `extra`."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        entry = {
            "at": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="seconds"),
            "level": record.levelname.lower(),
            "text": record.getMessage()[:MOST_CHARS],
            "code": getattr(record, "code", None),
            "about": getattr(record, "about", None),
            "detail": self.formatException(record.exc_info)[-MOST_CHARS:] if record.exc_info else None,
        }
        return json.dumps(entry)
