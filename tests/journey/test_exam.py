"""State machine of the exam: capture, storage and every failure; the lamp is off afterwards in all cases."""

import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from PIL import Image

from device.errors import CameraMissing, CameraStalled, DiffuscopeError, LightFault, StoreFull
from device.errors import LightLimit as Limit
from device.ports import Camera
from device.recon.reconstructor import Reconstructor
from device.values import ExposureSettings, Frame, Illumination, Reconstruction
from services.errors import Busy
from services.imaging.picture_files import read_raw_tiff, to_png
from services.instrument.capture_pipeline import CapturePipeline, crop_to_field, plan_pipeline
from services.instrument.events import EventBus
from tests.journey.asking import live_picture
from tests.journey.conftest import until

RAWS = ("raw.tiff", "raw-1.tiff", "raw-2.tiff", "raw-3.tiff")
FILES = {*RAWS, "raw-red.tiff", "dark.tiff", "picture.png", "colour.png", "green.jpg", "quick.jpg", "report.json"}
KEY = "0123456789abcdef"


def test_a_press_keeps_a_picture_whose_every_file_reads_back(old_rig: Any) -> None:
    kept = old_rig.exam.press("OS").result(30)
    assert old_rig.world.illumination is None
    assert old_rig.store.captures(1) == [kept]
    assert set(kept.files) == FILES
    raw, metadata = read_raw_tiff(old_rig.store.read(kept.id, "raw.tiff"))
    dark, dark_metadata = read_raw_tiff(old_rig.store.read(kept.id, "dark.tiff"))
    assert raw.shape == dark.shape == (135, 240)
    assert raw.max() > dark.max() + 500
    assert metadata.illumination == Illumination("green")
    assert dark_metadata.illumination is None
    assert metadata.eye == kept.eye == "OS"
    report = json.loads(old_rig.store.read(kept.id, "report.json"))
    assert report == kept.report.as_json() | {"simulated": True}
    assert report["stopped"] == "done"
    assert report["bin"] == 1
    assert [frame["used"] for frame in report["frames"]] == [True] * 4
    assert sum(frame["weight"] for frame in report["frames"]) == pytest.approx(1)
    channels = {channel["name"]: (channel["predicted"], channel["reason"]) for channel in report["channels"]}
    assert channels == {"green": (False, None), "red": (False, None), "blue": (True, None)}
    assert "photochemical_dose" in report["limits_unchecked"]
    dose_j_per_cm2 = (98.9e-6 * 4 + 3.18e-6) * 0.1  # default radiometry: four exposures in green, one in red
    assert report["dose_j_per_cm2"] == pytest.approx(dose_j_per_cm2, rel=1e-3)
    day = report["dose_24h_j_per_cm2"]  # the reservation is settled, up to rounding
    assert report["dose_j_per_cm2"] <= day["OS"] * (1 + 1e-9) < report["dose_stop_j_per_cm2"]
    assert report["seconds"]["expose"] == pytest.approx(0.6)
    _, red = read_raw_tiff(old_rig.store.read(kept.id, "raw-red.tiff"))
    assert red.illumination == Illumination("red")
    with Image.open(BytesIO(old_rig.store.read(kept.id, "colour.png"))) as picture:
        assert (picture.mode, picture.info["predicted"], picture.info["simulated"]) == ("RGB", "blue", "true")
        red_mean, green_mean, blue_mean = np.asarray(picture).mean(axis=(0, 1))
        assert red_mean > 1.5 * green_mean > 1.2 * blue_mean, "the hue of a fundus"
    with Image.open(BytesIO(old_rig.store.read(kept.id, "picture.png"))) as picture:
        picture.load()
        assert min(picture.size) > 60
    with Image.open(BytesIO(old_rig.store.read(kept.id, "quick.jpg"))) as quick:
        quick.load()
        assert max(quick.size) <= 640


