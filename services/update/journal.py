"""What became of the last update, on the data partition where both slots read it, and the words for it."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from device.errors import DiffuscopeError, UpdateError, UpdateFailed, UpdateNoRoom
from services.records import disk
from services.records.update_notes import Entry, Trouble, read_entry, this_boot, write_entry

log = logging.getLogger(__name__)


class Journal:
    """One entry in one file, whole at any moment."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def read(self) -> Entry:
        """The last entry."""
        return read_entry(self._folder)

    def write(self, **changed: object) -> Entry:
        """Change some of the last entry, and give it back; a new state is of this start of the computer.

        UpdateNoRoom or UpdateFailed if it cannot be kept.
        """
        if "state" in changed:
            changed = {"trouble": None, "settling": False, **changed, "boot": this_boot()}
        entry = self.read().model_copy(update=changed)
        try:
            write_entry(self._folder, entry)
        except OSError as error:
            kind = UpdateNoRoom if disk.is_full(error) else UpdateFailed
            raise kind(f"the journal of updates cannot be written: {error.strerror or error}") from error
        return entry

    @contextmanager
    def refusals(self) -> Iterator[None]:
        """Write down why an update was refused inside, and pass it on; how a try ended stays what it was."""
        try:
            yield
        except DiffuscopeError as error:
            try:
                self.write(state="refused", trouble=Trouble.of(error))
            except UpdateError:
                log.warning("the journal of updates cannot be written")  # whoever asked hears the first reason
            raise


def in_words(entry: Entry, runs: str, is_trying: bool, under_way: bool) -> str:
    """One or two sentences for the operator: what runs, and what became of the last update.

    `under_way`: somebody is fetching or installing at this moment.
    """
    said, trouble = f"Version {runs} runs.", entry.trouble
    why = f"{trouble.message} {trouble.remedy}" if trouble else ""
    if is_trying:
        return f"Version {runs} is being tried; {entry.before or 'the version before'} is back if it does not do."
    match entry.state:
        case "fetching" | "installing":
            what = f" Version {entry.version}" if entry.version else " Another version"
            said += (
                f"{what}: {entry.state}, {entry.share:.0%}." if under_way else f"{what} was interrupted: start anew."
            )
        case "interrupted":
            said += " The last update was interrupted: start anew."
        case "installed":
            said += f" Version {entry.version} is installed and waits for `diffuscope update restart`."
        case "trying" if entry.version != runs:
            said += f" Version {entry.version} did not finish starting, or lost power: {runs} is back."
        case "committed" | "trying" if entry.version == runs:  # the power may go before the journal knows
            said = f"Updated to {runs}. It was tried, found well, and stays."
        case "went back":
            said += (
                f" Version {entry.version} was tried and was not well, so {runs} is back: {trouble and trouble.message}"
            )
        case "refused":
            said += f" The last update was not installed: {why}"
    if entry.offered and entry.offered != runs:
        said += f" Version {entry.offered} is offered: `diffuscope update install`."
    return said
