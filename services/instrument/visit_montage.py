"""Montages of the visits: the chosen pictures of one eye joined to one, computed beside the exam.

A montage is computed in a subprocess of the lowest priority, which is stopped while a picture is taken or live pictures
are requested. Results are kept in memory by the digests of their pictures, so that another choice, a retake or a
corrected eye gives another montage, and the removal of a picture needs no further step.
"""

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from threading import Condition, Thread
from typing import Literal

from device.errors import DiffuscopeError
from device.recon.montage import Placement, make_montage
from device.values import Eye
from services.imaging.picture_files import read_png, to_png
from services.instrument.background import run_in_subprocess
from services.lru_cache import LruCache
from services.records.capture import NO_METHOD
from services.records.capture_store import CaptureStore
from services.records.programme import Programme
from services.records.visit import Visit

log = logging.getLogger(__name__)

PICTURE = "picture.png"
MAX_KEPT = 16  # montages in memory, about 1 MB each
MAX_WAITING = 8
POLL_S = 0.2

MontageState = Literal["none", "computing", "joined", "apart", "failed"]


@dataclass(frozen=True)
class VisitPicture:
    """Chosen picture of a slot; `digest` is the SHA-256 of its file."""

    slot: str
    capture: str
    digest: str
    simulated: bool


@dataclass(frozen=True)
class JoinedPictures:
    """Places of pictures in their order, and the montage as PNG, None if fewer than two pictures were joined.

    `projection`: "sphere", or "plane" if the scale of the pictures is unknown.
    """

    placed: tuple[Placement, ...]
    png: bytes | None
    projection: Literal["sphere", "plane"]


@dataclass(frozen=True)
class VisitMontage:
    """Montage of one eye of a visit at one moment.

    `state`: `none` with fewer than two pictures; `computing`, also while it waits for the camera; `joined`; `apart` if
    no two pictures could be joined; `failed` with `problem`. `digest` names the set of pictures.
    """

    pictures: tuple[VisitPicture, ...]
    digest: str
    state: MontageState
    made: JoinedPictures | None = None
    problem: DiffuscopeError | None = None