def test_record_report_and_picture_are_marked_as_simulated(old_rig: Any) -> None:
    kept = old_rig.exam.press("OD").result(30)
    assert old_rig.store.get(kept.id).simulated is True
    assert json.loads(old_rig.store.read(kept.id, "report.json"))["simulated"] is True
    assert read_raw_tiff(old_rig.store.read(kept.id, "raw.tiff"))[1].simulated is True
    with Image.open(BytesIO(old_rig.store.read(kept.id, "picture.png"))) as picture:
        assert picture.info["simulated"] == "true"
        corner = np.asarray(picture)[-12:, :40]
    assert corner.max() > 200  # letters of the mark on its black band
    assert (corner < 10).mean() > 0.3


def test_the_picture_shows_the_retina_that_was_looked_at(old_rig: Any, plans: Path) -> None:
    kept = old_rig.exam.press("OD").result(30)
    raw, _ = read_raw_tiff(old_rig.store.read(kept.id, "raw.tiff"))
    dark, _ = read_raw_tiff(old_rig.store.read(kept.id, "dark.tiff"))
    picture = planned(old_rig, plans).reconstructor(raw, dark, simulated=True).picture
    truth = old_rig.world.truth("green")
    seen = truth > 0
    assert np.corrcoef(picture[seen], truth[seen])[0, 1] > 0.8


def test_a_second_press_while_one_is_under_way_is_refused_and_the_first_is_kept(rig: Any) -> None:
    rig.block_exposures()
    first = rig.exam.press("OD")
    rig.wait_for_blocked_exposure()
    assert rig.exam.state == "busy"
    with pytest.raises(Busy):
        rig.exam.press("OD")
    with pytest.raises(Busy):
        rig.exam.press("OS", KEY)
    rig.clock.gate.set()
    kept = first.result(30)
    assert rig.store.captures() == [kept]
    assert rig.exam.state == "aim"
    assert rig.exam.press("OS", KEY).result(30).eye == "OS"  # a refused press does not consume its key


def test_the_same_key_is_the_same_picture_while_it_is_made_and_afterwards(rig: Any) -> None:
    rig.block_exposures()
    first, again = rig.exam.press("OD", KEY), rig.exam.press("OD", KEY)
    rig.clock.gate.set()
    kept = first.result(30)
    assert again.result(30) == rig.exam.press("OD", KEY).result(30) == kept
    assert rig.store.captures() == [kept]
    other = rig.exam.press("OD", KEY[::-1]).result(30)
    assert rig.store.captures() == [other, kept]


def test_concurrent_presses_give_one_capture_at_a_time(rig: Any) -> None:
    def press(_: int) -> str | None:
        try:
            return str(rig.exam.press("OD").result(30).id)
        except Busy:
            return None

    with ThreadPoolExecutor(8) as executor:
        ids = [id for id in executor.map(press, range(16)) if id]
    assert 1 <= len(ids) <= 16
    assert {capture.id for capture in rig.store.captures()} == set(ids)


class FailingCamera:
    """Camera that raises an unexpected exception, or `error`, while the event is set."""

    def __init__(self, camera: Camera, is_failing: Event, error: Exception | None = None) -> None:
        self._camera, self._is_failing = camera, is_failing
        self._error = error or ZeroDivisionError("unexpected")
        self.shape = camera.shape

    def prepare(self, shot: ExposureSettings) -> None:
        """Do nothing."""

    def expose(self, shot: ExposureSettings, into: Any = None) -> Frame:
        if self._is_failing.is_set():
            raise self._error
        return self._camera.expose(shot, into)

    def close(self) -> None:
        self._camera.close()


class PressAtQuickLook(EventBus):
    """Event bus that calls `press` once, at the first event with stage `quick`."""

    def __init__(self) -> None:
        super().__init__()
        self.press: Callable[[], Any] | None = None
        self.pressed: list[Any] = []

    def publish(self, kind: str, **data: Any) -> None:
        super().publish(kind, **data)
        if data.get("stage") == "quick" and self.press is not None:
            press, self.press = self.press, None
            self.pressed.append(press())


class Blinking:
    """Camera of a simulated head whose eye is closed in the lit frames with these numbers."""

    def __init__(self, camera: Any, closed: set[int]) -> None:
        self._camera, self._closed, self._lit = camera, closed, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def expose(self, shot: ExposureSettings) -> Frame:
        world = self._camera.world
        is_closed = world.illumination is not None and self._lit in self._closed
        self._lit += world.illumination is not None
        if is_closed:
            world.faults.add("eye.closed")
        frame: Frame = self._camera.expose(shot)
        world.faults.discard("eye.closed")
        return frame


