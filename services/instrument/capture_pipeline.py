"""Steps of one capture: dark and lit exposures, verdict, reconstruction in steps, record; and live pictures.

The pipeline publishes nothing and knows no state of the exam: the exam loop decides what happens between two steps. One
thread, the one that owns the head, calls it. `taken` and `looked` are called during the exposures, `looked` in the
thread of the preparation.
"""

import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np

from device.clock import Clock, Deadline
from device.errors import DiffuscopeError, FrameError
from device.head import Head
from device.light_safety.burst import burst, require_lit
from device.recon.assessment.aiming import Aim
from device.recon.assessment.exposure_split import WHOLE, ExposureSplit, PressLight, choose_split, dark_fits
from device.recon.assessment.frame_quality import Verdict
from device.recon.assessment.laterality import Laterality
from device.recon.burst_reconstructor import BurstReconstructor, PreparedFrame
from device.recon.colour_reconstructor import ColourReconstruction, ColourReconstructor, without_psf
from device.recon.estimation.psf_selection import most_likely_psf
from device.recon.estimation.refraction.estimator import RefractionEstimator
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_box
from device.recon.model.kernels import Pixels
from device.recon.reconstructor import Reconstructor, Step, default_schedule
from device.recon.white_balance import light_dn_per_s
from device.values import (
    EYES,
    Calibration,
    ChannelUse,
    Colour,
    Counts,
    ExposureSettings,
    Eye,
    Frame,
    Illumination,
    Image,
    Reconstruction,
    Report,
)
from services.imaging import picture_files
from services.instrument.capture import FRAME_QUALITY, ExposedCapture, capture_files, capture_report
from services.instrument.frame_feedback import FrameAssessor
from services.instrument.frame_preparation import AssessedFrame, FramePreparation, Looked, ignore_look
from services.records.blobs import FileContent
from services.records.capture import NO_METHOD, Capture, RecordOrigin
from services.records.capture_target import OTHER_COLOURS, CaptureTarget

log = logging.getLogger(__name__)

PREVIEW_BUDGET_S = 0.2
PREVIEW_PX = 480
INTERRUPTED = "the instrument stopped before this frame was on the disk"

Taken = Callable[[Frame, float, float], None]  # frame, dose and duration of the press until its read-out


def ignore_frame(_: Frame, dose_j_per_cm2: float, exposed_s: float) -> None:
    """Do nothing with a frame that was taken."""


class FrameReconstructor(Protocol):
    """Reconstruction of frames in steps, as `device.recon.reconstructor.Reconstructor` does it."""

    @property
    def refractor(self) -> RefractionEstimator | None:
        """Estimator of the refraction; None if the calibration permits none."""

    def steps(
        self, counts: Pixels, dark: Pixels | None = None, *, simulated: bool, deadline: Deadline | None = None
    ) -> Iterator[Step]:
        """Yield the result of each stage, ROUND_DONE after each round of the last one, and the picture."""

    def __call__(
        self,
        counts: Pixels,
        dark: Pixels | None = None,
        *,
        simulated: bool = False,
        deadline: Deadline | None = None,
        quick: bool = False,
    ) -> Reconstruction:
        """Return the picture of all stages, or with `quick` of the first one."""


class FramesReconstructor(Protocol):
    """Reconstruction of bursts in steps, as `device.recon.burst_reconstructor.BurstReconstructor` does it."""

    def prepare(self, counts: Pixels, dark: Pixels | None = None, *, refract: bool = False) -> PreparedFrame:
        """Return a frame with its quick look, ready for `steps`; `refract`: see there. FrameError for a useless one."""

    def steps(
        self,
        frames: Sequence[Pixels],
        dark: Pixels | None = None,
        *,
        simulated: bool,
        deadline: Deadline | None = None,
        unusable: Mapping[int, str] | None = None,
        prepared: Mapping[int, PreparedFrame] | None = None,
    ) -> Iterator[Step]:
        """Yield the quick look of the first frame, a pause after each frame and round, and the picture."""


