"""From one press to a kept picture, and every way in which that can fail: the lamp is dark after all of them."""

import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from threading import Event
from typing import Any

import numpy as np
import pytest
from PIL import Image

from device.errors import Busy, CameraMissing, CameraStalled, DiffuscopeError, LightFault, StoreFull
from device.errors import LightLimit as Limit
from device.ports import Camera
from device.values import Frame, Shot
from services.instrument.bulletin import Bulletin
from services.instrument.exposing import eye_in
from services.records.picture import read_raw_tiff, to_png

FILES = {"raw.tiff", "dark.tiff", "picture.png", "quick.jpg", "report.json"}
KEY = "0123456789abcdef"


def test_a_press_keeps_a_picture_whose_every_file_reads_back(old_rig: Any) -> None:
    kept = old_rig.exam.press("OS").result(30)
    assert old_rig.world.glow is None
    assert old_rig.store.captures(1) == [kept]
    assert set(kept.files) == FILES
    raw, facts = read_raw_tiff(old_rig.store.read(kept.id, "raw.tiff"))
    dark, dark_facts = read_raw_tiff(old_rig.store.read(kept.id, "dark.tiff"))
    assert raw.shape == dark.shape == (135, 240)
    assert raw.max() > dark.max() + 500
    assert facts["glow"] == {"colour": "green", "level": 1.0}
    assert dark_facts["glow"] is None
    assert facts["eye"] == kept.eye == "OS"
    report = json.loads(old_rig.store.read(kept.id, "report.json"))
    assert report == kept.report | {"simulated": True}
    assert report["stopped"] == "done"
    assert report["bin"] == 1
    assert report["dose_j_per_cm2"] == pytest.approx(98.9e-6 * 0.1, rel=1e-3)  # unmeasured green, for one exposure
    day = report["dose_24h_j_per_cm2"]  # the reservation is given back but for rounding
    assert report["dose_j_per_cm2"] <= day["OS"] * (1 + 1e-9) < report["dose_stop_j_per_cm2"]
    assert report["seconds"]["expose"] == pytest.approx(0.2)
    with Image.open(BytesIO(old_rig.store.read(kept.id, "picture.png"))) as picture:
        picture.load()
        assert min(picture.size) > 60
    with Image.open(BytesIO(old_rig.store.read(kept.id, "quick.jpg"))) as quick:
        quick.load()
        assert max(quick.size) <= 640


def test_that_it_was_simulated_is_in_the_record_the_report_and_the_picture(old_rig: Any) -> None:
    kept = old_rig.exam.press("OD").result(30)
    assert old_rig.store.get(kept.id).simulated is True
    assert json.loads(old_rig.store.read(kept.id, "report.json"))["simulated"] is True
    assert read_raw_tiff(old_rig.store.read(kept.id, "raw.tiff"))[1]["simulated"] is True
    with Image.open(BytesIO(old_rig.store.read(kept.id, "picture.png"))) as picture:
        assert picture.text["simulated"] == "true"
        corner = np.asarray(picture)[-12:, :40]
    assert corner.max() > 200  # the letters of the mark, on its black band
    assert (corner < 10).mean() > 0.3


def test_the_picture_shows_the_retina_that_was_looked_at(old_rig: Any, wait_until: Callable[..., None]) -> None:
    kept = old_rig.exam.press("OD").result(30)
    wait_until(lambda: not old_rig.exam.fitness.due)  # which has the same workspace
    raw, _ = read_raw_tiff(old_rig.store.read(kept.id, "raw.tiff"))
    dark, _ = read_raw_tiff(old_rig.store.read(kept.id, "dark.tiff"))
    picture = old_rig.exam._reconstructor(raw, dark, simulated=True).picture
    truth = old_rig.world.truth("green")
    seen = truth > 0
    assert np.corrcoef(picture[seen], truth[seen])[0, 1] > 0.8


