"""Presses under way, written down before their light: after a power cut it is known which picture to take again."""

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from device.errors import NotKept, StoreDamaged
from device.values import EYES, Eye
from services.records import disk
from services.records.store import Store, told


@dataclass(frozen=True)
class Lost:
    """A press that was never answered: the name of its capture, its eye, the slot of the visit that it was for.

    `tries` is how many pictures that slot had before.
    """

    id: str
    eye: Eye | None
    visit: str | None = None
    slot: str | None = None
    tries: int = 0


class Underway:
    """One small file for each press under way; what is there at the opening was lost, unless it was kept after all.

    The shelf may also have found torn captures of which there is no file here.
    """

    def __init__(self, store: Store) -> None:
        self._folder = store.folder / "underway"
        with told():
            disk.make_folder(self._folder)
            paths = sorted(self._folder.glob("*.json"))
            found, self._keys = {path.stem: _read(path) for path in paths}, {path.stem: _key(path) for path in paths}
        for id in [id for id in found if _is_kept(store, id)]:
            del found[id]
            self.end(id)
        for name in store.swept:
            if not any(name.startswith(id) for id in found):
                found[name] = Lost(name, _eye_in(name))
        self.lost = tuple(found.values())

    def begin(self, press: Lost, key: str | None = None) -> None:
        """A press begins, with the key of its request; on the disk when this returns. StoreFull, StoreError."""
        with told():
            disk.write_file(self._folder / f"{press.id}.json", json.dumps(asdict(press) | {"key": key}).encode())
            disk.settle(self._folder)

    def end(self, id: str, key: str | None = None) -> None:
        """It was answered; or whoever lost it has heard of it, and has done what was to be done.

        With the `key` of a request that has its picture now, what a kill took of that request is over too.
        """
        with told():
            (self._folder / f"{id}.json").unlink(missing_ok=True)
        if key is not None:
            self.forget(lambda one: self._keys.get(one.id) == key)

    def forget(self, over: Callable[[Lost], bool]) -> None:
        """Of what was lost, forget what is over."""
        gone = [one for one in self.lost if over(one)]
        for one in gone:
            self.end(one.id)
        self.lost = tuple(one for one in self.lost if one not in gone)


def _is_kept(store: Store, id: str) -> bool:
    with suppress(StoreDamaged):
        try:
            store.get(id)
        except NotKept:
            return False
    return True


def _read(path: Path) -> Lost:
    try:
        said = json.loads(path.read_bytes())
        return Lost(path.stem, said["eye"], said["visit"], said["slot"], said["tries"])
    except (ValueError, KeyError, TypeError):  # the power went off while it was written
        return Lost(path.stem, _eye_in(path.stem))


def _key(path: Path) -> str | None:
    """The key of the request that a press was; None where none is written down."""
    try:
        key = json.loads(path.read_bytes())["key"]
    except (ValueError, KeyError, TypeError):  # torn, or of a release that did not write it
        return None
    return key if isinstance(key, str) else None


def _eye_in(name: str) -> Eye | None:
    """The eye that a capture's name says."""
    return next((eye for eye in EYES if f"-{eye}-" in name), None)
