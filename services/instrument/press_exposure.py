"""Exposures of one press in one sequence, dark first, then lit, then in other colours; and of a live picture.

The thread that owns the head calls it. The lamp is off at every exit.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from device.clock import Clock
from device.config.head_file import InstrumentSpec
from device.errors import DiffuscopeError
from device.head import Head
from device.light_safety.burst import burst, require_lit
from device.optics.matrix import lamps_of
from device.recon.assessment.exposure_split import WHOLE, ExposureSplit
from device.recon.burst import JoinedFrame
from device.recon.burst_reconstructor import PreparedFrame
from device.values import ChannelUse, Colour, Counts, ExposureSettings, Eye, Frame, Illumination
from services.errors import RequestRefused
from services.instrument.frame_preparation import AssessedFrame, JoinedBurst
from services.records.capture import OtherColour
from services.records.capture_target import Permit, permit_test_picture

log = logging.getLogger(__name__)

Taken = Callable[[Frame, float, float], None]  # frame, dose and duration of the press until its read-out


@dataclass(frozen=True)
class Exposure:
    """Frames of one press: lit ones, one in each other colour of light, and their dark frame.

    `dark` is None if an interrupted press has none. `begin_s` (clock seconds) and `duration_s` are those of all
    exposures, `dose_j_per_cm2` is their dose. `unusable` holds the reason of each lit frame that must not enter the
    picture, by its index; `missing` each other colour that was not taken, with the reason; `split` how the exposures of
    the lit frames were split; `overhead_s` what a lit frame took longer than its exposure, at most, None if this run
    did not expose it; `ready` what was prepared of the frames during the exposure, by their numbers;
    `burst` the frames as joined during the exposure.
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
    burst: JoinedBurst | None = None

    @property
    def read_out_s(self) -> float:
        """Clock seconds of the last read-out; of an interrupted press, of the loading of its frames."""
        return self.begin_s + self.duration_s

    @property
    def dark_counts(self) -> Counts | None:
        """The counts of the dark frame; None, for that of the calibration, without one."""
        return None if self.dark is None else self.dark.counts

    @property
    def prepared(self) -> Mapping[int, PreparedFrame]:
        """What was prepared of the lit frames, by their index; without useless ones."""
        found = {k: self.ready.get(frame.number) for k, frame in enumerate(self.lit)}
        return {k: frame.prepared for k, frame in found.items() if frame is not None and frame.prepared is not None}

    @property
    def joined(self) -> JoinedFrame | None:
        """The lit frames as joined during the exposure, if they are still in that order."""
        order = tuple(frame.number for frame in self.lit)
        return self.burst.frame if self.burst is not None and self.burst.order == order else None


@dataclass(frozen=True)
class LiveFrame:
    """Frame in aiming light, its time of exposure and the time at which the lamp was off (clock seconds)."""

    frame: Frame
    exposed_s: float
    dark_s: float


def expose_press(
    head: Head,
    eyes: tuple[Eye, ...],
    clock: Clock,
    *,
    in_visit: bool = False,
    count: int = 1,
    colours: Sequence[Colour] = (),
    field: str | None = None,
    taken: Taken = lambda frame, dose_j_per_cm2, exposed_s: None,
    split: ExposureSplit = WHOLE,
    lit_taken: Callable[[], None] = lambda: None,
    permit: Permit = permit_test_picture,
) -> Exposure:
    """Return a dark frame, the frames of up to `count` lit exposures, and one in each of `colours`, in this order.

    With a `split` each of the `count` exposures is split into so many frames of equal length, without more light; the
    dark frame is as long as a part, those in other colours are whole. The dose counts for `eyes`, without a visit
    up to a lower limit. There are fewer lit frames if the guard permits no light for so long. A colour that cannot be
    taken is missing, with the reason; the lit frames are kept. `field`: field of view of the programme, to which a
    simulated eye turns. `taken` is called with each frame after its read-out and must return at once: the lamp may be
    on. So must `lit_taken`, which is called after the last lit frame. `permit` is called before each light.

    Raises the error of `permit`, that of `Head.check` if a part of the head is not ready, LightLimit or LightFault if
    the lamp may not or cannot be on, LightCut if the guard has ended the first lit frame, CameraMissing or
    CameraStalled if the camera fails before the last lit one. The lamp is off at every exit.
    """
    head.check()
    run = _Exposing(head, eyes, clock, in_visit, taken, permit)
    part = ExposureSettings(head.spec.camera.exposure_s if split.part_s is None else split.part_s)
    announce_eye(head, eyes, field)
    head.camera.prepare(part)
    try:
        dark = head.camera.expose(part)  # first: a frame can be prepared as soon as it has been read out
        run.report(dark)
        lit = run.lit(Illumination(head.spec.light.colour), part, count, split.parts)
        overhead_s = run.overhead_s  # of the lit frames
        lit_taken()
        others, missing = run.colours(colours)
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


