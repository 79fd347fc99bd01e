"""Captures that a kill has interrupted, from the frames on the disk: a shorter burst under the same id and key."""

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import datetime

from device.errors import DiffuscopeError, FrameError, StoreError
from device.values import Calibration, Colour, Frame
from services.imaging.raw_metadata import RawMetadata
from services.instrument.capture import Press
from services.instrument.press_exposure import Exposure
from services.records.blobs import WrittenFile
from services.records.capture import Capture
from services.records.capture_journal import CaptureJournal, ResumableCapture
from services.records.capture_target import CaptureTarget
from services.records.frame_writer import DARK

log = logging.getLogger(__name__)

ResumedTarget = Callable[[ResumableCapture], CaptureTarget]

SHORTER = "the instrument stopped before this picture was stored: {taken} of {planned} frames were on the disk"
MADE_AT_START = "the instrument stopped before this picture was stored: it was made at the next start"
CALIBRATION_DARK = "the dark frame was not on the disk: that of the calibration was subtracted"
NO_DARK = "the dark frame was not on the disk, and the calibration has none: the black level was subtracted"
OTHER_CALIBRATION = "the frames were taken with calibration {before}"


@dataclass(frozen=True)
class ResumedPress:
    """A press of the run before, whose frames are on the disk; its future is that of the capture."""

    press: Press
    stored: ResumableCapture

    @property
    def id(self) -> str:
        """The id of the capture."""
        return self.stored.press.id

    @property
    def files(self) -> Mapping[int, WrittenFile]:
        """The files on the disk by the number of their frame."""
        return {frame.number: frame.file for frame in self.stored.frames}


@dataclass(frozen=True)
class ResumedFrames:
    """Frames of an interrupted press, the time of the press, and the warnings on them for its report."""

    exposure: Exposure
    taken_at: datetime
    notes: tuple[str, ...]


def resumed_presses(journal: CaptureJournal, target_of: ResumedTarget) -> tuple[ResumedPress, ...]:
    """Return the presses whose frames are in the journal, oldest first.

    `target_of` returns the target of a capture. One whose target is not known any more has failed.
    """
    found = []
    for capture in journal.resumable:
        try:
            eye = capture.press.eye
            target = target_of(capture)
            if eye is None:
                raise FrameError("the eye of the press is not known")
        except DiffuscopeError as error:
            give_up(journal, capture.press.id, error)
            continue
        future: Future[Capture] = Future()
        future.set_running_or_notify_cancel()
        found.append(ResumedPress(Press(future, eye, target, capture.key), capture))
    return tuple(found)


def give_up(journal: CaptureJournal, id: str, error: DiffuscopeError) -> None:
    """Delete the frames of a capture, which is an interrupted one from now on."""
    log.warning("the frames of %s are given up: %s", id, error, extra={"code": error.code})
    try:
        journal.fail(id)
    except StoreError as refused:  # the next opening tries it again
        log.warning("the frames of %s stay on the disk: %s", id, refused)


def resumed_frames(stored: ResumableCapture, calibration: Calibration, now_s: float) -> ResumedFrames:
    """Return the frames of an interrupted press; `calibration`: that in force, `now_s`: clock seconds.

    FrameError if a file cannot be read, has no time, or there is no lit frame.
    """
    loaded = [(stored_frame, *_loaded(stored_frame.load)) for stored_frame in stored.frames]
    lit = tuple(frame for stored_frame, frame, _ in loaded if stored_frame.is_lit)
    dark = next((frame for stored_frame, frame, _ in loaded if stored_frame.file.path.name == DARK), None)
    taken_at = loaded[0][2].taken_at if loaded else None
    if not lit or taken_at is None:
        raise FrameError("the frames on the disk are not those of a press")
    colours: dict[Colour, Frame] = {
        frame.illumination.colour: frame
        for stored_frame, frame, _ in loaded
        if not stored_frame.is_lit and frame.illumination is not None
    }
    last = stored.frames[-1]
    exposure = Exposure(lit, colours, dark, now_s - last.exposed_s, last.exposed_s, last.dose_j_per_cm2)
    return ResumedFrames(exposure, taken_at, _notes(stored, exposure, calibration, loaded[0][2].calibration_id))


def _loaded(load: Callable[[], tuple[Frame, RawMetadata]]) -> tuple[Frame, RawMetadata]:
    try:
        return load()
    except (OSError, StoreError) as error:
        raise FrameError(f"a frame cannot be read: {error}") from error


def _notes(
    stored: ResumableCapture, taken: Exposure, calibration: Calibration, calibration_id: str | None
) -> tuple[str, ...]:
    """Return the warnings: how many frames there are, which dark frame is subtracted, another calibration."""
    is_whole = taken.dark is not None and len(taken.lit) >= stored.planned
    notes = [MADE_AT_START if is_whole else SHORTER.format(taken=len(taken.lit), planned=stored.planned)]
    if taken.dark is None:
        notes.append(NO_DARK if calibration.dark_dn is None else CALIBRATION_DARK)
    if calibration_id != calibration.id:
        notes.append(OTHER_CALIBRATION.format(before=calibration_id))
    return tuple(notes)
