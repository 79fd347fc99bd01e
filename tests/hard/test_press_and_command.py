"""One burst, one answer: a press of the simulated instrument, and its stored frames by `diffuscope reconstruct`."""

import json
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from device.calibration.archive import Archive, Provenance
from device.clock import VirtualClock
from device.config.head_file import load_head
from device.config.marked_files import stated_mark
from device.sim.render import crop_or_pad
from device.values import Colour, Psf
from services.imaging.picture_files import read_png
from services.records.capture import Capture
from services.records.capture_target import CaptureTarget
from tests.journey.conftest import SMALL_HEAD, coarsened, rig_builder
from tests.journey.wrong_inputs import call

READY_S, PRESS_S = 300.0, 120.0


TINTS: tuple[Colour, ...] = ("green", "red")


@pytest.fixture(scope="module")
def pressed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Capture]:
    """A simulated instrument with its calibration, and copies of the files of a press: a burst in green, one in red."""
    root = tmp_path_factory.mktemp("instrument")
    (root / "head.toml").write_text(SMALL_HEAD)
    world, calibration = coarsened(load_head(root / "head.toml"))
    with ExitStack() as undo:
        rig = rig_builder((world, calibration), root / "plans")(root, undo, tinted=TINTS, wait=False)
        assert rig.exam.ready.wait(READY_S)
        capture = rig.exam.press("OD", None, CaptureTarget(frames=4)).result(PRESS_S)
    copied = call(["store", "copy", capture.id, "--data", str(root / "store"), "-o", str(root / "copied")])
    assert copied.code == 0, copied.err
    psfs = tuple(Psf(crop_or_pad(world.psf(colour), world.shape), colour, colour) for colour in TINTS)
    calibration = replace(calibration, psfs=psfs)
    Archive(root / "calibrations").add_and_activate(calibration, Provenance("D1", VirtualClock().wall(), "test", "0"))
    return root, capture


def reconstructed(root: Path, capture: Capture, *frames: str) -> tuple[Any, Any]:
    """Return picture and report of `diffuscope reconstruct` for frames of a stored capture."""
    place, made = root / "copied" / capture.id, root / "again"
    made.mkdir(exist_ok=True)
    words = [
        "reconstruct",
        *(str(place / word) if word.endswith(".tiff") else word for word in frames),
        "--dark",
        str(place / "dark.tiff"),
        "--calibration",
        str(root / "calibrations"),
        "-o",
        str(made / "picture.npy"),
        "--report",
        str(made / "report.json"),
    ]
    answer = call(words)
    assert answer.code == 0, answer.err
    return np.load(made / "picture.npy"), json.loads((made / "report.json").read_text())


def test_a_burst_has_the_residual_and_the_picture_of_its_press(pressed: tuple[Path, Capture]) -> None:
    root, capture = pressed
    stored, place = capture.report, root / "copied" / capture.id
    names = burst_of(capture)
    picture, report = reconstructed(root, capture, *names)
    assert [use["used"] for use in report["frames"]] == [use.used for use in stored.frames]
    for again, before in zip(report["frames"], stored.frames, strict=True):
        assert again["shift_px"] == pytest.approx(before.shift_px, abs=1e-3)
    # The press may stop a few rounds earlier, at its deadline.
    assert report["residual"] == pytest.approx(stored.residual, rel=0.02)
    assert report["noise_dn"] == pytest.approx(stored.noise_dn, rel=0.02)
    assert report["quality"]["mean_dn"] == pytest.approx(stored.quality["mean_dn"], rel=1e-3)
    shown = read_png((place / "picture.png").read_bytes())
    assert likeness(picture, shown) > 0.995  # the stored picture has 8 bits


def test_a_colour_press_is_repeated_with_its_calibration(pressed: tuple[Path, Capture]) -> None:
    root, capture = pressed
    stored, place = capture.report, root / "copied" / capture.id
    channels = [word for name in burst_of(capture) for word in ("--channel", "green", name)]
    picture, report = reconstructed(root, capture, *channels, "--channel", "red", "raw-red.tiff")
    assert report["residual"] == pytest.approx(stored.residual, rel=0.02)
    assert stated_mark(root / "again" / "picture.npy") is True
    of_press = {channel.name: channel for channel in stored.channels}
    assert {channel["name"] for channel in report["channels"]} == of_press.keys() == {"green", "red", "blue"}
    for channel in report["channels"]:
        before = of_press[channel["name"]]
        assert channel["predicted"] == before.predicted
        if before.shift_px is not None:
            assert channel["shift_px"] == pytest.approx(before.shift_px, abs=0.02)
    shown = read_png((place / "colour.png").read_bytes())
    assert likeness(picture, shown) > 0.99  # 8 bits, and not linear


def burst_of(capture: Capture) -> list[str]:
    return ["raw.tiff", *(f"raw-{k}.tiff" for k in range(1, len(capture.report.frames)))]


def likeness(picture: Any, shown: Any) -> float:
    """Return the correlation of the middles of two pictures; the stored one is cropped to the lit field."""
    middles = []
    for image in (picture, shown):
        rows, cols = image.shape[0] // 2, image.shape[1] // 2
        middles.append(image[rows - 20 : rows + 20, cols - 20 : cols + 20].astype(float).ravel())
    return float(np.corrcoef(*middles)[0, 1])


def test_a_burst_and_one_of_its_frames_are_in_the_same_dn(pressed: tuple[Path, Capture]) -> None:
    root, capture = pressed
    burst, of_burst = reconstructed(root, capture, *burst_of(capture))
    single, of_single = reconstructed(root, capture, "raw.tiff")
    used = sum(use["used"] for use in of_burst["frames"])
    assert used > 1
    # Light that pointed beyond the field moves with the eye.
    assert burst.mean() == pytest.approx(single.mean(), rel=0.02)
    assert of_burst["quality"]["mean_dn"] == pytest.approx(of_single["quality"]["mean_dn"], rel=0.01)
    assert of_burst["noise_dn"] == pytest.approx(of_single["noise_dn"] / used**0.5, rel=0.1)
