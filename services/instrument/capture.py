"""Values of one capture: its request with an idempotency key, its exposed frames, its report and its files."""

import json
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from datetime import datetime

from device.light_safety.dose_report import DoseReport
from device.recon.assessment.aiming import Aim
from device.recon.assessment.exposure_split import ExposureSplit
from device.recon.assessment.laterality import Laterality
from device.values import EYES, Colour, Eye, Frame, Image, Report, Verdict
from services.imaging import picture_files
from services.imaging.colour_rendering import render_colour
from services.imaging.raw_metadata import RawMetadata
from services.instrument.press_exposure import Exposure
from services.lru_cache import LruCache
from services.records.blobs import FileContent, WrittenFile
from services.records.capture import BUDGET_S, COLOUR, Capture, CaptureReport, LateralityEstimate, StoredVerdict
from services.records.capture_journal import InterruptedCapture
from services.records.capture_target import CaptureTarget, Permit, permit_test_picture
from services.records.frame_writer import DARK, FIRST
from services.records.idempotent_requests import key_conflict

REMEMBERED = 32  # idempotency keys: a request that the network repeats makes one capture
THUMBNAIL_PX = 640  # also of a quick look


@dataclass(frozen=True)
class Preview:
    """Live picture: number, JPEG, time of exposure (clock seconds) and aiming hint."""

    number: int
    jpeg: bytes
    exposed_s: float
    aim: Aim


@dataclass(frozen=True)
class LiveRequest:
    """Request for live pictures: the eyes that the dose counts for, and the id of the visit, None without one.

    `permit` raises RequestRefused without consent.
    """

    eyes: tuple[Eye, ...] = EYES
    permit: Permit = permit_test_picture
    visit: str | None = None


NO_VISIT = LiveRequest()


@dataclass(frozen=True)
class Press:
    """Accepted capture request: future of the capture, eye, capture target, idempotency key and time of its arrival.

    `tapped_s` is in clock seconds, None for a press of an earlier run.
    """

    future: Future[Capture]
    eye: Eye
    target: CaptureTarget
    key: str | None
    tapped_s: float | None = None

    def journal_entry(self, id: str) -> InterruptedCapture:
        """Return the journal entry that is written before the exposure; `id` is the identifier of the capture."""
        return InterruptedCapture(id, self.eye, self.target.visit, self.target.slot, self.target.tries)


@dataclass(frozen=True)
class ExposedCapture:
    """Capture before its reconstruction: the press, its exposure with the first verdict, on `frame`, and dose report.

    `written` waits for the frames that are being written to the disk, and returns their files by the number of the
    frame. `notes`: warnings on the exposure for the report. `budget_s`: time budget (time_budget.py).
    """

    press: Press
    id: str
    taken_at: datetime
    exposure: Exposure
    light: DoseReport
    verdict: Verdict
    written: Callable[[], Mapping[int, WrittenFile]] = dict
    notes: tuple[str, ...] = ()
    budget_s: float = BUDGET_S

    @property
    def frame(self) -> Frame:
        """The first good lit frame, without a good one the first: the verdict is on it."""
        return self.exposure.lit[0]


def split_notes(split: ExposureSplit) -> tuple[str, ...]:
    """Return the note of a report on split exposures, with the reason; none for whole ones."""
    if split.parts == 1:
        return ()
    return (
        f"each exposure was split into {split.parts} frames without more light: the eye moved by "
        f"{split.motion_deg:.2f} degrees during one (predicted gain {split.gain_db:.1f} dB)",
    )


class IdempotencyKeys:
    """Latest presses by idempotency key. Not thread-safe: the mutex of `ExamRequests` guards it."""

    def __init__(self) -> None:
        self._presses = LruCache[str, Press](REMEMBERED)

    def find(self, key: str | None, eye: Eye, target: CaptureTarget) -> Future[Capture] | None:
        """Return the future of the press with this key, or None; IdempotencyKeyConflict for another target."""
        press = None if key is None else self._presses.get(key)
        if press is None:
            return None
        before = press.eye, press.target.visit, press.target.slot
        if before != (eye, target.visit, target.slot):
            raise key_conflict()
        return press.future

    def remember(self, press: Press) -> None:
        """Store a press that has a key; beyond REMEMBERED of them, forget the one whose key was unused for longest."""
        if press.key is not None:
            self._presses.put(press.key, press)