def test_a_second_press_while_one_is_under_way_is_refused_and_the_first_is_kept(rig: Any) -> None:
    rig.hang()
    first = rig.exam.press("OD")
    rig.wait_for_hanging()
    assert rig.exam.state == "busy"
    with pytest.raises(Busy):
        rig.exam.press("OD")
    with pytest.raises(Busy):
        rig.exam.press("OS", KEY)
    rig.clock.gate.set()
    kept = first.result(30)
    assert rig.store.captures() == [kept]
    assert rig.exam.state == "aim"
    assert rig.exam.press("OS", KEY).result(30).eye == "OS"  # a refused key was not used up


def test_the_same_key_is_the_same_picture_while_it_is_made_and_afterwards(rig: Any) -> None:
    rig.hang()
    first, again = rig.exam.press("OD", KEY), rig.exam.press("OD", KEY)
    rig.clock.gate.set()
    kept = first.result(30)
    assert again.result(30) == rig.exam.press("OD", KEY).result(30) == kept
    assert rig.store.captures() == [kept]
    other = rig.exam.press("OD", KEY[::-1]).result(30)
    assert rig.store.captures() == [other, kept]


def test_many_hands_on_the_button_make_one_picture_at_a_time(rig: Any) -> None:
    def press(_: int) -> str | None:
        try:
            return str(rig.exam.press("OD").result(30).id)
        except Busy:
            return None

    with ThreadPoolExecutor(8) as hands:
        made = [id for id in hands.map(press, range(16)) if id]
    assert 1 <= len(made) <= 16
    assert {capture.id for capture in rig.store.captures()} == set(made)


class Astonishing:
    """A camera with a mistake in its driver that nobody foresaw, or that is pulled out."""

    def __init__(self, camera: Camera, wrong: Event, error: Exception | None = None) -> None:
        self._camera, self._wrong = camera, wrong
        self._error = error or ZeroDivisionError("nobody foresaw this")
        self.shape = camera.shape

    def prepare(self, shot: Shot) -> None:
        """Nothing to prepare."""

    def expose(self, shot: Shot, into: Any = None) -> Frame:
        if self._wrong.is_set():
            raise self._error
        return self._camera.expose(shot, into)

    def close(self) -> None:
        self._camera.close()


class Eager(Bulletin):
    """News that make somebody press: once, as soon as the quick look of the first picture is told."""

    def __init__(self) -> None:
        super().__init__()
        self.press: Callable[[], Any] | None = None
        self.pressed: list[Any] = []

    def tell(self, kind: str, **data: Any) -> None:
        super().tell(kind, **data)
        if data.get("stage") == "quick" and self.press is not None:
            press, self.press = self.press, None
            self.pressed.append(press())


def test_a_press_pauses_a_refinement_which_then_goes_on_to_the_same_picture(make_rig: Any) -> None:
    eager = Eager()
    rig = make_rig(bulletin=eager)
    eager.press = lambda: rig.exam.press("OS")
    first = rig.exam.press("OD").result(30)
    (second,) = [pressed.result(30) for pressed in eager.pressed]
    assert rig.store.captures() == [second, first]
    stages = [data for kind, data in rig.told() if kind == "stage" and data["stage"] != "refine"]
    order = [(data["id"], data["stage"]) for data in stages]
    a, b = first.id, second.id
    assert order[:5] == [(a, "expose"), (a, "quick"), (b, "expose"), (b, "quick"), (a, "keep")]
    assert first.report["rounds"] == second.report["rounds"] > 5
    raw, dark = (read_raw_tiff(rig.store.read(a, name))[0] for name in ("raw.tiff", "dark.tiff"))
    rig.exam.close()  # or it would look, with the same workspace, whether the calibration still fits
    alone = eye_in(rig.exam._reconstructor(raw, dark, simulated=True).picture, rig.exam.head)
    kept = rig.store.read(a, "picture.png")
    assert to_png(alone, True, f"OD {first.taken_at:%Y-%m-%d}") == kept  # to the last bit