class MontageMaker:
    """Montages of a store, computed one after the other in a thread that ends when none is requested.

    The mutex `_lock` guards the waiting requests, the results and `_is_busy`; it is held over no computation.
    `is_idle` returns whether background work may run. `px_per_deg`: scale of the head's pictures, None if unknown.
    """

    def __init__(self, store: CaptureStore, is_idle: Callable[[], bool], px_per_deg: float | None) -> None:
        self._store, self._is_idle, self._px_per_deg = store, is_idle, px_per_deg
        self._lock = Condition()
        self._waiting: dict[str, tuple[VisitPicture, ...]] = {}
        self._kept = LruCache[str, JoinedPictures | DiffuscopeError](MAX_KEPT)
        self._is_busy = self._is_closed = False

    def montage(self, visit: Visit, programme: Programme, eye: Eye) -> VisitMontage:
        """Return the montage of the chosen pictures of an eye as far as it is known, and request it if it is not.

        Errors: StoreDamaged, RecordNotFound for a chosen picture whose record cannot be read.
        """
        pictures = self._pictures(visit, programme, eye)
        digest = hashlib.sha256(" ".join(picture.digest for picture in pictures).encode()).hexdigest()
        if len(pictures) < 2:
            return VisitMontage(pictures, digest, "none")
        with self._lock:
            known = self._kept.get(digest)
            if known is None:
                self._request(digest, pictures)
                return VisitMontage(pictures, digest, "computing")
        if isinstance(known, DiffuscopeError):
            return VisitMontage(pictures, digest, "failed", problem=known)
        return VisitMontage(pictures, digest, "apart" if known.png is None else "joined", known)

    def close(self) -> None:
        """End a running computation; its process is killed within a poll interval."""
        with self._lock:
            self._is_closed = True
            self._waiting.clear()
            self._lock.notify_all()
            self._lock.wait_for(lambda: not self._is_busy, timeout=5)

    def _pictures(self, visit: Visit, programme: Programme, eye: Eye) -> tuple[VisitPicture, ...]:
        """Return the chosen reconstructed pictures of an eye, in the order of the programme."""
        found = []
        for slot in programme.slots:
            chosen = visit.slots[slot.id].chosen if slot.eye == eye and slot.id in visit.slots else None
            if chosen is None:
                continue
            capture = self._store.get(chosen.capture)
            if capture.report.method != NO_METHOD and PICTURE in capture.files:
                found.append(VisitPicture(slot.id, capture.id, capture.files[PICTURE], capture.simulated))
        return tuple(found)

    def _request(self, digest: str, pictures: tuple[VisitPicture, ...]) -> None:
        if self._is_closed:
            return
        self._waiting.setdefault(digest, pictures)
        if len(self._waiting) > MAX_WAITING:  # the screen that asked for it asks again
            del self._waiting[next(iter(self._waiting))]
        if not self._is_busy:
            self._is_busy = True
            Thread(target=self._run, name="montage", daemon=True).start()

    def _run(self) -> None:
        """Compute the requested montages, the latest first, until none is left."""
        while True:
            with self._lock:
                if self._is_closed or not self._waiting:
                    self._is_busy = False
                    self._lock.notify_all()
                    return
                if not self._is_idle():
                    self._lock.wait(POLL_S)
                    continue
                digest, pictures = next(reversed(self._waiting.items()))
            try:
                made: JoinedPictures | DiffuscopeError = self._computed(pictures)
            except DiffuscopeError as error:
                log.warning("no montage: %s", error)
                made = error
            with self._lock:
                self._waiting.pop(digest, None)
                if not self._is_closed:
                    self._kept.put(digest, made)

    def _computed(self, pictures: Sequence[VisitPicture]) -> JoinedPictures:
        content = [self._store.read(picture.capture, PICTURE) for picture in pictures]
        simulated = any(picture.simulated for picture in pictures)
        joined: JoinedPictures = run_in_subprocess(
            join_pictures, content, simulated, self._px_per_deg, report=lambda _: None, may_run=self._may_run
        )
        return joined

    def _may_run(self) -> bool:
        if self._is_closed:
            raise DiffuscopeError("the instrument is being switched off", "Wait until it is back.")
        return self._is_idle()


def join_pictures(
    content: Sequence[bytes], simulated: bool, px_per_deg: float | None, progress: Callable[[int], None]
) -> JoinedPictures:
    """Return the montage of stored pictures (PNG); `progress` gets the number of placed pictures.

    `px_per_deg`: as in `make_montage`.

    Pictures of another size than the first one come from another calibration and stay apart. FrameError for a file that
    is no picture, or black. Numbers are rounded to what they mean: 0.1 pixels and degrees, 0.01 of peak and overlap.
    """
    pictures = [read_png(file) for file in content]
    fitting = [k for k, picture in enumerate(pictures) if picture.shape == pictures[0].shape]
    joined = make_montage([pictures[k] for k in fitting], progress, px_per_deg)
    placed = {k: replace(_rounded(placement), index=k) for k, placement in zip(fitting, joined.placed, strict=True)}
    for k in range(len(pictures)):
        if k not in placed:
            placed[k] = Placement(k, False, None, None, None, None, "it was taken with another calibration")
    is_joined = sum(placement.used for placement in placed.values()) > 1
    png = to_png(joined.picture, simulated, "montage") if is_joined else None
    return JoinedPictures(tuple(placed[k] for k in range(len(pictures))), png, joined.projection)


def _rounded(placement: Placement) -> Placement:
    shift_px = (
        None if placement.shift_px is None else (round(placement.shift_px[0], 1), round(placement.shift_px[1], 1))
    )
    turn_deg, peak, overlap = (
        None if value is None else round(value, digits)
        for value, digits in ((placement.rotation_deg, 1), (placement.peak, 2), (placement.overlap, 2))
    )
    return replace(placement, shift_px=shift_px, rotation_deg=turn_deg, peak=peak, overlap=overlap)
