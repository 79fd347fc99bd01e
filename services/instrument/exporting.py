"""A visit to take away: a folder's worth of files, as a ZIP, or onto a USB stick, whole or not at all.

What tells who somebody is stays here: neither a file's name nor its content has a name, a phone or a village.
"""

import hashlib
import io
import json
import os
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from device.errors import StickFull, StickGone
from services.records import disk
from services.records.answers import IDENTIFIERS
from services.records.picture import noted
from services.records.store import Store
from services.records.visit import Visit

ROOTS = (Path("/media"), Path("/run/media"))
OLDEST = (1980, 1, 1, 0, 0, 0)  # of a ZIP; a clock that was never set is older
MOUNTS = Path("/proc/self/mounts")
BLANKS = {r"\040": " ", r"\011": "\t", r"\012": "\n", r"\134": "\\"}  # how the kernel writes blanks in a path


@dataclass(frozen=True)
class Stick:
    """A folder on something that can be taken away, and how much a new file in it could hold."""

    folder: Path
    free_bytes: int


class Sticks:
    """What is mounted below the roots, asked of the kernel each time: a stick may go at any moment."""

    def __init__(self, roots: tuple[Path, ...] = ROOTS, mounts: Path = MOUNTS) -> None:
        self._roots, self._mounts = roots, mounts

    def present(self) -> list[Stick]:
        """The sticks that are there and can be written."""
        found = []
        for folder in self._mounted():
            try:
                if os.access(folder, os.W_OK):
                    found.append(Stick(folder, disk.free_bytes(folder)))
            except OSError:  # pulled out since the kernel was asked: then it is not there
                continue
        return found

    def chosen(self, folder: str) -> Path:
        """That folder, if it is one of those that are there; StickGone if not, whatever else the words may mean."""
        for stick in self.present():
            if str(stick.folder) == folder:
                return stick.folder
        raise StickGone(f"{folder[:80]!r} is no USB stick that is there now")

    def _mounted(self) -> list[Path]:
        lines = self._mounts.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
        places = [Path(_plain(line.split(" ")[1])) for line in lines]
        return [place for place in places if any(root in place.parents for root in self._roots)]


def _plain(word: str) -> str:
    for code, letter in BLANKS.items():
        word = word.replace(code, letter)
    return word


def exported(store: Store, visit: Visit, shown: Mapping[str, Any]) -> dict[str, bytes]:
    """Every file of a visit by its name: pictures, reports, visit.json without names, and SHA256SUMS over all of them.

    A damaged picture is StoreDamaged, for half a visit must not look like one.
    """
    files: dict[str, bytes] = {}
    for slot, state in visit.slots.items():
        for number, taken in enumerate(state.taken, 1):
            files[f"{slot}-{number}.png"] = _picture(store, taken.capture)
            files[f"{slot}-{number}.json"] = _report(store, taken.capture)
    plain = dict(shown) | {"fields": {key: value for key, value in visit.fields.items() if key not in IDENTIFIERS}}
    files["visit.json"] = json.dumps(plain, indent=1, ensure_ascii=False).encode()
    sums = [f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in files.items()]
    return files | {"SHA256SUMS": "".join(sums).encode()}


def _picture(store: Store, id: str) -> bytes:
    """The picture as it was made; of one that was moved to the other eye, the same pixels with that eye in its note."""
    capture, made = store.get(id), store.read(id, "picture.png")
    if "moved" not in capture.report:
        return made
    return noted(made, f"{capture.eye} {capture.taken_at:%Y-%m-%d}")


def _report(store: Store, id: str) -> bytes:
    """The report as it was made; of a picture that was moved to the other eye, with what was moved."""
    capture, made = store.get(id), store.read(id, "report.json")
    if "moved" not in capture.report:
        return made
    told = {name: capture.report[name] for name in ("slot", "moved")}
    return json.dumps(json.loads(made) | {"eye": capture.eye} | told, indent=1).encode()


def folder_name(visit: Visit) -> str:
    """What the copy of a visit is called: number and visit, never a name."""
    return f"{visit.number}-{visit.id}"


def zipped(name: str, files: Mapping[str, bytes], begun_at: datetime) -> bytes:
    """The files in one folder of a ZIP, dated by the visit; PNGs do not shrink, so nothing is pressed."""
    out, dated = io.BytesIO(), max(begun_at.timetuple()[:6], OLDEST)
    with zipfile.ZipFile(out, "w") as archive:
        for path, content in files.items():
            archive.writestr(zipfile.ZipInfo(f"{name}/{path}", dated), content)
    return out.getvalue()


def copied(stick: Path, name: str, files: Mapping[str, bytes]) -> Path:
    """A new folder on a stick with these files, on the stick when this returns; of a failure nothing is left.

    StickFull, StickGone. An earlier copy stays: the new one gets a number.
    """
    with _told(stick):
        target, number = stick / name, 1
        while target.exists():
            number += 1
            target = stick / f"{name}-{number}"
        part = stick / f".{target.name}.part"
        shutil.rmtree(part, ignore_errors=True)  # of a copy that was interrupted
        try:
            disk.write_folder(part, files)
            part.rename(target)
        except OSError:
            shutil.rmtree(part, ignore_errors=True)  # a stick that is gone takes its half copy along
            raise
        disk.settle(target)  # FAT writes where a folder lies with the folder itself, not with the one that names it
        disk.settle(stick)
    return target


@contextmanager
def _told(stick: Path) -> Iterator[None]:
    """Errors of the operating system as what they mean to who holds the stick."""
    try:
        yield
    except OSError as error:
        kind = StickFull if disk.is_full(error) else StickGone
        raise kind(f"{stick} refused: {error.strerror or error}") from error
