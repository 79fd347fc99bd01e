"""Event log of the instrument: its log messages as JSON lines, rotated and kept across restarts for a technician.

    FOLDER/event-log.jsonl                           newest file: one JSON object per line, newest last
    FOLDER/event-log.jsonl.1 ... event-log.jsonl.3   older files; rotation deletes the oldest

The log contains no patient's name: messages identify captures and visits by id only.
"""

import json
import logging
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from io import TextIOWrapper
from itertools import islice
from logging.handlers import RotatingFileHandler
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from device import atomic_io

FILE_NAME = "event-log.jsonl"
FILE_BYTES, FILES = 500_000, 4  # some months of a clinic
LOGGER_NAMES = ("device", "services")  # messages of libraries go to the system journal
MAX_CHARS = 2000


@dataclass(frozen=True)
class LogEntry:
    """One entry: time `at` (ISO 8601, UTC), level (lower case), text, code of an error, capture or visit id, traceback.

    The last three are None where the message has none.
    """

    at: str
    level: str
    text: str
    code: str | None = None
    about: str | None = None
    detail: str | None = None


class _PrivateFileHandler(RotatingFileHandler):
    """Handler whose files are private, whatever the umask: the log names patients' visits."""

    def _open(self) -> TextIOWrapper:
        return open(self.baseFilename, "a", encoding=self.encoding, opener=atomic_io.private_opener)


class EventLog:
    """Log file of the loggers `device` and `services`, from level INFO on.

    Messages are recorded from the construction to `close`; entries can be read at any time.
    """

    def __init__(self, folder: Path) -> None:
        atomic_io.make_folder(folder)
        self._path = folder / FILE_NAME
        self._handler = _PrivateFileHandler(self._path, maxBytes=FILE_BYTES, backupCount=FILES - 1, encoding="utf-8")
        self._handler.setFormatter(_JsonLine())
        self._levels = {name: logging.getLogger(name).level for name in LOGGER_NAMES}
        for name in LOGGER_NAMES:
            logging.getLogger(name).addHandler(self._handler)
            logging.getLogger(name).setLevel(logging.INFO)

    def close(self) -> None:
        """Stop recording, restore the previous log levels, and close the file."""
        for name, level in self._levels.items():
            logging.getLogger(name).removeHandler(self._handler)
            logging.getLogger(name).setLevel(level)
        self._handler.close()

    def entries(self, limit: int, about: str | None = None) -> list[LogEntry]:
        """Return the newest entries, newest first, at most `limit`; with `about`, only those of that id."""
        return list(islice((entry for entry in self._newest_first() if about in (None, entry.about)), limit))

    def as_jsonl(self) -> bytes:
        """Return the whole log as JSON lines, oldest first."""
        return "".join(f"{json.dumps(asdict(entry))}\n" for entry in self._oldest_first()).encode()

    def as_text(self) -> bytes:
        """Return the whole log as text, one entry per line with its time, oldest first; details are indented below."""
        return "".join(_as_text(entry) for entry in self._oldest_first()).encode()

    def _oldest_first(self) -> list[LogEntry]:
        return list(self._newest_first())[::-1]

    def _newest_first(self) -> Iterator[LogEntry]:
        for path in (self._path, *(Path(f"{self._path}.{k}") for k in range(1, FILES))):
            if not path.is_file():
                return
            for line in reversed(path.read_text("utf-8", "replace").split("\n")):
                try:
                    yield _ENTRY.validate_json(line)
                except ValidationError:  # incomplete after a power cut
                    continue


_ENTRY = TypeAdapter(LogEntry)


def _as_text(entry: LogEntry) -> str:
    """Return one entry as text: time, level (unless info), message, code and id in parentheses, indented traceback."""
    level = "" if entry.level == "info" else f"{entry.level.upper()}: "
    more = ", ".join(filter(None, (entry.code, entry.about)))
    detail = "".join(f"    {line}\n" for line in (entry.detail or "").splitlines())
    return f"{entry.at}  {level}{entry.text}{f' ({more})' if more else ''}\n{detail}"


class _JsonLine(logging.Formatter):
    """Formatter of a log record as one JSON line; `code` and `about` come from the argument `extra` of the log call."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as a JSON object in one line; message and traceback are cut to MAX_CHARS characters."""
        entry = LogEntry(
            at=datetime.fromtimestamp(record.created, UTC).isoformat(timespec="seconds"),
            level=record.levelname.lower(),
            text=record.getMessage()[:MAX_CHARS],
            code=getattr(record, "code", None),
            about=getattr(record, "about", None),
            detail=self.formatException(record.exc_info)[-MAX_CHARS:] if record.exc_info else None,
        )
        return json.dumps(asdict(entry))