def test_while_a_picture_is_refined_pages_hear_how_far_it_is_and_who_aims_sees_a_live_picture(make_rig: Any) -> None:
    eager = Eager()
    rig = make_rig(bulletin=eager)

    def aim_on() -> int:
        rig.clock.sleep(1.0)
        seen: int = rig.exam._preview.number
        assert rig.exam.preview(seen, wait_s=0.0) is None
        return seen

    eager.press = aim_on
    rig.exam.press("OD").result(30)
    stages = [data for kind, data in rig.told() if kind == "stage"]
    assert [data["stage"] for data in stages[:3]] == ["expose", "quick", "refine"]
    assert stages[-1]["stage"] == "keep"
    fractions = [data["fraction"] for data in stages]
    assert fractions == sorted(fractions)
    assert stages[2]["left_s"] > 0
    assert rig.exam._preview.number > eager.pressed[0], "made before the picture was done"


def test_nobody_aims_nobody_is_lit_while_a_picture_is_refined(make_rig: Any) -> None:
    eager = Eager()
    rig = make_rig(bulletin=eager)
    live = rig.exam.preview(0)
    eager.press = lambda: rig.clock.sleep(1.0)  # within the three seconds for which a live picture would be wanted
    rig.exam.press("OD").result(30)
    assert live is not None
    assert rig.exam._preview.number <= live.number + 1, "one may have been under way"


def test_a_press_that_fails_in_the_pause_leaves_the_refinement_alone(make_rig: Any) -> None:
    eager = Eager()
    rig = make_rig(bulletin=eager)

    def press_without_a_lamp() -> Any:
        rig.world.faults.add("light.fault")
        return rig.exam.press("OS")

    eager.press = press_without_a_lamp
    first = rig.exam.press("OD").result(30)
    with pytest.raises(LightFault):
        eager.pressed[0].result(30)
    assert rig.store.captures() == [first]
    assert rig.exam.state == "aim"
    assert rig.world.glow is None


def test_a_third_press_is_refused_while_two_pictures_are_made(make_rig: Any) -> None:
    eager = Eager()
    rig = make_rig(bulletin=eager)

    def press_twice() -> Any:
        pressed = rig.exam.press("OS")
        assert rig.exam.state == "busy"
        with pytest.raises(Busy):
            rig.exam.press("OD")
        return pressed

    eager.press = press_twice
    first = rig.exam.press("OD").result(30)
    second = eager.pressed[0].result(30)
    assert rig.store.captures() == [second, first]


def test_a_press_is_refused_while_two_exposed_pictures_wait_to_be_made(make_rig: Any) -> None:
    eager = Eager()
    rig = make_rig(bulletin=eager)

    def press_a_second_time() -> Any:
        eager.press = press_a_third_time  # at the second picture's quick look: both exposures are done
        return rig.exam.press("OS")

    def press_a_third_time() -> str:
        with pytest.raises(Busy):
            rig.exam.press("OD")
        return str(rig.exam.state)

    eager.press = press_a_second_time
    first = rig.exam.press("OD").result(30)
    pressed, state = eager.pressed
    second = pressed.result(30)
    assert rig.store.captures() == [second, first]
    assert state == "busy"


def test_plans_that_cannot_be_made_are_told_and_nobody_waits(make_rig: Any) -> None:
    pulled = Event()
    pulled.set()
    rig = make_rig(camera=lambda camera: Astonishing(camera, pulled, CameraMissing("no camera")), psfs=2, wait=False)
    assert rig.died.wait(60)
    assert isinstance(rig.exam.failure, CameraMissing)
    assert rig.exam.state == "starting"
    assert rig.world.glow is None
    with pytest.raises(Busy):
        rig.exam.press("OD")