class FailsInTheThirdFrame:
    """Camera that stalls in its third lit frame, after `is_ready`."""

    def __init__(self, camera: Any, is_ready: Callable[[], bool]) -> None:
        self._camera, self._is_ready, self._lit = camera, is_ready, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def expose(self, shot: ExposureSettings) -> Frame:
        self._lit += self._camera.world.illumination is not None
        if self._lit == 3:
            until(self._is_ready)
            raise CameraStalled("no frame came")
        frame: Frame = self._camera.expose(shot)
        return frame


def test_the_quick_look_of_a_press_that_fails_is_forgotten(make_rig: Any) -> None:
    rigs: list[Any] = []

    def is_shown() -> bool:
        return bool(rigs[0].exam.snapshot.output.quick_looks)

    rigs.append(make_rig(camera=lambda camera: FailsInTheThirdFrame(camera, is_shown)))
    with pytest.raises(CameraStalled):
        rigs[0].exam.press("OD").result(30)
    until(lambda: not is_shown())
    assert rigs[0].world.illumination is None


@pytest.mark.parametrize("closed", [{0}, {2}, {0, 1, 2}], ids=str)
def test_closed_frames_of_a_burst_are_left_out_of_the_picture(make_rig: Any, closed: set[int]) -> None:
    rig = make_rig(camera=lambda camera: Blinking(camera, closed))
    kept = rig.exam.press("OD").result(30)
    assert kept.report.verdict.word == "good"
    frames = kept.report.frames
    assert len(frames) == 4
    assert frames[0].used, "the first good frame is the reference"
    assert [frame.used for frame in frames].count(True) == 4 - len(closed)
    assert all(frame.reason for frame in frames if not frame.used)
    *_, look = [data["url"] for kind, data in rig.published_events() if kind == "stage" and data["url"]]
    assert look.endswith("?reference") is (0 in closed), "a new URL for the look of another frame than the first"
    reference = read_raw_tiff(rig.store.read(kept.id, "raw.tiff"))[0].astype(float)
    assert reference.std() > 3 * np.sqrt(reference.mean()), "an open eye has structure beyond its noise"


def planned(rig: Any, plans: Path) -> CapturePipeline:
    """Return another pipeline of the same head, with the same plans."""
    return plan_pipeline(rig.exam.head, rig.clock, plans)


def test_a_press_suspends_a_refinement_which_resumes_to_the_same_picture(make_rig: Any, plans: Path) -> None:
    event_bus = PressAtQuickLook()
    rig = make_rig(event_bus=event_bus)
    event_bus.press = lambda: rig.exam.press("OS")
    first = rig.exam.press("OD").result(30)
    (second,) = [pressed.result(30) for pressed in event_bus.pressed]
    assert rig.store.captures() == [second, first]
    stages = [data for kind, data in rig.published_events() if kind == "stage" and data["stage"] != "refine"]
    order = [(data["id"], data["stage"]) for data in stages]
    a, b = first.id, second.id
    taken = ("expose", "expose", "quick")  # the second with the first quick look
    assert order[:7] == [*((a, stage) for stage in taken), *((b, stage) for stage in taken), (a, "keep")]
    assert first.report.rounds == second.report.rounds > 5
    assert first.report.from_read_out_s == second.report.from_read_out_s == 0, "each waited for the other only"
    *raws, dark = (read_raw_tiff(rig.store.read(a, name))[0] for name in (*RAWS, "dark.tiff"))
    bursts = planned(rig, plans).bursts
    assert bursts is not None
    *_, made = bursts.steps(raws, dark, simulated=True)
    assert isinstance(made, Reconstruction)
    alone = crop_to_field(made.picture, rig.exam.head)
    kept = rig.store.read(a, "picture.png")
    assert to_png(alone, True, f"OD {first.taken_at:%Y-%m-%d}") == kept  # bitwise equal