class ColoursReconstructor(Protocol):
    """Reconstruction of other colours in steps, as `device.recon.colour_reconstructor.ColourReconstructor` does it."""

    @property
    def others(self) -> Collection[Colour]:
        """Colours that can be reconstructed."""

    def deadline_of_green(self, deadline: Deadline, colours: Collection[Colour]) -> Deadline:
        """Return the deadline of the picture in green, earlier by what `colours` take at least."""

    def steps(
        self,
        green: Iterator[Step],
        frames: Mapping[Colour, Sequence[Pixels]],
        dark: Pixels | None = None,
        *,
        simulated: bool,
        deadline: Deadline | None = None,
        missing: Sequence[ChannelUse] = (),
        lights_dn_per_s: Mapping[Colour, float] | None = None,
    ) -> Iterator[Step]:
        """Yield the steps of `green`, ROUND_DONE after each round of other colours, and the picture with colours."""


class FrameFeedback(Protocol):
    """Assessment of frames and pictures, as `FrameAssessor` does it."""

    def aim(self, counts: Pixels, exposed_s: float) -> Aim:
        """Return the aiming hint after one more live frame."""

    def speed_deg_per_s(self, now_s: float) -> float | None:
        """Return the speed of the eye in the aiming stream; None if it is unknown."""

    def assess(self, counts: Pixels, dark: Pixels | None, begin_s: float) -> Verdict:
        """Return the verdict on a raw frame."""

    def reassess(self, first: Verdict, report: Report, target: CaptureTarget) -> Verdict:
        """Return the final verdict after the reconstruction."""

    def estimate_laterality(self, picture: Image, verdict: Verdict, target: CaptureTarget) -> Laterality | None:
        """Return the laterality estimate, or None."""


@dataclass(frozen=True)
class Exposure:
    """Frames of one press: lit ones, one in each other colour of light, and their dark frame.

    `dark` is None if an interrupted press has none. `begin_s` (clock seconds) and `duration_s` are those of all
    exposures, `dose_j_per_cm2` is their dose. `unusable` holds the reason of each lit frame that must not enter the
    picture, by its index; `missing` each other colour that was not taken, with the reason; `split` how the exposures of
    the lit frames were split; `overhead_s` what a lit frame took longer than its exposure, at most, None if this run
    did not expose it; `ready` what was prepared of the frames during the exposure, by their numbers.
    """

    lit: tuple[Frame, ...]
    colours: Mapping[Colour, Frame]
    dark: Frame | None
    begin_s: float
    duration_s: float
    dose_j_per_cm2: float
    unusable: Mapping[int, str] = field(default_factory=dict)
    missing: tuple[ChannelUse, ...] = ()
    split: ExposureSplit = WHOLE
    overhead_s: float | None = None
    ready: Mapping[int, AssessedFrame] = field(default_factory=dict)


@dataclass(frozen=True)
class LiveFrame:
    """Frame in aiming light, its time of exposure and the time at which the lamp was off (clock seconds)."""

    frame: Frame
    exposed_s: float
    dark_s: float


@dataclass(frozen=True)
class CaptureRecord:
    """Capture before its storage: its row, its exposure, and the picture of the illuminated field; `head`: its name.

    `colour` is the picture in colour, if there is one.
    """

    capture: Capture
    shot: ExposedCapture
    shown: Image
    head: str
    colour: Image | None = None

    def files(self) -> dict[str, FileContent]:
        """Return the files by name.

        Waits until the frames of the press are on the disk, or have failed to be.
        """
        return capture_files(self.capture, self.head, self.shot, self.shown, self.colour)