class _Exposing:
    """Exposures of one press, with their dose until now; begins with its construction.

    `overhead_s`: what a frame of the last light took longer than its exposure, at most.
    """

    def __init__(
        self, head: Head, eyes: tuple[Eye, ...], clock: Clock, in_visit: bool, taken: Taken, permit: Permit
    ) -> None:
        self._head = head
        self._eyes = eyes
        self._clock = clock
        self._in_visit = in_visit
        self._taken = taken
        self._permit = permit
        self.begin_s = self._reported_s = clock.now_s()
        self.overhead_s = 0.0
        self._before_j_per_cm2 = head.light.total_j_per_cm2

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
        now_s = self._clock.now_s()
        lit_s = self._head.light.on_since_s
        begin_s = self._reported_s if lit_s is None else max(self._reported_s, lit_s)  # not the ledger's write before
        self.overhead_s = max(self.overhead_s, now_s - begin_s - frame.exposure_s)
        self._reported_s = now_s
        self._taken(frame, self.given_j_per_cm2, self.duration_s)

    def lit(self, light: Illumination, shot: ExposureSettings, count: int = 1, parts: int = 1) -> tuple[Frame, ...]:
        """Return up to `count` exposures in one light, each split into `parts` frames of `shot`."""
        self._permit()
        self.overhead_s = 0.0
        self._reported_s = self._clock.now_s()
        return burst(
            self._head.camera,
            self._head.light,
            light,
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
        for colour in colours:
            try:
                self._head.camera.prepare(whole)  # in the dark: a sensor may take some frames to change its exposure
                (taken[colour],) = self.lit(self._head.light.hazard.brightest(colour), whole)
            except RequestRefused:  # no consent any more, so no picture
                raise
            except DiffuscopeError as error:
                log.warning("no %s light: %s", colour, error, extra={"code": error.code})
                missing.append(ChannelUse(colour, None, reason=error.message, code=error.code))
        return taken, tuple(missing)


def colours_of_lamp(spec: InstrumentSpec, wanted: Sequence[OtherColour]) -> tuple[OtherColour, ...]:
    """Return the `wanted` colours, amber in place of red on a ring that has amber and no red LEDs.

    Amber light stands for red in the picture. A colour that the ring does not have stays: the press reports it.
    """
    lamps = lamps_of(spec)
    if lamps is None or "red" in lamps or "amber" not in lamps:
        return tuple(wanted)
    return tuple(dict.fromkeys("amber" if colour == "red" else colour for colour in wanted))


def expose_live(head: Head, eyes: tuple[Eye, ...], clock: Clock, *, in_visit: bool = False) -> LiveFrame:
    """Return a frame in aiming light.

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
    return LiveFrame(frame, exposed_s, clock.now_s())


def announce_eye(head: Head, eyes: tuple[Eye, ...], field: str | None = None) -> None:
    """Announce eye and field of view of the next exposure to a simulated head, if `eyes` has exactly one eye.

    The lamp is off.
    """
    if len(eyes) == 1:
        head.present_eye(eyes[0], field)