FAULTS = {"camera.missing": CameraMissing, "camera.stalled": CameraStalled, "light.fault": LightFault}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_part_fails_the_press_dark_and_a_mended_one_works(rig: Any, fault: str) -> None:
    rig.world.faults.add(fault)
    with pytest.raises(FAULTS[fault]):
        rig.exam.press("OD").result(30)
    assert_dark_and_empty(rig)
    assert ("failed", fault) in [(kind, data.get("code")) for kind, data in rig.told()]
    rig.world.faults.clear()
    kept = rig.exam.press("OD").result(30)
    assert rig.store.captures() == [kept]


def test_a_lamp_that_cannot_be_darkened_ends_the_process(make_rig: Any) -> None:
    """What nobody can switch off is for the guardian and for systemd: both act when this process is gone."""
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
    assert rig.world.glow is None
    assert rig.exam.state == "aim"
    assert rig.store.captures() == []
    assert list((rig.store.folder / "captures").iterdir()) == []
    assert rig.told()[-1] == ("state", {"state": "aim"})
    assert not rig.died.is_set()


def test_a_full_shelf_keeps_nothing_half_and_works_again_with_room(make_rig: Any) -> None:
    free = [0]
    rig = make_rig(store={"free_bytes": lambda _: free[0]})
    with pytest.raises(StoreFull):
        rig.exam.press("OD").result(30)
    assert_dark_and_empty(rig)
    free[0] = 10**9
    kept = rig.exam.press("OD").result(30)
    assert rig.store.captures() == [kept]


def test_a_shot_of_which_no_picture_can_be_made_is_kept_as_it_is(rig: Any) -> None:
    rig.world.ambient_e_per_s = 1e7  # daylight: every pixel is full
    bright = rig.exam.press("OD").result(30)
    assert bright.report["verdict"]["code"] == "shot.saturated"
    assert (bright.report["method"], bright.report["stopped"]) == ("none", "input.frame")
    assert "cannot be used" in bright.report["warnings"][0]
    raw, facts = read_raw_tiff(rig.store.read(bright.id, "raw.tiff"))
    assert raw.min() == raw.max() > 4000
    assert facts["glow"] == {"colour": "green", "level": 1.0}
    rig.world.ambient_e_per_s = 0.0
    kept = rig.exam.press("OD").result(30)
    assert rig.store.captures() == [kept, bright]
    assert kept.report["verdict"]["word"] == "good"


def test_a_camera_that_hangs_does_not_keep_the_lamp_on(make_rig: Any, wait_until: Callable[..., None]) -> None:
    rig = make_rig(max_on_s=0.15)
    rig.hang()
    pressed = rig.exam.press("OD")
    wait_until(lambda: rig.world.glow is not None)
    wait_until(lambda: rig.world.glow is None)  # the guard's own timer: the exposure still hangs
    assert not pressed.done()
    rig.clock.gate.set()
    with pytest.raises(Limit, match="went out"):
        pressed.result(30)
    assert_dark_and_empty(rig)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # it ends the thread: on purpose
@pytest.mark.parametrize("by", ["press", "preview"])
def test_what_nobody_foresaw_ends_dark_and_calls_for_a_restart(make_rig: Any, by: str) -> None:
    wrong = Event()
    rig = make_rig(camera=lambda camera: Astonishing(camera, wrong))
    rig.exam.press("OD").result(30)
    wrong.set()
    if by == "press":
        with pytest.raises(DiffuscopeError, match="unexpectedly"):
            rig.exam.press("OD").result(30)
    else:
        assert rig.exam.preview(0, wait_s=0.2) is None
    assert rig.died.wait(10)
    assert rig.world.glow is None
    assert rig.exam.problem is not None
    with pytest.raises(Busy, match="switched off"):
        rig.exam.press("OD")
    assert len(rig.store.captures()) == 1