def test_progress_and_live_pictures_continue_during_a_refinement(make_rig: Any) -> None:
    event_bus = PressAtQuickLook()
    rig = make_rig(event_bus=event_bus)

    def request_preview() -> int:
        rig.clock.sleep(1.0)
        seen: int = rig.exam.snapshot.output.preview.number
        assert live_picture(rig.exam, seen, wait_s=0.0) is None
        return seen

    event_bus.press = request_preview
    rig.exam.press("OD").result(30)
    stages = [data for kind, data in rig.published_events() if kind == "stage"]
    assert [data["stage"] for data in stages[:4]] == ["expose", "expose", "quick", "refine"]
    assert stages[-1]["stage"] == "keep"
    fractions = [data["fraction"] for data in stages]
    assert fractions == sorted(fractions)
    assert stages[3]["left_s"] > 0
    assert rig.exam.snapshot.output.preview.number > event_bus.pressed[0], "taken before the capture was stored"


def test_the_lamp_is_off_during_a_refinement_without_requests_for_live_pictures(make_rig: Any) -> None:
    event_bus = PressAtQuickLook()
    rig = make_rig(event_bus=event_bus)
    live = live_picture(rig.exam, 0)
    event_bus.press = lambda: rig.clock.sleep(1.0)  # less than WANTED_S after the last request
    rig.exam.press("OD").result(30)
    assert live is not None
    assert rig.exam.snapshot.output.preview.number <= live.number + 1, "one may have been in progress"


def test_a_failed_press_during_a_refinement_does_not_affect_the_refinement(make_rig: Any) -> None:
    event_bus = PressAtQuickLook()
    rig = make_rig(event_bus=event_bus)

    def press_without_a_lamp() -> Any:
        rig.world.faults.add("light.fault")
        return rig.exam.press("OS")

    event_bus.press = press_without_a_lamp
    first = rig.exam.press("OD").result(30)
    with pytest.raises(LightFault):
        event_bus.pressed[0].result(30)
    assert rig.store.captures() == [first]
    assert rig.exam.state == "aim"
    assert rig.world.illumination is None


def test_a_third_press_is_refused_while_two_pictures_are_made(make_rig: Any) -> None:
    event_bus = PressAtQuickLook()
    rig = make_rig(event_bus=event_bus)

    def press_twice() -> Any:
        pressed = rig.exam.press("OS")
        assert rig.exam.state == "busy"
        with pytest.raises(Busy):
            rig.exam.press("OD")
        return pressed

    event_bus.press = press_twice
    first = rig.exam.press("OD").result(30)
    second = event_bus.pressed[0].result(30)
    assert rig.store.captures() == [second, first]


def test_a_press_is_refused_while_two_exposed_pictures_wait_to_be_made(make_rig: Any) -> None:
    event_bus = PressAtQuickLook()
    rig = make_rig(event_bus=event_bus)

    def press_a_second_time() -> Any:
        event_bus.press = press_a_third_time  # at the second quick look both exposures are done
        return rig.exam.press("OS")

    def press_a_third_time() -> str:
        with pytest.raises(Busy):
            rig.exam.press("OD")
        return str(rig.exam.state)

    event_bus.press = press_a_second_time
    first = rig.exam.press("OD").result(30)
    pressed, state = event_bus.pressed
    second = pressed.result(30)
    assert rig.store.captures() == [second, first]
    assert state == "busy"


def test_a_failure_during_planning_is_reported_and_presses_are_refused(make_rig: Any) -> None:
    unplugged = Event()
    unplugged.set()
    rig = make_rig(
        camera=lambda camera: FailingCamera(camera, unplugged, CameraMissing("no camera")), psfs=2, wait=False
    )
    assert rig.died.wait(60)
    assert isinstance(rig.exam.failure, CameraMissing)
    assert rig.exam.state == "starting"
    assert rig.world.illumination is None
    with pytest.raises(Busy):
        rig.exam.press("OD")


FAULTS = {"camera.missing": CameraMissing, "camera.stalled": CameraStalled, "light.fault": LightFault}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_hardware_fault_fails_the_press_with_the_lamp_off_until_repaired(rig: Any, fault: str) -> None:
    rig.world.faults.add(fault)
    with pytest.raises(FAULTS[fault]):
        rig.exam.press("OD").result(30)
    assert_dark_and_empty(rig)
    assert ("failed", fault) in [(kind, data.get("code")) for kind, data in rig.published_events()]
    rig.world.faults.clear()
    kept = rig.exam.press("OD").result(30)
    assert rig.store.captures() == [kept]


