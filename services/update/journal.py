"""What became of the last update, on the data partition where both slots read it, and the words for it."""

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from device.errors import DiffuscopeError, UpdateError, UpdateFailed, UpdateNoRoom
from services.records import disk
from services.update.bootchooser import write_whole

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Entry:
    """How far an update is.

    `state`: none, fetching, installing, installed, trying, committed, went back, refused.
    `said` is what went wrong, in words; `ill` the checks that failed before the update, which it is not blamed for.
    """

    state: str = "none"
    version: str = ""
    before: str = ""
    share: float = 0.0
    said: str = ""
    ill: tuple[str, ...] = ()
    offered: str = ""


class Journal:
    """One entry in one file, whole at any moment."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "journal.json"

    def read(self) -> Entry:
        """The last entry; one that cannot be read counts as none, since it only tells."""
        try:
            said = json.loads(self._path.read_text(encoding="utf-8"))
            return Entry(**said | {"ill": tuple(said["ill"])})
        except (OSError, ValueError, TypeError, KeyError):
            return Entry()

    def write(self, **changed: object) -> Entry:
        """Change some of the last entry; and give it back. UpdateNoRoom or UpdateFailed if it cannot be kept."""
        entry = replace(self.read(), **changed)  # type: ignore[arg-type]
        try:
            write_whole(self._path, json.dumps(asdict(entry)) + "\n")
        except OSError as error:
            kind = UpdateNoRoom if disk.is_full(error) else UpdateFailed
            raise kind(f"{self._path} cannot be written: {error.strerror or error}") from error
        return entry

    @contextmanager
    def refusals(self) -> Iterator[None]:
        """Write down why an update was refused inside, and pass it on; how a try ended stays what it was."""
        try:
            yield
        except DiffuscopeError as error:
            try:
                self.write(state="refused", said=f"{error.message} {error.remedy}")
            except UpdateError:
                log.warning("the journal of updates cannot be written")  # whoever asked hears the first reason
            raise


def in_words(entry: Entry, runs: str, is_trying: bool, under_way: bool) -> str:
    """One or two sentences for the operator: what runs, and what became of the last update.

    `under_way`: somebody is fetching or installing at this moment.
    """
    said = f"Version {runs} runs."
    if is_trying:
        return f"Version {runs} is being tried; {entry.before or 'the version before'} is back if it does not do."
    match entry.state:
        case "fetching" | "installing":
            what = f" Version {entry.version}" if entry.version else " Another version"
            said += (
                f"{what}: {entry.state}, {entry.share:.0%}." if under_way else f"{what} was interrupted: start anew."
            )
        case "installed":
            said += f" Version {entry.version} is installed and waits for `diffuscope update restart`."
        case "trying" if entry.version != runs:
            said += f" Version {entry.version} did not finish starting, or lost power: {runs} is back."
        case "committed" if entry.version == runs:
            said = f"Updated to {runs}. It was tried, found well, and stays."
        case "went back":
            said += f" Version {entry.version} was tried and was not well, so {runs} is back: {entry.said}"
        case "refused":
            said += f" The last update was not installed: {entry.said}"
    if entry.offered and entry.offered != runs:
        said += f" Version {entry.offered} is offered: `diffuscope update install`."
    return said