def test_closing_answers_a_press_that_waits_and_refuses_the_next(rig: Any) -> None:
    rig.hang()
    pressed = rig.exam.press("OD")
    rig.wait_for_hanging()
    with ThreadPoolExecutor(1) as aside:
        closed = aside.submit(rig.exam.close)
        time.sleep(0.05)
        with pytest.raises(Busy):
            rig.exam.press("OS")
        rig.clock.gate.set()
        closed.result(30)
    assert rig.store.captures() == [pressed.result(0)]  # what was under way is finished and kept
    assert rig.world.glow is None
    assert not rig.died.is_set()
    with pytest.raises(Busy):
        rig.exam.press("OS")


def test_a_press_cannot_be_cancelled_by_a_page_that_goes_away(rig: Any) -> None:
    rig.hang()
    pressed = rig.exam.press("OD")
    assert not pressed.cancel()
    rig.clock.gate.set()
    kept = pressed.result(30)
    assert rig.store.captures() == [kept]


# The live preview


def test_live_pictures_are_numbered_upwards_small_and_lit_in_red(rig: Any) -> None:
    numbers, number = [], 0
    for _ in range(4):
        live = rig.exam.preview(number)
        assert live is not None
        number = live.number
        numbers.append(number)
    assert numbers == sorted(set(numbers))
    with Image.open(BytesIO(live.jpeg)) as picture:
        assert max(picture.size) <= 480
        assert b"simulated=true" in picture.info["comment"]
    assert rig.store.captures() == []


def test_the_lamp_rests_when_nobody_asks(rig: Any, wait_until: Callable[..., None]) -> None:
    assert rig.world.frames == 0
    assert rig.exam.preview(0) is not None
    wait_until(lambda: rig.clock.elapsed_s >= 3.0)
    wait_until(lambda: rig.world.glow is None)
    time.sleep(0.1)
    frames = rig.world.frames
    assert frames > 5
    time.sleep(0.3)
    assert rig.world.frames == frames
    assert rig.exam.preview(0, wait_s=0.0) is not None  # and wakes up again
    wait_until(lambda: rig.world.frames > frames)


def test_aiming_leaves_the_eye_as_much_darkness_as_light(make_rig: Any) -> None:
    rig = make_rig(max_on_s=1.0)
    number = 0
    while rig.clock.elapsed_s < 6:  # the guard would refuse after one second of debt
        live = rig.exam.preview(number)
        assert live is not None
        number = live.number
        assert rig.exam.problem is None
    kept = rig.exam.press("OD").result(30)
    assert rig.store.captures() == [kept]


def test_a_press_goes_before_the_preview_which_comes_back(rig: Any) -> None:
    before = rig.exam.preview(0)
    assert before is not None
    kept = rig.exam.press("OD").result(30)
    assert rig.store.captures() == [kept]
    after = rig.exam.preview(before.number + 1)
    assert after is not None
    assert after.number > before.number


def test_a_problem_of_the_preview_is_told_once_and_forgotten_when_it_is_over(
    rig: Any, wait_until: Callable[..., None]
) -> None:
    rig.world.faults.add("camera.stalled")
    assert rig.exam.preview(0, wait_s=0.1) is None
    wait_until(lambda: rig.exam.problem is not None)
    wait_until(lambda: rig.clock.elapsed_s >= 3.0)  # several tries in virtual time
    assert rig.exam.problem.code == "camera.stalled"
    assert [kind for kind, _ in rig.told()] == ["state", "failed"]
    assert rig.world.glow is None
    rig.world.faults.clear()
    assert rig.exam.preview(0) is not None
    wait_until(lambda: rig.exam.problem is None)


def test_aiming_in_red_and_the_picture_in_green_each_have_their_own_psf(make_rig: Any) -> None:
    rig = make_rig(tinted=("green", "red"))
    assert rig.exam._reconstructor.calibration.psfs[0].colour == "green"
    assert rig.exam._live.calibration.psfs[0].colour == "red"
    assert rig.exam.preview(0) is not None
    assert rig.exam.press("OD").result(30).calibration_id == rig.exam.head.calibration.id


def test_one_psf_for_every_colour_needs_one_reconstructor(old_rig: Any) -> None:
    assert old_rig.exam._live is old_rig.exam._reconstructor