def test_a_lamp_that_cannot_be_darkened_ends_the_process(make_rig: Any) -> None:
    """The end of the process makes the guardian process and systemd turn the lamp off."""
    rig = make_rig()
    rig.world.faults.add("light.silent")
    with pytest.raises(LightFault):
        rig.exam.press("OD").result(30)
    assert rig.died.wait(30)
    assert isinstance(rig.exam.problem, LightFault)
    with pytest.raises(Busy):
        rig.exam.press("OD")
    rig.world.faults.clear()


def assert_dark_and_empty(rig: Any) -> None:
    assert rig.world.illumination is None
    assert rig.exam.state == "aim"
    assert rig.store.captures() == []
    assert list((rig.store.folder / "captures").iterdir()) == []
    assert rig.published_events()[-1] == ("state", {"state": "aim"})
    assert not rig.died.is_set()


def test_a_full_disk_leaves_no_partial_capture_and_recovers(make_rig: Any) -> None:
    free = [0]
    rig = make_rig(store={"free_bytes": lambda _: free[0]})
    with pytest.raises(StoreFull):
        rig.exam.press("OD").result(30)
    assert_dark_and_empty(rig)
    free[0] = 10**9
    kept = rig.exam.press("OD").result(30)
    assert rig.store.captures() == [kept]


def test_a_capture_without_reconstruction_is_stored(rig: Any) -> None:
    rig.world.ambient_e_per_s = 1e7  # daylight saturates every pixel
    bright = rig.exam.press("OD").result(30)
    assert bright.report.verdict.code == "shot.saturated"
    assert (bright.report.method, bright.report.stopped) == ("none", "input.frame")
    assert "cannot be used" in bright.report.warnings[0]
    raw, metadata = read_raw_tiff(rig.store.read(bright.id, "raw.tiff"))
    assert raw.min() == raw.max() > 4000
    assert metadata.illumination == Illumination("green")
    rig.world.ambient_e_per_s = 0.0
    kept = rig.exam.press("OD").result(30)
    assert rig.store.captures() == [kept, bright]
    assert kept.report.verdict.word == "good"


def test_a_camera_that_hangs_does_not_keep_the_lamp_on(make_rig: Any, wait_until: Callable[..., None]) -> None:
    rig = make_rig(max_on_s=0.15)
    rig.block_exposures()
    pressed = rig.exam.press("OD")
    wait_until(lambda: rig.world.illumination is not None)
    wait_until(lambda: rig.world.illumination is None)  # by the timer of the guard; the exposure still blocks
    assert not pressed.done()
    rig.clock.gate.set()
    with pytest.raises(Limit, match="went out"):
        pressed.result(30)
    assert_dark_and_empty(rig)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # it ends the thread on purpose
@pytest.mark.parametrize("by", ["press", "preview"])
def test_an_unexpected_exception_ends_the_exam_with_the_lamp_off(make_rig: Any, by: str) -> None:
    is_failing = Event()
    rig = make_rig(camera=lambda camera: FailingCamera(camera, is_failing))
    rig.exam.press("OD").result(30)
    is_failing.set()
    if by == "press":
        with pytest.raises(DiffuscopeError, match="unexpectedly"):
            rig.exam.press("OD").result(30)
    else:
        assert live_picture(rig.exam, 0, wait_s=0.2) is None
    assert rig.died.wait(10)
    assert rig.world.illumination is None
    assert rig.exam.problem is not None
    with pytest.raises(Busy, match="switched off"):
        rig.exam.press("OD")
    assert len(rig.store.captures()) == 1


def test_close_completes_a_waiting_press_and_refuses_the_next(rig: Any) -> None:
    rig.block_exposures()
    pressed = rig.exam.press("OD")
    rig.wait_for_blocked_exposure()
    with ThreadPoolExecutor(1) as executor:
        closed = executor.submit(rig.exam.close)
        time.sleep(0.05)
        with pytest.raises(Busy):
            rig.exam.press("OS")
        rig.clock.gate.set()
        closed.result(30)
    assert rig.store.captures() == [pressed.result(0)]  # a capture in progress is completed and stored
    assert rig.world.illumination is None
    assert not rig.died.is_set()
    with pytest.raises(Busy):
        rig.exam.press("OS")


