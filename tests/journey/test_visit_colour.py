"""A visit is shown in colour with all of its pictures, or with none: over HTTP, with the reason, and its thumbnails."""

import io
from concurrent.futures import Future
from threading import Event
from typing import Any

import numpy as np
import pytest
from PIL import Image

from device.ports import Camera
from services.instrument.events import EventBus
from services.records.capture_target import CaptureTarget
from services.records.programme import load_programme
from tests.journey.asking import visit_with_consent
from tests.journey.conftest import GateClock, MakeRig, Rig
from tests.red_light import FailsInRed

WAIT_S = 60.0
SLOTS = ("R-centre", "R-nerve", "L-centre")
JPEG_DN = 4  # mean difference of a JPEG of quality 70 from its picture, 8-bit levels


class TickingClock(GateClock):
    """Virtual clock that is a computer too slow for any time budget: each look at it in the dark takes `tick_s`."""

    tick_s = 0.0

    def now_s(self) -> float:
        if self.world is not None and self.world.illumination is None:
            self.elapsed_s += self.tick_s
        return super().now_s()


def begin(rig: Rig) -> str:
    return str(visit_with_consent(rig)["id"])


def press(rig: Rig, visit: str, slot: str) -> Any:
    eye = "OD" if slot[0] == "R" else "OS"
    answer = rig.request("POST", "/api/captures", json={"eye": eye, "visit": visit, "slot": slot})
    assert answer.status_code == 201, answer.text
    return answer.json()


def why_green(rig: Rig, visit: str) -> str | None:
    """Return the reason in the visit, which the list of visits gives too."""
    found = rig.request("GET", f"/api/visits/{visit}").json()["no_colour"]
    assert rig.request("GET", "/api/visits").json()["visits"][0]["no_colour"] == found
    return None if found is None else str(found)


@pytest.fixture
def camera_and_rig(make_rig: MakeRig) -> tuple[FailsInRed, Rig]:
    cameras: list[FailsInRed] = []

    def wrapped(camera: Camera) -> Camera:
        cameras.append(FailsInRed(camera))
        return cameras[0]

    rig = make_rig(camera=wrapped)
    return cameras[0], rig


def test_a_budget_that_is_over_before_the_colours_leaves_none_out(make_rig: MakeRig) -> None:
    clock = TickingClock()
    rig = make_rig(clock=clock)
    clock.tick_s = 0.5
    visit = begin(rig)
    made = [press(rig, visit, slot) for slot in SLOTS]
    clock.tick_s = 0.0
    assert {capture["report"]["stopped"] for capture in made} == {"deadline"}
    assert all("colour" in capture["links"] for capture in made)
    assert why_green(rig, visit) is None


def test_one_picture_without_colour_shows_its_visit_in_green_and_takes_no_more_red(
    camera_and_rig: tuple[FailsInRed, Rig],
) -> None:
    camera, rig = camera_and_rig
    visit = begin(rig)
    assert why_green(rig, visit) is None
    assert "colour" in press(rig, visit, "R-centre")["links"]
    assert why_green(rig, visit) is None
    camera.fails = True
    red = next(channel for channel in press(rig, visit, "R-nerve")["report"]["channels"] if channel["name"] == "red")
    assert (red["reason"], red["code"]) == ("no frame came", "camera.stalled")
    assert why_green(rig, visit) == "camera.stalled"
    camera.fails = False
    assert "channels" not in press(rig, visit, "L-centre")["report"]
    assert camera.reds == 2, "light that is not shown is not given"
    assert why_green(rig, visit) == "camera.stalled"
    assert "colour" in press(rig, begin(rig), "R-centre")["links"], "the next visit begins anew"


def test_a_programme_of_one_colour_has_its_reason(make_rig: MakeRig) -> None:
    rig = make_rig(programme=load_programme().model_copy(update={"colours": ()}))
    visit = begin(rig)
    press(rig, visit, "R-centre")
    assert why_green(rig, visit) == "colour.none"


def test_a_calibration_without_a_psf_in_red_has_its_reason(make_rig: MakeRig) -> None:
    rig = make_rig(tinted=("green",))
    visit = begin(rig)
    press(rig, visit, "R-centre")
    assert why_green(rig, visit) == "colour.psf"


class HeldBus(EventBus):
    """Event bus that holds the event `kept` until `go_on`: the capture is stored, and its quick look not forgotten."""

    def __init__(self) -> None:
        super().__init__()
        self.kept_id, self.go_on = Future[str](), Event()

    def publish(self, kind: str, **data: Any) -> None:
        """Publish an event."""
        if kind == "kept":
            self.kept_id.set_result(data["id"])
            assert self.go_on.wait(WAIT_S)
        super().publish(kind, **data)


def test_a_stored_capture_has_its_thumbnail_at_once(make_rig: MakeRig) -> None:
    """A visit lists it as soon as it is stored; a quick look in green in its place stayed on the page."""
    bus = HeldBus()
    rig = make_rig(event_bus=bus)
    target = CaptureTarget(visit=begin(rig), slot="R-centre")
    future = rig.exam.press("OD", None, target)
    id = bus.kept_id.result(WAIT_S)
    assert rig.exam.quick(id) is not None
    shown = rig.request("GET", f"/api/captures/{id}/quick.jpg").content
    bus.go_on.set()
    assert future.result(WAIT_S).id == id
    assert shown == rig.store.read(id, "quick.jpg")


def pixels(content: bytes) -> Any:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), np.float64)


@pytest.mark.parametrize(("thumbnail", "picture"), [("quick.jpg", "colour.png"), ("green.jpg", "picture.png")])
def test_a_thumbnail_is_the_picture(old_rig: Rig, thumbnail: str, picture: str) -> None:
    id = press(old_rig, begin(old_rig), "R-centre")["id"]
    small, whole = (
        pixels(old_rig.request("GET", f"/api/captures/{id}/{name}").content) for name in (thumbnail, picture)
    )
    assert small.shape == whole.shape, "a small head: nothing is reduced"
    middle = np.s_[20:-20, 20:-20]  # between the marks in the pixels
    assert np.abs(small[middle] - whole[middle]).mean() < JPEG_DN
