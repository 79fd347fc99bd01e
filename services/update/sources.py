"""Update sources: copy a bundle from a USB drive, or download it with resume, to the data partition.

An incomplete file is named `NAME.part`. It is removed if a copy fails, and kept for resuming if a download fails.
"""

import hashlib
import os
import ssl
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import httpx

from device import atomic_io
from device.clock import Clock
from device.user_files import OPEN_FLAGS, files_in
from services.errors import UpdateDamaged, UpdateNoRoom, UpdateNotFound, UpdateSourceRemoved, UpdateUnreachable
from services.update.channel import Offer
from services.update.ipc import UPLOAD, FoundUpdate

CHUNK_BYTES = 1 << 20
COPIED_BUNDLE, DOWNLOADED_BUNDLE = ".copy.raucb", "update.raucb"  # copied from a drive or an upload; downloaded
MAX_LISTED, MAX_NAME_CHARS = 8, 100  # bundles in a list, each of which is read completely; characters of a name
BACKOFF_S = (1.0, 2.0, 4.0, 8.0, 16.0)  # exponential backoff between tries of one download
READ_TIMEOUT_S = 30.0
Progress = Callable[[float, str], None]


def find_bundle(place: Path) -> Path:
    """Return the bundle at `place`: the file itself, or the only bundle in the folder and its direct subfolders.

    UpdateNotFound if there is none or more than one.
    """
    if place.is_file():
        return place.resolve()
    found = files_in(place, "*.raucb", "*/*.raucb")
    if len(found) == 1:
        return found[0].resolve()
    if not found:
        raise UpdateNotFound(f"{place} holds no file that ends in .raucb")
    names = ", ".join(path.name for path in found)
    raise UpdateNotFound(f"{place} holds several updates: {names}", "Leave only the update that you mean on the stick.")


def list_bundles(sticks: Path, tablet: Path) -> list[tuple[FoundUpdate, Path]]:
    """Return entry and path of the uploaded bundle and of those on the USB drives, the first `MAX_LISTED` of them.

    The id is a hash of path, size and modification time. Regular files only, no symbolic links.
    """
    on_sticks = [("stick", path) for path in files_in(sticks, "*.raucb", "*/*.raucb")]
    found = []
    for where, path in [("tablet", tablet / UPLOAD), *on_sticks]:
        try:
            status = path.lstat()
        except OSError:  # no upload, or the drive was removed
            continue
        if stat.S_ISREG(status.st_mode) and not path.parent.is_symlink():
            id = hashlib.sha256(os.fsencode(path) + f" {status.st_size} {status.st_mtime_ns}".encode()).hexdigest()[:16]
            stick = _printable(path.parent.name) if where == "stick" else ""
            entry = {"id": id, "where": where, "stick": stick, "name": _printable(path.name), "bytes": status.st_size}
            found.append((FoundUpdate.model_validate(entry), path))
    return found[:MAX_LISTED]


def _printable(name: str) -> str:
    """Return a file name as valid Unicode, cut to `MAX_NAME_CHARS` characters; undecodable bytes become "?"."""
    return name.encode("utf-8", "replace").decode()[:MAX_NAME_CHARS]


def remove_copy(folder: Path) -> None:
    """Remove the copy of a bundle from `folder`, complete or not; downloads stay for resuming."""
    for name in (COPIED_BUNDLE, f"{COPIED_BUNDLE}.part"):
        (folder / name).unlink(missing_ok=True)


def copy_bundle(bundle: Path, folder: Path, progress: Progress) -> Path:
    """Copy the bundle into `folder` and return the copy's path; `progress` is called with the share copied (0 to 1).

    UpdateSourceRemoved if reading fails; UpdateNoRoom if the disk is full or its reserve would be used.
    """
    part = folder / f"{COPIED_BUNDLE}.part"
    remove_copy(folder)
    with _drive_errors():
        size = bundle.stat().st_size
    _refuse_without_room(folder, size)
    try:
        with _drive_errors(), open(os.open(bundle, OPEN_FLAGS), "rb") as source:
            _append(part, _pieces(source), size, progress)
            if part.stat().st_size != size:
                raise OSError(f"{part.stat().st_size} of {size} bytes")
    except (UpdateSourceRemoved, UpdateNoRoom):
        part.unlink(missing_ok=True)
        raise
    atomic_io.replace_durably(part, folder / COPIED_BUNDLE)
    return folder / COPIED_BUNDLE