def test_a_press_cannot_be_cancelled_by_a_disconnected_client(rig: Any) -> None:
    rig.block_exposures()
    pressed = rig.exam.press("OD")
    assert not pressed.cancel()
    rig.clock.gate.set()
    kept = pressed.result(30)
    assert rig.store.captures() == [kept]


# Live pictures


def test_live_pictures_are_numbered_upwards_small_and_lit_in_red(rig: Any) -> None:
    numbers, number = [], 0
    for _ in range(4):
        live = live_picture(rig.exam, number)
        assert live is not None
        number = live.number
        numbers.append(number)
    assert numbers == sorted(set(numbers))
    with Image.open(BytesIO(live.jpeg)) as picture:
        assert max(picture.size) <= 480
        assert b"simulated=true" in picture.info["comment"]
    assert rig.store.captures() == []


def test_the_lamp_stays_off_without_requests_for_live_pictures(rig: Any, wait_until: Callable[..., None]) -> None:
    assert rig.world.frames == 0
    assert live_picture(rig.exam, 0) is not None
    wait_until(lambda: rig.clock.elapsed_s >= 3.0)
    wait_until(lambda: rig.world.illumination is None)
    time.sleep(0.1)
    frames = rig.world.frames
    assert frames > 5
    time.sleep(0.3)
    assert rig.world.frames == frames
    assert live_picture(rig.exam, 0, wait_s=0.0) is not None  # a new request starts it again
    wait_until(lambda: rig.world.frames > frames)


def test_the_duty_cycle_of_the_aiming_light_is_at_most_one_half(make_rig: Any) -> None:
    rig = make_rig(max_on_s=1.0)
    number = 0
    while rig.clock.elapsed_s < 6:  # with a higher duty cycle the guard would refuse
        live = live_picture(rig.exam, number)
        assert live is not None
        number = live.number
        assert rig.exam.problem is None
    kept = rig.exam.press("OD").result(30)
    assert rig.store.captures() == [kept]


def test_a_press_has_priority_over_the_live_pictures_which_resume(rig: Any) -> None:
    before = live_picture(rig.exam, 0)
    assert before is not None
    kept = rig.exam.press("OD").result(30)
    assert rig.store.captures() == [kept]
    after = live_picture(rig.exam, before.number + 1)
    assert after is not None
    assert after.number > before.number


def test_an_error_of_the_live_pictures_is_published_once_and_cleared(rig: Any, wait_until: Callable[..., None]) -> None:
    rig.world.faults.add("camera.stalled")
    assert live_picture(rig.exam, 0, wait_s=0.1) is None
    wait_until(lambda: rig.exam.problem is not None)
    wait_until(lambda: rig.clock.elapsed_s >= 3.0)  # several attempts in virtual time
    assert rig.exam.problem.code == "camera.stalled"
    assert [kind for kind, _ in rig.published_events()] == ["state", "failed"]
    assert rig.world.illumination is None
    rig.world.faults.clear()
    assert live_picture(rig.exam, 0) is not None
    wait_until(lambda: rig.exam.problem is None)


def test_aiming_in_red_and_the_picture_in_green_each_have_their_own_psf(make_rig: Any, plans: Path) -> None:
    rig = make_rig(tinted=("green", "red"))
    pipeline = planned(rig, plans)
    assert isinstance(pipeline.reconstructor, Reconstructor)
    assert isinstance(pipeline.live, Reconstructor)
    assert pipeline.reconstructor.calibration.psfs[0].colour == "green"
    assert pipeline.live.calibration.psfs[0].colour == "red"
    assert live_picture(rig.exam, 0) is not None
    assert rig.exam.press("OD").result(30).calibration_id == rig.exam.head.calibration.id


def test_one_psf_for_every_colour_needs_one_reconstructor(old_rig: Any, plans: Path) -> None:
    pipeline = planned(old_rig, plans)
    assert pipeline.live is pipeline.reconstructor