class CapturePipeline:
    """Steps of the captures and live pictures of one head.

    `reconstructor` makes the pictures of captures of one frame, `bursts` those of several (None: a press takes one
    frame), `live` those of live pictures, whose colour may have another PSF. `colours` solves the other colours of
    light (None: a press takes the picture's colour only). `origin` returns the origin of a capture.
    """

    def __init__(
        self,
        head: Head,
        clock: Clock,
        reconstructor: FrameReconstructor,
        live: FrameReconstructor,
        feedback: FrameFeedback,
        bursts: FramesReconstructor | None = None,
        colours: ColoursReconstructor | None = None,
        origin: Callable[[], RecordOrigin | None] = lambda: None,
    ) -> None:
        self.reconstructor, self.live, self.bursts, self.colours = reconstructor, live, bursts, colours
        self._head, self._clock, self._feedback, self._origin = head, clock, feedback, origin
        self._known: PressLight | None = None  # of the last good press

    def expose(
        self,
        eye: Eye,
        *,
        in_visit: bool = False,
        count: int = 1,
        split: ExposureSplit = WHOLE,
        colours: Sequence[Colour] = (),
        field: str | None = None,
        taken: Taken = ignore_frame,
        looked: Looked = ignore_look,
    ) -> Exposure:
        """Return a dark frame, up to `count` lit ones and one in each of `colours`, as the function `expose`.

        A pipeline of bursts prepares each lit frame while the next one is exposed, and splits the exposures as `split`
        says. `looked` is called in the thread of the preparation, with the quick look of the first useful frame.
        """
        count, split = (count, split) if self.bursts is not None else (1, WHOLE)
        unable = self._unable(colours)
        able = [] if self.colours is None else [one for one in colours if one in self.colours.others]
        run = partial(
            expose,
            self._head,
            (eye,),
            self._clock,
            in_visit=in_visit,
            count=count,
            colours=able,
            field=field,
            split=split,
        )
        if self.bursts is None:
            exposure = run(taken=taken)
        else:
            colour, begin_s = self._head.spec.light.colour, self._clock.now_s()
            with FramePreparation(self._feedback, self.bursts, colour, begin_s, looked) as preparation:

                def read_out(frame: Frame, dose_j_per_cm2: float, exposed_s: float) -> None:
                    taken(frame, dose_j_per_cm2, exposed_s)
                    preparation.add(frame)

                exposure = run(taken=read_out)
                exposure = replace(exposure, ready=preparation.finish())
        return replace(exposure, missing=(*unable, *exposure.missing))

    def choose_split(self, count: int) -> ExposureSplit:
        """Return the split of the `count` exposures of the next press while the eye moves.

        By `exposure_split.choose_split`, from the speed of the eye in the aiming stream, and light and overhead of the
        last good press.
        """
        if self.bursts is None:
            return WHOLE
        speed_deg_per_s = self._feedback.speed_deg_per_s(self._clock.now_s())
        return choose_split(count, self._head.spec.camera.exposure_s, speed_deg_per_s, self._known)

    def resume(self, taken: Exposure, colours: Sequence[Colour]) -> Exposure:
        """Return the frames of an interrupted press, with the reason of each of its `colours` that has none."""
        if self.colours is None:
            return replace(taken, colours={})
        unable = self._unable(colours)
        lost = [
            ChannelUse(one, None, reason=INTERRUPTED, code="colour.interrupted")
            for one in colours
            if one not in taken.colours and one in self.colours.others
        ]
        able = {colour: frame for colour, frame in taken.colours.items() if colour in self.colours.others}
        return replace(taken, colours=able, missing=(*lost, *unable))

    def _unable(self, colours: Sequence[Colour]) -> tuple[ChannelUse, ...]:
        """Return each of `colours` that the pipeline cannot reconstruct; none without other colours."""
        able = colours if self.colours is None else self.colours.others
        return tuple(without_psf(one) for one in colours if one not in able)

    def assess(self, exposure: Exposure) -> tuple[Exposure, Verdict]:
        """Return the exposure with its first good frame at the front, and the verdict on that frame.

        Without a good frame the order stays, and the verdict is that on the first one. Frames with another verdict than
        the first one are marked as unusable.
        """
        verdicts = [self._verdict(frame, exposure) for frame in exposure.lit]
        best = next((k for k, verdict in enumerate(verdicts) if verdict.word == "good"), 0)
        light_e_per_um2 = verdicts[best].numbers.get("light_e_per_um2")
        if verdicts[best].word == "good" and light_e_per_um2 is not None and exposure.overhead_s is not None:
            self._known = PressLight(light_e_per_um2 / exposure.lit[best].exposure_s, exposure.overhead_s)
        order = [best, *(k for k in range(len(verdicts)) if k != best)]
        unusable = {
            place: f"{FRAME_QUALITY}: {verdicts[k].code}"
            for place, k in enumerate(order)
            if verdicts[k].code != verdicts[best].code
        }
        return replace(exposure, lit=tuple(exposure.lit[k] for k in order), unusable=unusable), verdicts[best]

    def _verdict(self, frame: Frame, exposure: Exposure) -> Verdict:
        """Return the verdict on a lit frame of an exposure."""
        if (ready := exposure.ready.get(frame.number)) is not None:
            return ready.verdict
        return self._feedback.assess(frame.counts, counts_of(exposure.dark), exposure.begin_s)

    def quick_look(self, shot: ExposedCapture) -> Image:
        """Return the picture of the first stage, cropped to the illuminated field; FrameError for a useless frame."""
        if (prepared := shot.prepared.get(0)) is not None:
            return prepared.look.picture
        made = self.reconstructor(shot.frame.counts, counts_of(shot.dark), quick=True)
        return crop_to_field(made.picture, self._head)

    def reconstruct(self, shot: ExposedCapture, budget_s: float) -> Iterator[Step]:
        """Yield the steps of the reconstruction within `budget_s` seconds; the last one is the picture.

        After a FrameError it is the raw frame, with the error in its report: the exposure has cost dose.
        """
        deadline = Deadline.after(self._clock, budget_s)
        try:
            yield from self._steps(shot, deadline)
        except FrameError as error:
            log.warning("reconstruction failed: %s", error, extra={"code": error.code, "about": shot.id})
            yield unreconstructed(shot.frame, error)

    def _steps(self, shot: ExposedCapture, deadline: Deadline) -> Iterator[Step]:
        dark, simulated, of_green = counts_of(shot.dark), shot.frame.simulated, deadline
        if self.colours is not None:
            of_green = self.colours.deadline_of_green(deadline, shot.colours)
        if self.bursts is None:
            green = self.reconstructor.steps(shot.frame.counts, dark, simulated=simulated, deadline=of_green)
        else:
            counts = [frame.counts for frame in shot.frames]
            green = self.bursts.steps(
                counts, dark, simulated=simulated, deadline=of_green, unusable=shot.unusable, prepared=shot.prepared
            )
        if self.colours is None or not (shot.colours or shot.missing):
            return green
        colours = {colour: [frame.counts] for colour, frame in shot.colours.items()}
        if shot.dark is not None:
            dark_s = shot.dark.exposure_s
            dark = dark if all(dark_fits(one.exposure_s, dark_s) for one in shot.colours.values()) else None
        return self.colours.steps(
            green,
            colours,
            dark,
            simulated=simulated,
            deadline=deadline,
            missing=shot.missing,
            lights_dn_per_s=_lights_dn_per_s(shot, self._head.calibration, dark),
        )

    def reassess(self, shot: ExposedCapture, report: Report) -> Verdict:
        """Return the final verdict, from the first one, the report and the number of tries of the slot."""
        return self._feedback.reassess(shot.verdict, report, shot.press.target)

    def record(self, shot: ExposedCapture, made: Reconstruction, verdict: Verdict, budget_s: float) -> CaptureRecord:
        """Return the record of a capture with its report, laterality estimate and shown picture."""
        shown = crop_to_field(made.picture, self._head)
        side = self._feedback.estimate_laterality(shown, verdict, shot.press.target)
        report = replace(capture_report(shot, made.report, verdict, side, budget_s), device=self._origin())
        id, eye, taken_at, calibration_id = shot.id, shot.press.eye, shot.taken_at, self._head.calibration.id
        capture = Capture(id, eye, taken_at, made.simulated, calibration_id, report, {})
        colour = made.colour if isinstance(made, ColourReconstruction) else None
        return CaptureRecord(capture, shot, shown, self._head.spec.name, colour)

    def expose_live(self, eyes: tuple[Eye, ...], *, in_visit: bool = False) -> LiveFrame:
        """Return a frame in aiming light, whose dose counts for `eyes`; without a visit a lower limit applies."""
        return LiveFrame(*expose_live(self._head, eyes, self._clock, in_visit=in_visit))

    def live_picture(self, seen: LiveFrame) -> tuple[bytes, Aim]:
        """Return the live picture (JPEG) of a frame, and its aiming hint."""
        counts, deadline = seen.frame.counts, Deadline.after(self._clock, PREVIEW_BUDGET_S)
        made = self.live(counts, simulated=seen.frame.simulated, deadline=deadline, quick=True)
        jpeg = picture_files.to_jpeg(crop_to_field(made.picture, self._head), PREVIEW_PX, made.simulated)
        return jpeg, self._feedback.aim(counts, seen.exposed_s)


