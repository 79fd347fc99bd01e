"""Getting a bundle onto the data partition: from a stick, or from a web server, going on where the link was lost.

What arrives is `NAME.part` until it is whole. A stick that is pulled out and a link that is lost change nothing else.
"""

import hashlib
import os
import ssl
import stat
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from typing import IO
from urllib.error import HTTPError

from device.clock import Clock
from device.errors import UpdateDamaged, UpdateNoRoom, UpdateNowhere, UpdateSourceGone, UpdateUnreachable
from services.records import disk
from services.records.update_notes import PLAINLY, UPLOAD, Found
from services.update.channel import Offer

PIECE_BYTES = 1 << 20
COPY, WHOLE = ".copy.raucb", "update.raucb"  # of a stick or a tablet; from a web server
MOST_LISTED, MOST_CHARS = 8, 100  # updates on sticks, each of which is read whole; letters of a name
WAITS_S = (1.0, 2.0, 4.0, 8.0, 16.0)  # between tries; whoever polls comes again later
SILENCE_S = 30.0
Progress = Callable[[float, str], None]


def on_stick(place: Path) -> Path:
    """The bundle at a place: itself, or the only one in a folder or on one of its sticks; else UpdateNowhere."""
    if place.is_file():
        return place.resolve()
    found = sorted({*place.glob("*.raucb"), *place.glob("*/*.raucb")})
    if len(found) == 1:
        return found[0].resolve()
    if not found:
        raise UpdateNowhere(f"{place} holds no file that ends in .raucb")
    names = ", ".join(path.name for path in found)
    raise UpdateNowhere(f"{place} holds several updates: {names}", "Leave only the update that you mean on the stick.")


def listed(sticks: Path, tablet: Path) -> list[tuple[Found, Path]]:
    """Every bundle on a stick, and the one that a tablet sent, with a name that changes when the file does.

    Plain files only: a stick's links lead nowhere.
    """
    on_sticks = [("stick", path) for path in sorted({*sticks.glob("*.raucb"), *sticks.glob("*/*.raucb")})]
    found = []
    for where, path in [("tablet", tablet / UPLOAD), *on_sticks]:
        try:
            known = path.lstat()
        except OSError:  # nothing was sent, or the stick was pulled out just now
            continue
        if stat.S_ISREG(known.st_mode) and not path.parent.is_symlink():
            id = hashlib.sha256(os.fsencode(path) + f" {known.st_size} {known.st_mtime_ns}".encode()).hexdigest()[:16]
            stick = _plain(path.parent.name) if where == "stick" else ""
            one = {"id": id, "where": where, "stick": stick, "name": _plain(path.name), "bytes": known.st_size}
            found.append((Found.model_validate(one), path))
    return found[:MOST_LISTED]


def _plain(name: str) -> str:
    """A file's name as text that can be shown, whatever somebody wrote on a stick."""
    return name.encode("utf-8", "replace").decode()[:MOST_CHARS]


def clear(folder: Path) -> None:
    """Remove what a power cut left of a copy; what came from a web server stays, for it may be needed."""
    for name in (COPY, f"{COPY}.part"):
        (folder / name).unlink(missing_ok=True)


def copied(bundle: Path, folder: Path, progress: Progress) -> Path:
    """A copy of somebody's bundle; UpdateSourceGone if the stick goes away, UpdateNoRoom if the disk is full."""
    part = folder / f"{COPY}.part"
    clear(folder)
    with _gone():
        size = bundle.stat().st_size
    _refuse_without_room(folder, size)
    try:
        with _gone(), open(os.open(bundle, PLAINLY), "rb") as source:
            _append(part, _pieces(source), size, progress)
            if part.stat().st_size != size:
                raise OSError(f"{part.stat().st_size} of {size} bytes")
    except (UpdateSourceGone, UpdateNoRoom):
        part.unlink(missing_ok=True)
        raise
    return part.rename(folder / COPY)


