"""Steps of one capture: exposure, verdict, reconstruction in steps, record; and live pictures.

The pipeline publishes nothing and knows no state of the exam: the exam loop decides what happens between two steps. One
thread, the one that owns the head, calls it. `taken` and `looked` are called during the exposures, `looked` in the
thread of the preparation.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from device.clock import Clock, Deadline
from device.errors import DiffuscopeError, FrameError
from device.head import Head
from device.recon.assessment.aiming import Aim
from device.recon.assessment.exposure_split import WHOLE, ExposureSplit, PressLight, choose_split, dark_fits
from device.recon.burst_reconstructor import BurstReconstructor
from device.recon.colour_reconstructor import ColourReconstruction, ColourReconstructor, without_psf
from device.recon.estimation.psf_selection import most_likely_psf
from device.recon.frame_run import EyePsf
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_box
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Step, default_schedule
from device.recon.white_balance import light_dn_per_s
from device.values import (
    EYES,
    Calibration,
    ChannelUse,
    Colour,
    Counts,
    Eye,
    Frame,
    Image,
    Reconstruction,
    Report,
    Verdict,
)
from services.imaging import picture_files
from services.instrument.capture import ExposedCapture, capture_files, capture_report
from services.instrument.frame_feedback import FrameAssessor
from services.instrument.frame_preparation import FramePreparation, Looked, ranked
from services.instrument.press_exposure import Exposure, LiveFrame, Taken, expose_press
from services.instrument.time_budget import has_time_for_cylinder, is_of_one_frame
from services.records.blobs import FileContent
from services.records.capture import BUDGET_S, NO_METHOD, Capture, RecordOrigin
from services.records.capture_target import OTHER_COLOURS, Permit, permit_test_picture

log = logging.getLogger(__name__)

PREVIEW_BUDGET_S = 0.2
PREVIEW_PX = 480
INTERRUPTED = "the instrument stopped before this frame was on the disk"


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
        reconstructor: Reconstructor,
        live: Reconstructor,
        feedback: FrameAssessor,
        bursts: BurstReconstructor | None = None,
        colours: ColourReconstructor | None = None,
        origin: Callable[[], RecordOrigin | None] = lambda: None,
    ) -> None:
        self.reconstructor = reconstructor
        self.live = live
        self.bursts = bursts
        self.colours = colours
        self._head = head
        self._clock = clock
        self._feedback = feedback
        self._origin = origin
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
        budget_s: float = BUDGET_S,
        taken: Taken = lambda frame, dose_j_per_cm2, exposed_s: None,
        looked: Looked = lambda picture, simulated: None,
        permit: Permit = permit_test_picture,
    ) -> Exposure:
        """Return a dark frame, up to `exposures(count)` lit ones and one in each of `colours`, as `expose_press`.

        A pipeline of bursts prepares each lit frame while the next one is exposed, and splits the exposures as `split`
        says. `looked` is called in the thread of the preparation, with the quick look of the first useful frame, whose
        refraction and cylinder are estimated meanwhile, if the time budget leaves time for them.
        """
        able = [] if self.colours is None else [other for other in colours if other in self.colours.others]
        run = partial(
            expose_press,
            self._head,
            (eye,),
            self._clock,
            in_visit=in_visit,
            count=self.exposures(count),
            colours=able,
            field=field,
            permit=permit,
        )
        if self.bursts is None:
            exposure = run(taken=taken)
        else:
            colour = self._head.spec.light.colour
            with FramePreparation(
                self._feedback,
                self.bursts,
                colour,
                self._clock.now_s(),
                looked,
                refract=not is_of_one_frame(budget_s),
                cylinder=has_time_for_cylinder(budget_s),
                alone=self.exposures(count) * split.parts == 1,
            ) as preparation:

                def read_out(frame: Frame, dose_j_per_cm2: float, exposed_s: float) -> None:
                    taken(frame, dose_j_per_cm2, exposed_s)
                    preparation.add(frame)

                exposure = run(split=split, taken=read_out, lit_taken=preparation.join)
                exposure = replace(exposure, ready=preparation.finish(), burst=preparation.joined)
        return replace(exposure, missing=(*self._unable(colours), *exposure.missing))

    def exposures(self, count: int) -> int:
        """Return how many exposures in the picture's colour a press for `count` takes: one without bursts."""
        return 1 if self.bursts is None else count

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
            ChannelUse(colour, None, reason=INTERRUPTED, code="colour.interrupted")
            for colour in colours
            if colour not in taken.colours and colour in self.colours.others
        ]
        able = {colour: frame for colour, frame in taken.colours.items() if colour in self.colours.others}
        return replace(taken, colours=able, missing=(*lost, *unable))

    def _unable(self, colours: Sequence[Colour]) -> tuple[ChannelUse, ...]:
        """Return each of `colours` that the pipeline cannot reconstruct; none without other colours."""
        able = colours if self.colours is None else self.colours.others
        return tuple(without_psf(colour) for colour in colours if colour not in able)

    def assess(self, exposure: Exposure) -> tuple[Exposure, Verdict]:
        """Return the exposure with its frames as `ranked`, and the verdict on the first one."""
        verdicts = [self._verdict(frame, exposure) for frame in exposure.lit]
        order, unusable = ranked(verdicts)
        best = order[0]
        light_e_per_um2 = verdicts[best].numbers.get("light_e_per_um2")
        if verdicts[best].word == "good" and light_e_per_um2 is not None and exposure.overhead_s is not None:
            self._known = PressLight(light_e_per_um2 / exposure.lit[best].exposure_s, exposure.overhead_s)
        return replace(exposure, lit=tuple(exposure.lit[k] for k in order), unusable=unusable), verdicts[best]

    def _verdict(self, frame: Frame, exposure: Exposure) -> Verdict:
        """Return the verdict on a lit frame of an exposure."""
        if (ready := exposure.ready.get(frame.number)) is not None:
            return ready.verdict
        return self._feedback.assess(frame.counts, exposure.dark_counts, exposure.begin_s)

    def quick_look(self, shot: ExposedCapture) -> Image:
        """Return the picture of the first stage, cropped to the illuminated field, made now unless it is prepared.

        FrameError if the frame cannot be reconstructed.
        """
        if (prepared := shot.exposure.prepared.get(0)) is not None:
            return prepared.look.stage.picture
        made = self.reconstructor(shot.frame.counts, shot.exposure.dark_counts, quick=True)
        return crop_to_field(made.picture, self._head)

    def reconstruct(self, shot: ExposedCapture, free_s: float = 0.0) -> Iterator[Step]:
        """Yield the steps of the reconstruction within the time budget (time_budget.py); the last one is the picture.

        `free_s`: clock seconds at which the instrument was done with other presses. After a FrameError it is the raw
        frame, with the error in its report: the exposure has cost dose.
        """
        deadline = Deadline(self._clock, max(shot.exposure.read_out_s, free_s) + shot.budget_s)
        try:
            yield from self._steps(shot, deadline)
        except FrameError as error:
            log.warning("reconstruction failed: %s", error, extra={"code": error.code, "about": shot.id})
            yield unreconstructed(shot.frame, error)

    def _steps(self, shot: ExposedCapture, deadline: Deadline) -> Iterator[Step]:
        exposure = shot.exposure
        dark = exposure.dark_counts
        simulated = shot.frame.simulated
        of_green = deadline
        if self.colours is not None:
            of_green = self.colours.deadline_of_green(deadline, exposure.colours)
        if self.bursts is None:
            green = self.reconstructor.steps(shot.frame.counts, dark, simulated=simulated, deadline=of_green)
        else:
            green = self.bursts.steps(
                [frame.counts for frame in exposure.lit],
                dark,
                simulated=simulated,
                deadline=of_green,
                unusable=exposure.unusable,
                prepared=exposure.prepared,
                joined=exposure.joined,
                eye_psf=EyePsf.STORED if is_of_one_frame(shot.budget_s) else EyePsf.ESTIMATED,
            )
        if self.colours is None or not (exposure.colours or exposure.missing):
            return green
        colours = {colour: [frame.counts] for colour, frame in exposure.colours.items()}
        if exposure.dark is not None:
            dark_s = exposure.dark.exposure_s
            dark = dark if all(dark_fits(frame.exposure_s, dark_s) for frame in exposure.colours.values()) else None
        return self.colours.steps(
            green,
            colours,
            dark,
            simulated=simulated,
            deadline=deadline,
            missing=exposure.missing,
            lights_dn_per_s=_lights_dn_per_s(exposure, self._head.calibration, dark),
        )

    def reassess(self, shot: ExposedCapture, report: Report) -> Verdict:
        """Return the final verdict, from the first one, the report and the number of tries of the slot."""
        return self._feedback.reassess(shot.verdict, report, shot.press.target)

    def record(
        self, shot: ExposedCapture, made: Reconstruction, verdict: Verdict, made_s: float, waited_s: float = 0.0
    ) -> tuple[Capture, Callable[[], dict[str, FileContent]]]:
        """Return a capture with its report and laterality estimate, and a function that returns its files by name.

        That function waits until the frames of the press are on the disk, or have failed to be. `made_s`: clock seconds
        at which the picture was made; `waited_s`: seconds since the last read-out that other work took.
        """
        shown = crop_to_field(made.picture, self._head)
        side = self._feedback.estimate_laterality(shown, verdict, shot.press.target)
        report = replace(capture_report(shot, made.report, verdict, side, made_s, waited_s), device=self._origin())
        calibration_id = self._head.calibration.id
        capture = Capture(shot.id, shot.press.eye, shot.taken_at, made.simulated, calibration_id, report, {})
        colour = made.colour if isinstance(made, ColourReconstruction) else None
        return capture, partial(capture_files, capture, self._head.spec.name, shot, shown, colour)

    def live_picture(self, seen: LiveFrame) -> tuple[bytes, Aim]:
        """Return the live picture (JPEG) of a frame, and its aiming hint.

        Of a frame with too many saturated pixels the raw frame is shown: its hint says that it is too bright.
        FrameError for a frame of another shape.
        """
        counts, simulated = seen.frame.counts, seen.frame.simulated
        aim = self._feedback.aim(counts, seen.exposed_s)
        deadline = Deadline.after(self._clock, PREVIEW_BUDGET_S)
        try:
            picture = self.live(counts, simulated=simulated, deadline=deadline, quick=True).picture
        except FrameError:  # saturated: for any other useless frame the hint above has raised it
            picture = counts.astype(np.float32)
        jpeg = picture_files.to_jpeg(crop_to_field(picture, self._head), PREVIEW_PX, simulated)
        return jpeg, aim