def _lights_dn_per_s(
    shot: ExposedCapture, calibration: Calibration, colours_dark: Counts | None
) -> dict[Colour, float]:
    """Return the light of each colour of a press at full drive; none without a white reference to compare with."""
    lights = dict[Colour, float]()
    for frame in (shot.frame, *shot.colours.values()) if calibration.white is not None else ():
        if (glow := frame.illumination) is not None:
            dark = counts_of(shot.dark) if frame is shot.frame else colours_dark
            lights[glow.colour] = light_dn_per_s(frame.counts, dark, calibration, frame.exposure_s * glow.level)
    return lights


def plan_pipeline(
    head: Head, clock: Clock, plans: Path, origin: Callable[[], RecordOrigin | None] = lambda: None
) -> CapturePipeline:
    """Return the pipeline of a head after all planning; `plans` is the folder of the FFT plans.

    `origin` returns the origin of a capture, None if its device has no identity.

    With PSFs of several depths one frame is exposed, to choose among them. Raises the errors of `expose` then.
    """
    planner, light, shape = Planner(plans), head.spec.light, head.camera.shape
    calibration, live = (head.calibration.for_colour(colour) for colour in (light.colour, light.preview_colour))
    index = _best_psf(head, clock, calibration, planner)
    recipes = default_schedule(calibration, shape, index)
    reconstructor = live_reconstructor = Reconstructor(calibration, shape, planner, clock, recipes, index)
    is_recording = head.spec.camera.backend == "replay"  # whose next raw may show something else
    bursts = None if is_recording else BurstReconstructor(reconstructor, planner)
    others: dict[Colour, Reconstructor] = {}
    takes_colours, measured = (
        bursts is not None and light.colour == "green",
        {psf.colour for psf in head.calibration.psfs},
    )
    for colour in OTHER_COLOURS if takes_colours else ():
        if colour in measured:
            own = head.calibration.for_colour(colour)
            others[colour] = Reconstructor(own, shape, planner, clock, recipes, index, refract=False)
        elif None in measured:  # a PSF that holds for any colour
            others[colour] = reconstructor
    colours = ColourReconstructor(reconstructor, others) if takes_colours else None
    if light.preview_colour in others:
        live_reconstructor = others[light.preview_colour]
    elif live.psfs[0] is not calibration.psfs[0]:  # the colour of the live pictures has a PSF of its own
        live_reconstructor = Reconstructor(live, shape, planner, clock, recipes[:1], refract=False)
    feedback = FrameAssessor(calibration, shape, planner, index, head.spec.camera)
    return CapturePipeline(head, clock, reconstructor, live_reconstructor, feedback, bursts, colours, origin)


