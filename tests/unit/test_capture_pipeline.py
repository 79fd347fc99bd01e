"""Capture pipeline by itself, in virtual time: exposure, verdict, steps of the reconstruction, record, live picture."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from device.clock import Deadline, VirtualClock
from device.config.head_file import load_head
from device.errors import CameraMissing, CameraStalled, FrameError, LightFault
from device.head import Head, hazard_of
from device.light_safety.dose_ledger import MemoryLedger
from device.light_safety.guard import GuardedLight
from device.recon.assessment.exposure_split import WHOLE, ExposureSplit
from device.recon.burst_reconstructor import PreparedFrame
from device.recon.colour_reconstructor import without_psf
from device.recon.model.kernels import Pixels
from device.recon.stage import RoundDone, StageResult, Step
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import (
    ChannelUse,
    Colour,
    ExposureSettings,
    Frame,
    Illumination,
    Reconstruction,
    SimulatedEffects,
    Verdict,
    WhiteReference,
)
from services.instrument.capture import ExposedCapture, Press, split_notes
from services.instrument.capture_pipeline import CapturePipeline
from services.instrument.press_exposure import expose_live, expose_press
from services.instrument.time_budget import PACES_S, within_budget
from services.records.capture_target import CaptureTarget
from tests.journey.conftest import SMALL_HEAD
from tests.property.exam_sequences import ROUND_S, ROUNDS, TINY, Conditions, PlainFeedback, TinyReconstructor


@dataclass
class Bench:
    """Pipeline of a small simulated head whose reconstruction is a stand-in, and its parts."""

    world: World
    clock: VirtualClock
    conditions: Conditions
    head: Head
    pipeline: CapturePipeline

    def exposed(self) -> ExposedCapture:
        """Return one exposed capture of the right eye."""
        exposure, verdict = self.pipeline.assess(self.pipeline.expose("OD"))
        press = Press(Future(), "OD", CaptureTarget(visit="v", slot="R-centre"), None)
        return ExposedCapture(
            press,
            "20260101T000000-OD-000001",
            self.clock.wall(),
            exposure,
            light=self.head.light.dose_report(),
            verdict=verdict,
        )


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    (tmp_path / "small.toml").write_text(SMALL_HEAD.replace("haemorrhages = 3", 'kind = "point"'))
    spec = load_head(tmp_path / "small.toml")
    spec = spec.model_copy(update={"camera": spec.camera.model_copy(update=TINY)})
    clock, conditions = VirtualClock(), Conditions()
    world = World(spec, clock)
    light = GuardedLight(SimLight(world), clock, 30.0, hazard_of(spec), MemoryLedger(clock))
    head = Head(spec, SimCamera(world), light, simulated_calibration(world), present_eye=world.present_eye)
    reconstructor = TinyReconstructor(clock, conditions)
    return Bench(
        world, clock, conditions, head, CapturePipeline(head, clock, reconstructor, reconstructor, PlainFeedback())
    )


def test_an_exposure_is_a_lit_and_a_dark_frame_and_leaves_the_lamp_off(bench: Bench) -> None:
    exposure = bench.pipeline.expose("OS")
    assert [frame.illumination is not None for frame in exposure.lit] == [True]
    assert exposure.dark.illumination is None
    assert exposure.duration_s == pytest.approx(2 * bench.head.spec.camera.exposure_s)
    assert bench.world.eye == "OS"
    assert bench.world.illumination is None


@pytest.mark.parametrize(("fault", "error"), [("camera.missing", CameraMissing), ("light.fault", LightFault)])
def test_a_failed_exposure_leaves_the_lamp_off(bench: Bench, fault: str, error: type[Exception]) -> None:
    bench.world.faults.add(fault)
    with pytest.raises(error):
        bench.pipeline.expose("OD")
    with pytest.raises(error):
        expose_live(bench.head, ("OD",), bench.clock)
    assert bench.world.illumination is None


def test_a_reconstruction_yields_a_quick_look_its_rounds_and_the_picture(bench: Bench) -> None:
    shot = bench.exposed()
    begin_s = bench.clock.now_s()
    steps = list(bench.pipeline.reconstruct(shot))
    assert [type(step) for step in steps] == [StageResult, *[RoundDone] * ROUNDS, StageResult, Reconstruction]
    assert bench.clock.now_s() - begin_s == pytest.approx(ROUNDS * ROUND_S)
    assert bench.world.frames == 2, "a reconstruction exposes nothing"


class SeesDeadline(TinyReconstructor):
    """Reconstruction stand-in that keeps its deadline, in clock seconds."""

    due_s = 0.0

    def steps(self, *frames: Pixels, simulated: bool, deadline: Deadline | None = None) -> Iterator[Step]:
        assert deadline is not None
        self.due_s = deadline.due_s
        yield from super().steps(*frames, simulated=simulated, deadline=deadline)


def test_the_budget_counts_from_the_last_read_out_without_the_time_of_other_presses(bench: Bench) -> None:
    solver = SeesDeadline(bench.clock, bench.conditions)
    pipeline = CapturePipeline(bench.head, bench.clock, solver, solver, PlainFeedback())
    shot = replace(bench.exposed(), budget_s=1.0)
    read_out_s = bench.clock.now_s()
    bench.clock.sleep(0.4)  # the verdict
    list(pipeline.reconstruct(shot))
    assert solver.due_s == pytest.approx(read_out_s + 1.0)
    list(pipeline.reconstruct(shot, free_s=read_out_s + 0.3))
    assert solver.due_s == pytest.approx(read_out_s + 1.3)


def test_the_report_has_the_times_from_the_last_read_out_and_from_the_tap(bench: Bench) -> None:
    shot = bench.exposed()
    made_s = bench.clock.now_s() + 0.75
    *_, made = bench.pipeline.reconstruct(shot)
    assert isinstance(made, Reconstruction)
    tapped = replace(shot, press=replace(shot.press, tapped_s=shot.exposure.begin_s - 0.25))
    for of, from_tap_s in ((shot, None), (tapped, pytest.approx(0.25 + shot.exposure.duration_s + 0.75))):
        report = bench.pipeline.record(of, made, shot.verdict, made_s)[0].report
        assert (report.from_read_out_s, report.from_tap_s) == (pytest.approx(0.75), from_tap_s)
    report = bench.pipeline.record(shot, made, shot.verdict, made_s, waited_s=0.5)[0].report
    assert report.from_read_out_s == pytest.approx(0.25), "as the budget counts"


def test_the_shortest_budget_takes_one_frame_in_one_light() -> None:
    target = CaptureTarget(visit="v", slot="R-centre")
    assert (target.frames, target.colours) == (4, ("red",))
    assert within_budget(target, PACES_S["grey"]) == replace(target, frames=1, colours=())
    assert within_budget(target, PACES_S["quick"]) == within_budget(target, PACES_S["standard"]) == target


def test_a_quick_look_between_two_rounds_is_of_the_other_capture(bench: Bench) -> None:
    first, second = bench.exposed(), bench.exposed()
    steps = bench.pipeline.reconstruct(first)
    assert isinstance(next(steps), StageResult)
    assert isinstance(next(steps), RoundDone)
    quick = bench.pipeline.quick_look(second)
    assert not np.array_equal(quick, bench.pipeline.quick_look(first))
    assert isinstance(list(steps)[-1], Reconstruction)


def test_a_useless_frame_gives_the_raw_frame_with_the_error_in_its_report(bench: Bench) -> None:
    shot = bench.exposed()
    bench.conditions.is_frame_useless = True
    (made,) = bench.pipeline.reconstruct(shot)
    assert isinstance(made, Reconstruction)
    assert (made.report.method, made.report.stopped) == ("none", "input.frame")
    assert np.array_equal(made.picture, shot.frame.counts)
    assert made.simulated


def test_a_record_holds_the_report_and_every_file(bench: Bench) -> None:
    shot = bench.exposed()
    *_, made = bench.pipeline.reconstruct(shot)
    assert isinstance(made, Reconstruction)
    capture, files_of = bench.pipeline.record(shot, made, bench.pipeline.reassess(shot, made.report), 2.0)
    assert (capture.id, capture.eye, capture.simulated) == (shot.id, "OD", True)
    assert (capture.report.visit, capture.report.slot, capture.report.budget_s) == ("v", "R-centre", 5.0)
    assert capture.report.seconds["expose"] == pytest.approx(shot.exposure.duration_s)
    assert set(files_of()) == {"raw.tiff", "dark.tiff", "picture.png", "green.jpg", "quick.jpg", "report.json"}


def test_a_record_names_the_effects_of_a_simulated_frame_only(bench: Bench) -> None:
    shot = bench.exposed()
    *_, made = bench.pipeline.reconstruct(shot)
    assert isinstance(made, Reconstruction)
    effects = bench.pipeline.record(shot, made, shot.verdict, 5.0)[0].report.effects
    plan = bench.world.plan
    assert effects == SimulatedEffects(tuple(decision.name for decision in plan if decision.simulated), len(plan))
    assert 0 < len(effects.names) < effects.known
    lit = replace(shot.frame, effects=None)  # as a real camera gives it
    real = replace(shot, exposure=replace(shot.exposure, lit=[lit]))
    report = bench.pipeline.record(real, made, shot.verdict, 5.0)[0].report
    assert "effects" not in report.as_json()


def test_a_live_picture_is_exposed_in_the_aiming_colour(bench: Bench) -> None:
    seen = expose_live(bench.head, ("OD",), bench.clock)
    jpeg, aim = bench.pipeline.live_picture(seen)
    assert seen.frame.illumination is not None
    assert seen.frame.illumination.colour == bench.head.spec.light.preview_colour
    assert seen.dark_s - seen.exposed_s == pytest.approx(bench.head.spec.camera.preview_exposure_s)
    assert jpeg[:2] == b"\xff\xd8"
    assert aim.code == "noeye"
    assert bench.world.illumination is None


class NoColours:
    """Reconstruction of other colours of a head whose calibration has none."""

    others: tuple[Colour, ...] = ()

    def deadline_of_green(self, deadline: Deadline, colours: Collection[Colour]) -> Deadline:
        return deadline

    def steps(self, green: Iterator[Step], *_: object, **__: object) -> Iterator[Step]:
        return green


class RedOnly(NoColours):
    """Reconstruction of red light."""

    others = ("red",)


class NoBursts:
    """Reconstruction of bursts, which is not reached; no frame can be prepared."""

    def prepare(self, counts: Pixels, dark: Pixels | None = None, **options: bool) -> PreparedFrame:
        raise FrameError("nothing is prepared here")

    def steps(self, frames: Sequence[Pixels], *_: object, **__: object) -> Iterator[Step]:
        raise AssertionError("no burst is reconstructed here")


class MovingEye(PlainFeedback):
    """Feedback on an eye that moves by 10 degrees per second in enough light for a split."""

    def speed_deg_per_s(self, now_s: float) -> float | None:
        return 10.0

    def assess(self, counts: Pixels, dark: Pixels, begin_s: float) -> Verdict:
        return Verdict("good", None, {"light_e_per_um2": 200.0})


def test_exposures_are_split_while_the_eye_moves_and_the_report_says_why(bench: Bench) -> None:
    pipeline = CapturePipeline(
        bench.head,
        bench.clock,
        bench.pipeline.reconstructor,
        bench.pipeline.live,
        MovingEye(),
        bursts=NoBursts(),
        colours=RedOnly(),
    )
    first = pipeline.expose("OD", count=1, colours=["red"], split=pipeline.choose_split(1))
    assert [len(first.lit), split_notes(first.split)] == [1, ()], "the light of this eye is not known yet"
    pipeline.assess(first)
    split = pipeline.choose_split(1)
    second = pipeline.expose("OD", count=1, colours=["red"], split=split)
    assert second.split == split
    assert len(second.lit) == split.parts > 1
    exposure_s = bench.head.spec.camera.exposure_s
    assert sum(frame.exposure_s for frame in second.lit) == pytest.approx(exposure_s)
    assert second.dose_j_per_cm2 == pytest.approx(first.dose_j_per_cm2, rel=1e-6), "the same light"
    assert second.dark.exposure_s == second.lit[0].exposure_s, "dark current of a part"
    assert second.colours["red"].exposure_s == exposure_s
    (note,) = split_notes(second.split)
    assert f"split into {len(second.lit)} frames" in note
    assert f"{10 * exposure_s:.2f} degrees" in note


def test_a_resumed_press_says_nothing_of_the_overhead_of_frames(bench: Bench) -> None:
    pipeline = CapturePipeline(
        bench.head, bench.clock, bench.pipeline.reconstructor, bench.pipeline.live, MovingEye(), bursts=NoBursts()
    )
    pipeline.assess(replace(pipeline.expose("OD"), overhead_s=None))
    assert pipeline.choose_split(1) == WHOLE
    pipeline.assess(pipeline.expose("OD"))
    assert pipeline.choose_split(1).parts > 1


class FailsInRed:
    """Camera that stalls while the lamp is red."""

    def __init__(self, bench: Bench) -> None:
        self._camera, self._world, self._clock = bench.head.camera, bench.world, bench.clock
        self.shape = self._camera.shape

    def prepare(self, shot: ExposureSettings) -> None:
        self._camera.prepare(shot)

    def expose(self, shot: ExposureSettings) -> Frame:
        illumination = self._world.illumination
        if illumination is not None and illumination.colour == "red":
            self._clock.sleep(1.0)
            raise CameraStalled("no frame came")
        return self._camera.expose(shot)


def test_other_colours_are_taken_after_the_dark_and_the_lit_frames_and_their_dose_counts(bench: Bench) -> None:
    head = bench.head
    green = expose_press(head, ("OD",), bench.clock, count=2)
    both = expose_press(head, ("OD",), bench.clock, count=2, colours=["red"])
    assert [frame.illumination for frame in both.lit] == [Illumination("green")] * 2
    assert both.colours["red"].illumination == Illumination("red")
    assert both.dark.illumination is None
    numbers = [frame.number for frame in (both.dark, *both.lit, both.colours["red"])]
    assert numbers == sorted(numbers)
    red_j_per_cm2 = head.light.hazard.dose_j_per_cm2(Illumination("red"), head.spec.camera.exposure_s)
    assert both.dose_j_per_cm2 - green.dose_j_per_cm2 == pytest.approx(red_j_per_cm2, rel=1e-3)
    spent = head.light.ledger.spent_j_per_cm2("OD")
    assert spent == pytest.approx(green.dose_j_per_cm2 + both.dose_j_per_cm2, rel=1e-3)
    assert bench.world.illumination is None


def test_a_colour_that_fails_leaves_the_lit_frames_and_its_reason(bench: Bench) -> None:
    before_j_per_cm2 = bench.head.light.ledger.spent_j_per_cm2("OD")
    exposure = expose_press(
        replace(bench.head, camera=FailsInRed(bench)), ("OD",), bench.clock, count=3, colours=["red"]
    )
    assert (len(exposure.lit), dict(exposure.colours)) == (3, {})
    spent_j_per_cm2 = bench.head.light.ledger.spent_j_per_cm2("OD") - before_j_per_cm2
    assert exposure.dose_j_per_cm2 == pytest.approx(spent_j_per_cm2), "the red light was given, too"
    assert exposure.missing == (ChannelUse("red", None, reason="no frame came", code="camera.stalled"),)
    assert exposure.dark.illumination is None
    assert bench.world.illumination is None


class StallsAtLongerExposure:
    """Camera that gives no frame in the dark when its exposure time is raised from that of a part to a whole one."""

    def __init__(self, bench: Bench) -> None:
        self._camera, self._whole_s = bench.head.camera, bench.head.spec.camera.exposure_s
        self.shape = self._camera.shape

    def prepare(self, shot: ExposureSettings) -> None:
        if shot.exposure_s == self._whole_s:
            raise CameraStalled("the sensor did not change its exposure")

    def expose(self, shot: ExposureSettings) -> Frame:
        return self._camera.expose(shot)


def test_a_stall_before_the_other_colours_leaves_the_split_frames_and_its_reason(bench: Bench) -> None:
    head = replace(bench.head, camera=StallsAtLongerExposure(bench))
    split = ExposureSplit(2, motion_deg=1.0, gain_db=1.0, part_s=head.spec.camera.exposure_s / 2)
    exposure = expose_press(head, ("OD",), bench.clock, count=2, colours=["red", "blue"], split=split)
    assert (len(exposure.lit), dict(exposure.colours)) == (4, {})
    assert [(channel.name, channel.reason, channel.code) for channel in exposure.missing] == [
        (colour, "the sensor did not change its exposure", "camera.stalled") for colour in ("red", "blue")
    ]
    assert bench.world.illumination is None


def test_a_colour_without_a_psf_is_not_lit_and_its_reason_kept(bench: Bench) -> None:
    with_colours = CapturePipeline(
        bench.head,
        bench.clock,
        bench.pipeline.reconstructor,
        bench.pipeline.live,
        PlainFeedback(),
        colours=NoColours(),
    )
    exposure = with_colours.expose("OD", colours=["red"])
    assert (dict(exposure.colours), exposure.missing) == ({}, (without_psf("red"),))
    assert bench.pipeline.expose("OD", colours=["red"]).missing == (), "a pipeline of one colour by design"
    assert bench.world.frames == 4


class SeesLights(RedOnly):
    """Colours that keep the light they were given and solve nothing."""

    def __init__(self) -> None:
        self.lights_dn_per_s: Mapping[Colour, float] = {}

    def steps(
        self,
        green: Iterator[Step],
        frames: Mapping[Colour, Pixels],
        dark: Pixels | None = None,
        *,
        simulated: bool,
        deadline: Deadline | None = None,
        missing: Sequence[ChannelUse] = (),
        lights_dn_per_s: Mapping[Colour, float] | None = None,
    ) -> Iterator[Step]:
        self.lights_dn_per_s = lights_dn_per_s or {}
        return green


def seen_lights(bench: Bench, *, white: bool, spoil: bool = False) -> Mapping[Colour, float]:
    """Return the light that the colours of one press were given; `spoil`: its frames have every other row only."""
    reference = WhiteReference((("green", 1.0), ("red", 1.0))) if white else None
    bad = np.zeros(bench.head.camera.shape, np.bool_)
    head = replace(bench.head, calibration=replace(bench.head.calibration, white=reference, bad=bad))
    reconstructor, colours = bench.pipeline.reconstructor, SeesLights()
    pipeline = CapturePipeline(head, bench.clock, reconstructor, reconstructor, PlainFeedback(), colours=colours)
    taken = expose_press(head, ("OD",), bench.clock, colours=["red"])
    shot = replace(bench.exposed(), exposure=taken)
    if spoil:
        cut = {colour: replace(frame, counts=frame.counts[::2]) for colour, frame in taken.colours.items()}
        lit = tuple(replace(frame, counts=frame.counts[::2]) for frame in taken.lit)
        shot = replace(shot, exposure=replace(taken, lit=lit, colours=cut))
    assert isinstance(list(pipeline.reconstruct(shot))[-1], Reconstruction)
    frames = {"green": taken.lit[0], "red": taken.colours["red"]}
    assert taken.dark is not None
    if white and not spoil:
        dark_dn = float(taken.dark.counts.mean())
        assert colours.lights_dn_per_s == {
            colour: pytest.approx((float(frame.counts.mean()) - dark_dn) / frame.exposure_s)
            for colour, frame in frames.items()
        }
    return colours.lights_dn_per_s


def test_the_colours_get_the_light_of_each_frame_where_there_is_a_white_reference(bench: Bench) -> None:
    assert set(seen_lights(bench, white=True)) == {"green", "red"}
    assert seen_lights(bench, white=False) == {}


def test_a_frame_in_another_mode_keeps_its_capture_also_with_a_white_reference(bench: Bench) -> None:
    assert all(np.isnan(light) for light in seen_lights(bench, white=True, spoil=True).values())