class UpdateServer:
    """HTTPS client of the update folder at URL `at`; `authority` is a CA file (None: system CAs)."""

    def __init__(self, at: str, authority: Path | None, clock: Clock) -> None:
        self._at, self._clock = at, clock
        self._trust = ssl.create_default_context(cafile=str(authority) if authority else None)

    def read_small_file(self, name: str) -> bytes:
        """Return the first 1 MiB of a file in the update folder; UpdateUnreachable on a network error."""
        content = b""
        with self._network_errors(name), self._open(name, 0) as answer:
            for piece in answer.iter_raw():
                content += piece
                if len(content) >= CHUNK_BYTES:
                    break
        return content[:CHUNK_BYTES]

    def download(self, offer: Offer, folder: Path, progress: Progress) -> Path:
        """Download the offered bundle with resume and exponential backoff, and check its SHA-256; return its path.

        A complete file of an earlier download is returned as it is. UpdateUnreachable after the last try (the received
        part stays), UpdateNoRoom, UpdateDamaged (the file is removed).
        """
        whole = folder / DOWNLOADED_BUNDLE
        part = folder / f"{offer.bundle}.part"
        resumed = part.exists()
        for old in folder.glob("*.part"):
            if old != part:
                old.unlink()
        if whole.exists() and _sha256(whole) == offer.sha256:
            return whole
        for wait_s in (*BACKOFF_S, None):
            try:
                self._resume(offer, part, progress)
                break
            except UpdateUnreachable:
                if wait_s is None:
                    raise
                self._clock.sleep(wait_s)
        if _sha256(part) != offer.sha256:
            part.unlink()
            if resumed:  # a power cut may keep the length without the content: retry once from the start
                return self.download(offer, folder, progress)
            raise UpdateDamaged(f"{offer.bundle} is not what the channel promised: its SHA-256 differs")
        atomic_io.replace_durably(part, whole)
        return whole

    def _resume(self, offer: Offer, part: Path, progress: Progress) -> None:
        """Request the missing bytes once and append them to `part`; UpdateUnreachable if some are still missing."""
        there = part.stat().st_size if part.exists() else 0
        if there >= offer.bytes:
            return
        _refuse_without_room(folder=part.parent, need_bytes=offer.bytes - there)
        with self._network_errors(offer.bundle), self._open(offer.bundle, there) as answer:
            if there and answer.status_code != httpx.codes.PARTIAL_CONTENT:  # the server does not support ranges
                part.unlink()
            with suppress(httpx.RemoteProtocolError):  # the connection ended early: what has arrived counts
                _append(part, answer.iter_raw(), offer.bytes, progress)
        if (arrived := part.stat().st_size) < offer.bytes:
            raise UpdateUnreachable(f"{self._at} sent {arrived} of {offer.bytes} bytes")

    @contextmanager
    def _open(self, name: str, there: int) -> Iterator[httpx.Response]:
        """Request a file from byte `there` on; httpx.HTTPStatusError for an error status (400 or above)."""
        headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={there}-"} if there else {})
        url = f"{self._at}/{name}"  # https only: UpdateSettings
        timeout, hooks = READ_TIMEOUT_S, {"request": [_refuse_plain]}
        with (
            httpx.Client(verify=self._trust, timeout=timeout, follow_redirects=True, event_hooks=hooks) as client,
            client.stream("GET", url, headers=headers) as answer,
        ):
            answer.raise_for_status()
            yield answer

    @contextmanager
    def _network_errors(self, name: str) -> Iterator[None]:
        """Map OS and HTTP errors in the block to UpdateUnreachable; UpdateNoRoom (full disk) is not changed."""
        try:
            yield
        except httpx.HTTPStatusError as error:
            answer = error.response
            raise UpdateUnreachable(f"{self._at}/{name}: {answer.status_code} {answer.reason_phrase}") from error
        except (OSError, httpx.HTTPError) as error:
            raise UpdateUnreachable(f"{self._at}/{name}: {error}", _remedy(error)) from error


def _refuse_plain(request: httpx.Request) -> None:
    """Raise httpx.UnsupportedProtocol for a request without TLS, to which a server has redirected."""
    if request.url.scheme != "https":
        raise httpx.UnsupportedProtocol(f"only https is followed, not {request.url}")


def _remedy(error: BaseException | None) -> str | None:
    """Return the remedy for a server certificate that fails verification, as with a wrong clock; None otherwise."""
    while error is not None:
        if isinstance(error, ssl.SSLCertVerificationError):
            return "Look whether date and time of this device are right, then try again; or use a USB stick."
        error = error.__cause__ or error.__context__
    return None


def _pieces(source: IO[bytes]) -> Iterator[bytes]:
    while piece := source.read(CHUNK_BYTES):
        yield piece


def _append(part: Path, pieces: Iterator[bytes], size: int, progress: Progress) -> None:
    """Append the pieces to `part` and sync it; stop early if it becomes longer than `size` bytes.

    Read errors are raised unchanged; UpdateNoRoom on a full disk.
    """
    with open(part, "ab", buffering=0, opener=atomic_io.private_opener) as file:
        for piece in pieces:
            with _disk_errors(part, size):
                file.write(piece)
            arrived = part.stat().st_size
            progress(min(1.0, arrived / size), "fetching")
            if arrived > size:  # too long: the SHA-256 check fails
                return
        with _disk_errors(part, size):
            atomic_io.fsync_file(part)


@contextmanager
def _disk_errors(part: Path, size: int) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if not atomic_io.is_full(error):
            raise
        raise UpdateNoRoom(f"the disk is full after {part.stat().st_size} of {size} bytes") from error


@contextmanager
def _drive_errors() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UpdateSourceRemoved(f"the stick cannot be read any more: {error}") from error


def _refuse_without_room(folder: Path, need_bytes: int) -> None:
    """Raise UpdateNoRoom unless `need_bytes` fit beside the reserve that must stay free on the disk."""
    free = atomic_io.free_bytes(folder)
    if not atomic_io.has_room(need_bytes, free):
        raise UpdateNoRoom(f"{free} bytes are free; {need_bytes} and a reserve of {atomic_io.RESERVE_BYTES} are needed")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