def _best_psf(head: Head, clock: Clock, calibration: Calibration, planner: Planner) -> int:
    """Return the index of the PSF with the highest likelihood for one frame exposed now; 0 if there is only one.

    A recording may hold PSFs of several depths.
    """
    if len(calibration.psfs) == 1:
        return 0
    (frame,) = expose(head, EYES, clock).lit
    return most_likely_psf(calibration, frame.counts, planner)[0]


def expose(
    head: Head,
    eyes: tuple[Eye, ...],
    clock: Clock,
    *,
    in_visit: bool = False,
    count: int = 1,
    colours: Sequence[Colour] = (),
    field: str | None = None,
    taken: Taken = ignore_frame,
    split: ExposureSplit = WHOLE,
) -> Exposure:
    """Return a dark frame, up to `count` lit ones, and one in each of `colours`; they are exposed in this order.

    With a `split` each of the `count` exposures is split into so many frames of equal length, without more light; the
    dark frame is as long as a part, those in other colours are whole. The dose counts for `eyes`, without a visit
    up to a lower limit. There are fewer lit frames if the guard permits no light for so long. A colour that cannot be
    taken is missing, with the reason; the lit frames are kept. `field`: field of view of the programme, to which a
    simulated eye turns. `taken` is called with each frame after its read-out and must return at once: the lamp may be
    on.

    Raises the error of `Head.check` if a part of the head is not ready, LightLimit or LightFault if the lamp may not or
    cannot be on. The lamp is off at every exit.
    """
    head.check()
    run, part = _Exposing(head, eyes, clock, in_visit, taken), _part_of(head, split)
    announce_eye(head, eyes, field)
    head.camera.prepare(part)
    try:
        dark = head.camera.expose(part)  # first: a frame can be prepared as soon as it has been read out
        run.report(dark)
        lit = run.lit(Illumination(head.spec.light.colour), part, count, split.parts)
        overhead_s, (others, missing) = run.overhead_s, run.colours(colours)
        return Exposure(
            lit,
            others,
            dark,
            run.begin_s,
            run.duration_s,
            run.given_j_per_cm2,
            missing=missing,
            split=split,
            overhead_s=overhead_s,
        )
    finally:
        head.light.off()


