"""State of the last update, on the data partition where both slots read it, and its description in sentences."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from device import atomic_io
from device.clock import boot_id
from device.errors import DiffuscopeError
from services.errors import UpdateError, UpdateFailed, UpdateNoRoom
from services.update.ipc import StoredError, UpdateState, read_state, write_state

log = logging.getLogger(__name__)


class StateFile:
    """File of the state of the last update in `folder`, written atomically."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def read(self) -> UpdateState:
        """Return the stored state; UpdateState() if the file is missing or invalid."""
        return read_state(self._folder)

    def write(self, **changed: object) -> UpdateState:
        """Change some fields of the stored state, write it and return it.

        With `state`, also store the current boot id, and reset `trouble` and `settling` unless given. UpdateNoRoom or
        UpdateFailed if it cannot be written.
        """
        if "state" in changed:
            changed = {"trouble": None, "settling": False, **changed, "boot": boot_id()}
        entry = self.read().model_copy(update=changed)
        try:
            write_state(self._folder, entry)
        except OSError as error:
            kind = UpdateNoRoom if atomic_io.is_full(error) else UpdateFailed
            raise kind(f"the journal of updates cannot be written: {error.strerror or error}") from error
        return entry

    @contextmanager
    def record_refusals(self) -> Iterator[None]:
        """Store a DiffuscopeError raised in the block as `trouble` with state "refused", and raise it again."""
        try:
            yield
        except DiffuscopeError as error:
            try:
                self.write(state="refused", trouble=StoredError.of(error))
            except UpdateError:
                log.warning("the journal of updates cannot be written")  # the caller gets the first error
            raise


def describe_state(entry: UpdateState, runs: str, is_trying: bool, under_way: bool) -> str:
    """Return sentences for the operator: running version `runs`, outcome of the last update, newer version offered.

    `is_trying`: the running version is not committed. `under_way`: another process is fetching or installing now.
    """
    text = f"Version {runs} runs."
    trouble = entry.trouble
    why = f"{trouble.message} {trouble.remedy}" if trouble else ""
    if is_trying:
        return f"Version {runs} is being tried; {entry.before or 'the version before'} is back if it does not do."
    match entry.state:
        case "fetching" | "installing":
            what = f" Version {entry.version}" if entry.version else " Another version"
            text += (
                f"{what}: {entry.state}, {entry.share:.0%}." if under_way else f"{what} was interrupted: start anew."
            )
        case "interrupted":
            text += " The last update was interrupted: start anew."
        case "installed":
            text += f" Version {entry.version} is installed and waits for `diffuscope update restart`."
        case "trying" if entry.version != runs:
            text += f" Version {entry.version} did not finish starting, or lost power: {runs} is back."
        case "committed" | "trying" if entry.version == runs:  # a power cut may precede the write
            text = f"Updated to {runs}. It was tried, found well, and stays."
        case "went back":
            text += (
                f" Version {entry.version} was tried and was not well, so {runs} is back: {trouble and trouble.message}"
            )
        case "refused":
            text += f" The last update was not installed: {why}"
    if entry.offered and entry.offered != runs:
        text += f" Version {entry.offered} is offered: `diffuscope update install`."
    return text