class Web:
    """A folder on a web server; HTTPS only, though what is trusted is the signature."""

    def __init__(self, at: str, authority: Path | None, clock: Clock) -> None:
        self._at, self._clock = at, clock
        self._trust = ssl.create_default_context(cafile=str(authority) if authority else None)

    def small(self, name: str) -> bytes:
        """A small file, whole."""
        with self._tried(name), self._open(name, 0) as answer:
            return bytes(answer.read(PIECE_BYTES))

    def download(self, offer: Offer, folder: Path, progress: Progress) -> Path:
        """The offered bundle, whole and with its SHA-256; what arrived before is not asked for again.

        UpdateUnreachable after the last try (what has arrived stays), UpdateNoRoom, UpdateDamaged (and it is removed).
        """
        whole, part = folder / WHOLE, folder / f"{offer.bundle}.part"
        resumed = part.exists()
        for old in folder.glob("*.part"):
            if old != part:
                old.unlink()
        if whole.exists() and _sha256(whole) == offer.sha256:
            return whole
        for wait_s in (*WAITS_S, None):
            try:
                self._go_on(offer, part, progress)
                break
            except UpdateUnreachable:
                if wait_s is None:
                    raise
                self._clock.sleep(wait_s)
        if _sha256(part) != offer.sha256:
            part.unlink()
            if resumed:  # a power cut may have kept its length and not its content: once more, from the beginning
                return self.download(offer, folder, progress)
            raise UpdateDamaged(f"{offer.bundle} is not what the channel promised: its SHA-256 differs")
        return part.rename(whole)

    def _go_on(self, offer: Offer, part: Path, progress: Progress) -> None:
        """Ask for what is missing, and once only."""
        there = part.stat().st_size if part.exists() else 0
        if there >= offer.bytes:
            return
        _refuse_without_room(folder=part.parent, need_bytes=offer.bytes - there)
        with self._tried(offer.bundle), self._open(offer.bundle, there) as answer:
            if there and answer.status != 206:  # it does not know how to go on
                part.unlink()
            _append(part, _pieces(answer), offer.bytes, progress)
        if (arrived := part.stat().st_size) < offer.bytes:
            raise UpdateUnreachable(f"{self._at} sent {arrived} of {offer.bytes} bytes")

    def _open(self, name: str, there: int) -> HTTPResponse:
        request = urllib.request.Request(f"{self._at}/{name}", headers={"Range": f"bytes={there}-"} if there else {})
        answer = urllib.request.urlopen(request, timeout=SILENCE_S, context=self._trust)  # settings allow https:// only
        assert isinstance(answer, HTTPResponse)
        return answer

    @contextmanager
    def _tried(self, name: str) -> Iterator[None]:
        """A link that fails is a link that was lost; a full disk is not."""
        try:
            yield
        except HTTPError as error:
            raise UpdateUnreachable(f"{self._at}/{name}: {error.code} {error.reason}") from error
        except (OSError, HTTPException) as error:
            reason = getattr(error, "reason", error)
            raise UpdateUnreachable(f"{self._at}/{name}: {reason}", _remedy(reason)) from error


def _remedy(reason: object) -> str | None:
    """A wrong clock looks like a wrong certificate."""
    if isinstance(reason, ssl.SSLCertVerificationError):
        return "Look whether date and time of this device are right, then try again; or use a USB stick."
    return None


def _pieces(source: IO[bytes]) -> Iterator[bytes]:
    while piece := source.read(PIECE_BYTES):
        yield piece


def _append(part: Path, pieces: Iterator[bytes], size: int, progress: Progress) -> None:
    """Write what comes, and wait for the disk; errors of reading pass as they are, want of room is UpdateNoRoom."""
    with part.open("ab", buffering=0) as file:
        for piece in pieces:
            with _room(part, size):
                file.write(piece)
            arrived = part.stat().st_size
            progress(min(1.0, arrived / size), "fetching")
            if arrived > size:  # nobody promised that: its SHA-256 will say so
                return
        with _room(part, size):
            os.fsync(file.fileno())


@contextmanager
def _room(part: Path, size: int) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if not disk.is_full(error):
            raise
        raise UpdateNoRoom(f"the disk is full after {part.stat().st_size} of {size} bytes") from error


@contextmanager
def _gone() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UpdateSourceGone(f"the stick cannot be read any more: {error}") from error


def _refuse_without_room(folder: Path, need_bytes: int) -> None:
    """Captures keep their reserve: an update never takes the room of the next picture."""
    free = disk.free_bytes(folder)
    if free < need_bytes + disk.RESERVE_BYTES:
        raise UpdateNoRoom(f"{free} bytes are free; {need_bytes} and a reserve of {disk.RESERVE_BYTES} are needed")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