def _part_of(head: Head, split: ExposureSplit) -> ExposureSettings:
    return ExposureSettings(head.spec.camera.exposure_s if split.part_s is None else split.part_s)


class _Exposing:
    """Exposures of one press, with their dose until now; begins with its construction.

    `overhead_s`: what a frame of the last light took longer than its exposure, at most.
    """

    def __init__(self, head: Head, eyes: tuple[Eye, ...], clock: Clock, in_visit: bool, taken: Taken) -> None:
        self._head, self._eyes, self._clock, self._in_visit, self._taken = head, eyes, clock, in_visit, taken
        self.begin_s = self._reported_s = clock.now_s()
        self.overhead_s, self._before_j_per_cm2 = 0.0, head.light.total_j_per_cm2

    @property
    def duration_s(self) -> float:
        """Seconds since the begin."""
        return self._clock.now_s() - self.begin_s

    @property
    def given_j_per_cm2(self) -> float:
        """Dose of this press until now, with that of a light whose frame failed."""
        light = self._head.light
        return light.total_j_per_cm2 - self._before_j_per_cm2 + light.running_j_per_cm2

    def report(self, frame: Frame) -> None:
        """Report a frame after its read-out, with the dose until now."""
        now_s, lit_s = self._clock.now_s(), self._head.light.on_since_s
        begin_s = self._reported_s if lit_s is None else max(self._reported_s, lit_s)  # not the ledger's write before
        self.overhead_s = max(self.overhead_s, now_s - begin_s - frame.exposure_s)
        self._reported_s = now_s
        self._taken(frame, self.given_j_per_cm2, self.duration_s)

    def lit(self, glow: Illumination, shot: ExposureSettings, count: int = 1, parts: int = 1) -> tuple[Frame, ...]:
        """Return up to `count` exposures in one light, each split into `parts` frames of `shot`."""
        camera, self.overhead_s, self._reported_s = self._head.camera, 0.0, self._clock.now_s()
        return burst(
            camera,
            self._head.light,
            glow,
            shot,
            count,
            self._clock,
            self._eyes,
            in_visit=self._in_visit,
            parts=parts,
            whole_s=self._head.spec.camera.exposure_s,
            taken=self.report,
        )

    def colours(self, colours: Sequence[Colour]) -> tuple[dict[Colour, Frame], tuple[ChannelUse, ...]]:
        """Return one frame in each of `colours`, and each that could not be taken, with the reason."""
        taken: dict[Colour, Frame] = {}
        missing: list[ChannelUse] = []
        whole = ExposureSettings(self._head.spec.camera.exposure_s)
        if colours:
            self._head.camera.prepare(whole)  # in the dark: a sensor may take some frames to change its exposure
        for colour in colours:
            try:
                (taken[colour],) = self.lit(self._head.light.hazard.brightest(colour), whole)
            except DiffuscopeError as error:
                log.warning("no %s light: %s", colour, error, extra={"code": error.code})
                missing.append(ChannelUse(colour, None, reason=error.message, code=error.code))
        return taken, tuple(missing)