def _lights_dn_per_s(exposure: Exposure, calibration: Calibration, colours_dark: Counts | None) -> dict[Colour, float]:
    """Return the light of each colour of a press at full drive; none without a white reference to compare with."""
    lights = dict[Colour, float]()
    first = exposure.lit[0]
    for frame in (first, *exposure.colours.values()) if calibration.white is not None else ():
        if (light := frame.illumination) is not None:
            dark = exposure.dark_counts if frame is first else colours_dark
            lights[light.colour] = light_dn_per_s(frame.counts, dark, calibration, frame.exposure_s * light.level)
    return lights


def plan_pipeline(
    head: Head, clock: Clock, plans: Path, origin: Callable[[], RecordOrigin | None] = lambda: None
) -> CapturePipeline:
    """Return the pipeline of a head after all planning; `plans` is the folder of the FFT plans.

    `origin` returns the origin of a capture, None if its device has no identity.

    With PSFs of several depths a dark and a lit frame are exposed, to choose among them. Raises the errors of
    `expose_press` then.
    """
    planner = Planner(plans)
    light = head.spec.light
    shape = head.camera.shape
    calibration = head.calibration.for_colour(light.colour)
    live_calibration = head.calibration.for_colour(light.preview_colour)
    index = _best_psf(head, clock, calibration, planner)
    recipes = default_schedule(calibration, shape, index)
    reconstructor = Reconstructor(calibration, shape, planner, clock, recipes, index)
    is_recording = head.spec.camera.backend == "replay"  # whose next raw may show something else
    bursts = None if is_recording else BurstReconstructor(reconstructor, planner)
    takes_colours = bursts is not None and light.colour == "green"
    measured = {psf.colour for psf in head.calibration.psfs}
    others: dict[Colour, Reconstructor] = {}
    for colour in OTHER_COLOURS if takes_colours else ():
        if colour in measured:
            own = head.calibration.for_colour(colour)
            others[colour] = Reconstructor(own, shape, planner, clock, recipes, index, refract=False)
        elif None in measured:  # a PSF that holds for any colour
            others[colour] = reconstructor
    colours = ColourReconstructor(reconstructor, others) if takes_colours else None
    live = others.get(light.preview_colour, reconstructor)
    if light.preview_colour not in others and live_calibration.psfs[0] is not calibration.psfs[0]:  # an own PSF
        live = Reconstructor(live_calibration, shape, planner, clock, recipes[:1], refract=False)
    feedback = FrameAssessor(calibration, shape, planner, index, head.spec)
    return CapturePipeline(head, clock, reconstructor, live, feedback, bursts, colours, origin)


def _best_psf(head: Head, clock: Clock, calibration: Calibration, planner: Planner) -> int:
    """Return the index of the PSF with the highest likelihood for one frame exposed now; 0 if there is only one.

    A recording may hold PSFs of several depths.
    """
    if len(calibration.psfs) == 1:
        return 0
    (frame,) = expose_press(head, EYES, clock).lit
    return most_likely_psf(calibration, frame.counts, planner)[0]


def crop_to_field(image: Image, head: Head) -> Image:
    """Return the picture cropped to the illuminated field; a picture of another shape than the camera stays whole."""
    whole = image.shape[:2] != head.camera.shape  # the camera runs in another mode
    return image if whole else image[field_box(head.calibration, head.camera.shape)]


def unreconstructed(frame: Frame, error: DiffuscopeError) -> Reconstruction:
    """Return the raw frame as picture, with the error in the report, for a failed reconstruction."""
    report = Report(method=NO_METHOD, rounds=0, stopped=error.code, warnings=(error.message,), frames=())
    return Reconstruction(frame.counts.astype(np.float32), report, frame.simulated)