def frame_metadata(capture: RawMetadata, frame: Frame) -> RawMetadata:
    """Return the metadata of a raw frame; `capture`: those of all frames of its capture."""
    return replace(capture, exposure_s=frame.exposure_s, illumination=frame.illumination, simulated=frame.simulated)


def lit_name(index: int) -> str:
    """Return the file name of a lit frame of a capture, by its place in the burst."""
    return FIRST if index == 0 else f"raw-{index}.tiff"


def colour_name(colour: Colour) -> str:
    """Return the file name of the frame of a capture in another colour of light."""
    return f"raw-{colour}.tiff"


def capture_files(
    capture: Capture, head: str, shot: ExposedCapture, shown: Image, colour: Image | None
) -> dict[str, FileContent]:
    """Return the files of a capture by name; `shown` is the linear picture of the field.

    `colour` is the picture in colour, if there is one: `colour.png`, and reduced `quick.jpg`. The picture in green is
    `picture.png`, and reduced `green.jpg`, without colour also `quick.jpg`. `head` is the name of the head. The raw
    frames and the calibration in their metadata suffice to repeat the reconstruction: `raw.tiff` is the first good
    frame of the burst (the first one without a good one), `raw-1.tiff` the next of the others, `raw-red.tiff` that in
    red light; without a dark frame there is no `dark.tiff`.
    """
    note = f"{capture.eye} {capture.taken_at:%Y-%m-%d}"
    green = picture_files.to_jpeg(shown, THUMBNAIL_PX, capture.simulated)
    thumbnail = green
    coloured = dict[str, FileContent]()
    predicted = [channel.name for channel in capture.report.channels if channel.predicted]
    if colour is not None:
        colour = render_colour(colour)
        coloured[COLOUR] = picture_files.to_png(colour, capture.simulated, note, predicted, picture_files.DISPLAY)
        thumbnail = picture_files.to_jpeg(colour, THUMBNAIL_PX, capture.simulated, window=picture_files.DISPLAY)
    return {
        **_frame_files(capture, head, shot),
        "picture.png": picture_files.to_png(shown, capture.simulated, note),
        **coloured,
        "green.jpg": green,
        "quick.jpg": thumbnail,
        "report.json": json.dumps(capture.report.as_json() | {"simulated": capture.simulated}, indent=1).encode(),
    }


def _frame_files(capture: Capture, head: str, shot: ExposedCapture) -> dict[str, FileContent]:
    """Return the raw frames of a capture by file name: the file that is on the disk already, or its content."""
    exposure = shot.exposure
    frames = {lit_name(k): frame for k, frame in enumerate(exposure.lit)}
    frames |= {colour_name(colour): frame for colour, frame in exposure.colours.items()}
    frames |= {} if exposure.dark is None else {DARK: exposure.dark}
    written = shot.written()
    shared = RawMetadata(capture.id, capture.eye, capture.taken_at, calibration_id=capture.calibration_id, head=head)

    def content(frame: Frame) -> FileContent:
        if (file := written.get(frame.number)) is not None:
            return file
        return picture_files.raw_tiff(frame.counts, frame_metadata(shared, frame))

    return {name: content(frame) for name, frame in frames.items()}


def capture_report(
    shot: ExposedCapture, made: Report, verdict: Verdict, seen: Laterality | None, made_s: float, waited_s: float
) -> CaptureReport:
    """Return the report of a capture, with plain numbers for numpy scalars.

    `made`: report of the reconstruction; `verdict`: the final one; `seen`: laterality of the picture; `made_s`: clock
    seconds at which the picture was made; `waited_s`: seconds since the last read-out that other work took.
    """
    tapped_s = shot.press.tapped_s
    entries = vars(made) | vars(shot.light)
    entries |= {
        "seconds": {"expose": shot.exposure.duration_s, **made.seconds},
        "warnings": (*made.warnings, *shot.notes),
    }
    report = CaptureReport(
        **entries,
        visit=shot.press.target.visit,
        slot=shot.press.target.slot,
        verdict=StoredVerdict(**vars(verdict)),
        laterality=None if seen is None else LateralityEstimate(seen.eye, seen.confidence, seen.disc),
        budget_s=shot.budget_s,
        from_read_out_s=round(made_s - shot.exposure.read_out_s - waited_s, 4),
        from_tap_s=None if tapped_s is None else round(made_s - tapped_s, 4),
        effects=shot.frame.effects,
    )
    return CaptureReport.read(report.as_json())