def expose_live(
    head: Head, eyes: tuple[Eye, ...], clock: Clock, *, in_visit: bool = False
) -> tuple[Frame, float, float]:
    """Return a frame in aiming light, its time of exposure and the time at which the lamp was off (clock seconds).

    The dose counts for `eyes`, without a visit up to a lower limit. The lamp is off at every exit.
    """
    shot = ExposureSettings(head.spec.camera.preview_exposure_s)
    announce_eye(head, eyes)
    head.camera.prepare(shot)
    try:
        with head.light.on(Illumination(head.spec.light.preview_colour), eyes, in_visit=in_visit):
            exposed_s = clock.now_s()
            frame = require_lit(head.camera.expose(shot))
    finally:
        head.light.off()
    return frame, exposed_s, clock.now_s()


def announce_eye(head: Head, eyes: tuple[Eye, ...], field: str | None = None) -> None:
    """Announce eye and field of view of the next exposure to a simulated head, if `eyes` has exactly one eye.

    The lamp is off.
    """
    if len(eyes) == 1:
        head.present_eye(eyes[0], field)


def prepared_frames(exposure: Exposure) -> dict[int, PreparedFrame]:
    """Return what was prepared of the lit frames of an exposure, by their index."""
    found = {k: exposure.ready.get(frame.number) for k, frame in enumerate(exposure.lit)}
    return {k: one.prepared for k, one in found.items() if one is not None and one.prepared is not None}


def counts_of(dark: Frame | None) -> Counts | None:
    """Return the counts of a dark frame; None, for that of the calibration, without one."""
    return None if dark is None else dark.counts


def crop_to_field(image: Image, head: Head) -> Image:
    """Return the picture cropped to the illuminated field; a picture of another shape than the camera stays whole."""
    whole = image.shape[:2] != head.camera.shape  # the camera runs in another mode
    return image if whole else image[field_box(head.calibration, head.camera.shape)]


def unreconstructed(frame: Frame, error: DiffuscopeError) -> Reconstruction:
    """Return the raw frame as picture, with the error in the report, for a failed reconstruction."""
    report = Report(method=NO_METHOD, rounds=0, stopped=error.code, warnings=(error.message,), frames=())
    return Reconstruction(frame.counts.astype(np.float32), report, frame.simulated)
