"""Montage of one eye of a visit over HTTP: two fields of view of one eye, other choices, and priority of the camera."""

from collections.abc import Iterator
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow

from device.config.head_file import InstrumentSpec
from device.errors import DiffuscopeError
from device.sim.eyes import FIXATION_DEG
from services.imaging.picture_files import read_png, to_png
from services.instrument.head_arbiter import AIMING_S
from services.instrument.visit_montage import join_pictures
from tests.journey.asking import visit_with_consent
from tests.journey.conftest import Rig, rig_builder, traced_world, until
from tests.journey.test_visits import post, refused, shoot
from tests.moving_retina import OTHER_RETINA, WIDE_RETINA, gaze


@pytest.fixture(scope="module")
def eye_rig(spec: InstrumentSpec, plans: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """A rig with 130 pixels across the field: vessels are resolved."""
    with ExitStack() as undo:
        yield rig_builder(traced_world(spec), plans)(tmp_path_factory.mktemp("montage"), undo)


def montage(rig: Rig, visit: Any, eye: str = "OD") -> Any:
    return rig.request("GET", f"/api/visits/{visit['id']}/montage/{eye}").json()


def known_montage(rig: Rig, visit: Any) -> Any:
    """Return the montage of the right eye once it is computed."""
    until(lambda: montage(rig, visit)["state"] != "computing", 60)
    return montage(rig, visit)


def test_two_fields_of_one_eye_become_one_picture(eye_rig: Rig) -> None:
    visit = visit_with_consent(eye_rig)
    first = shoot(eye_rig, visit, "R-centre")
    alone = montage(eye_rig, visit)
    assert (alone["state"], alone["pictures"], alone["placed"]) == ("none", 1, [])
    picture = f"/api/visits/{visit['id']}/montage/OD/picture.png"
    refused(eye_rig.request("GET", picture), 404, "store.unknown")
    second = shoot(eye_rig, visit, "R-nerve")
    shoot(eye_rig, visit, "L-centre")
    # A montage waits while the camera is used.
    assert eye_rig.request("GET", f"/api/preview?eye=OD&visit={visit['id']}").status_code in (200, 204)
    assert not eye_rig.arbiter.is_idle
    for _ in range(20):
        assert montage(eye_rig, visit)["state"] == "computing"
    eye_rig.clock.sleep(AIMING_S + 1)
    joined = known_montage(eye_rig, visit)
    assert (joined["state"], joined["pictures"]) == ("joined", 2)
    assert [place["capture"] for place in joined["placed"]] == [first["id"], second["id"]], "of this eye only"
    placed = joined["placed"][1]
    assert placed["used"], placed
    right_px, down_px = (turn * eye_rig.world.geometry.px_per_deg for turn in FIXATION_DEG["nerve"])
    assert placed["shift_px"] == pytest.approx([down_px, right_px], abs=0.6)  # what a montage may be off by
    assert abs(placed["rotation_deg"]) < 0.5
    assert joined["projection"] == "sphere"
    content = eye_rig.request("GET", picture)
    assert content.headers["content-type"] == "image/png"
    with Pillow.open(BytesIO(content.content)) as image:
        assert image.info["simulated"] == "true"
        shown = np.asarray(image)
    with Pillow.open(BytesIO(eye_rig.store.read(first["id"], "picture.png"))) as field:
        assert shown.shape[1] > 1.2 * field.width, "wider than one field"
    rows = round(shown.shape[0] / 18)  # letters of the mark in the bottom left corner, which is in no field
    assert (shown[-rows:, : 3 * rows] > 200).any(), "the band"
    assert montage(eye_rig, visit)["digest"] == joined["digest"]
    assert montage(eye_rig, visit, "OS")["state"] == "none"

    # Another choice of pictures is another montage.
    post(eye_rig, f"/api/visits/{visit['id']}/slots", slot="R-nerve", capture=None)
    assert montage(eye_rig, visit)["state"] == "none", "the picture that was taken out is in no montage"
    again = shoot(eye_rig, visit, "R-nerve")
    retaken = known_montage(eye_rig, visit)
    assert retaken["digest"] != joined["digest"]
    assert retaken["placed"][1]["capture"] == again["id"]


def test_unknown_visits_and_eyes_are_refused(eye_rig: Rig) -> None:
    refused(eye_rig.request("GET", "/api/visits/20260101T000000-ffffff/montage/OD"), 404, "store.unknown")
    visit = visit_with_consent(eye_rig)
    assert eye_rig.request("GET", f"/api/visits/{visit['id']}/montage/left").status_code == 422


def nothing(_: int) -> None:
    """Report no progress."""


@pytest.mark.parametrize("simulated", [True, False])
def test_pictures_that_do_not_fit_stay_apart_with_the_reason(simulated: bool) -> None:
    other = np.asarray(OTHER_RETINA[:400, :400], np.float32)
    first, second = (to_png(gaze(retina, (0, 0)), simulated) for retina in (WIDE_RETINA, other))
    smaller = to_png(gaze(WIDE_RETINA, (0, 0))[2:], simulated)
    made = join_pictures([first, second, smaller], simulated, None, nothing)
    assert made.png is None
    assert [place.used for place in made.placed] == [True, False, False]
    assert "no picture shows the same part" in (made.placed[1].reason or "")
    assert made.placed[2].reason == "it was taken with another calibration"


def test_stored_pictures_are_joined_as_the_light_that_they_show() -> None:
    first, second = (gaze(WIDE_RETINA, shift, 0, 1) for shift in ((0, 0), (-20, 84)))
    made = join_pictures([to_png(first, True), to_png(second, True)], True, None, nothing)
    assert made.placed[1].shift_px == pytest.approx((-20, 84), abs=0.6)
    assert made.png is not None
    light = read_png(made.png)
    assert light.shape[1] > first.shape[1] + 80


def test_data_that_are_no_picture_are_refused() -> None:
    good = to_png(gaze(WIDE_RETINA, (0, 0)), False)
    for broken in (b"", b"no picture", good[: len(good) // 2]):
        with pytest.raises(DiffuscopeError, match="not a whole PNG"):
            join_pictures([good, broken], False, None, nothing)
