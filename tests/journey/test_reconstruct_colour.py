"""`diffuscope reconstruct --channel NAME RAW PSF ...`: one colour picture, with what became of each channel."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from device.calibration.archive import Archive, Provenance
from device.clock import VirtualClock
from device.recon.colour import RGB
from device.recon.white_balance import OVER_GREEN
from device.values import Colour, Illumination, Psf
from services.imaging.picture_files import raw_tiff
from services.imaging.raw_metadata import RawMetadata
from tests.journey.wrong_inputs import Answer, call
from tests.moving_retina import PSF, RETINA, SHAPE, burst_calibration, field, frame, seen

SHIFTS_PX = {"red": (2.0, -3.0), "green": (0.0, 0.0), "green2": (1.5, 1.0)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a red frame, two green ones, a smaller one, a dark frame, and the PSF."""
    folder = tmp_path_factory.mktemp("colour")
    for number, (name, moved) in enumerate(SHIFTS_PX.items()):
        np.save(folder / f"{name}.npy", frame(seen(RETINA, moved), 8000, number))
    np.save(folder / "small.npy", frame(seen(RETINA, (0, 0)), 5000, 1)[8:-8])
    np.save(folder / "dark.npy", np.full(SHAPE, 64, np.uint16))
    centred = np.zeros(SHAPE, np.float32)
    centred[140:221, 200:281] = PSF.pixels
    np.save(folder / "psf.npy", (centred / centred.max() * 60000).astype(np.uint16))
    return folder


def reconstruct(folder: Path, *channels: str, out: str = "out.npy") -> list[str]:
    """Return the words of the command for channels such as `red=red.npy`."""
    words = ["reconstruct", "-o", str(folder / out), "--report", str(folder / "report.json")]
    for channel in channels:
        name, _, file = channel.partition("=")
        words += ["--channel", name, str(folder / file), str(folder / "psf.npy")]
    return words


def refusal(answer: Answer) -> str:
    assert answer.code == 2, answer.err
    return answer.err


def test_red_and_two_greens_give_a_colour_picture_with_a_predicted_blue(folder: Path) -> None:
    words = reconstruct(folder, "green=green.npy", "red=red.npy", "green=green2.npy")
    done = call([*words, "--dark", f"red={folder / 'dark.npy'}"])
    assert done.code == 0, done.err
    assert "blue is predicted" in done.err
    report = json.loads((folder / "report.json").read_text())
    assert [(channel["name"], channel["predicted"]) for channel in report["channels"]] == [
        ("green", False),
        ("red", False),
        ("blue", True),
    ]
    assert report["channels"][1]["shift_px"] == pytest.approx(SHIFTS_PX["red"], abs=0.5)  # a quarter of a sample
    assert report["channels"][2]["shift_px"] is None
    assert [use["index"] for use in report["frames"]] == [0, 1], "frames are those of the burst, as in a press"
    assert report["frames"][1]["shift_px"] == pytest.approx(SHIFTS_PX["green2"], abs=0.3)  # as in bursts
    picture = np.load(folder / "out.npy")
    assert picture.shape == (*SHAPE, 3)
    means = picture[field() > 0.5].mean(axis=0)  # without a white card, as in a press
    # The field is found in the picture, and its edge is smoothed over 6 of 150 pixels.
    assert means / means[1] == pytest.approx([OVER_GREEN[colour] for colour in RGB], rel=0.02)
    assert call(reconstruct(folder, "red=red.npy", "green=green.npy", out="out.png")).code == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--channel", "violet", "a.npy", "b.npy"], "Choose from red, green, blue, amber."),
        (["--channel", "green", "a.npy"], "Give --channel NAME RAW PSF"),
        (["a.npy", "--channel", "green", "a.npy", "b.npy"], "Give every raw with --channel."),
        (["a.npy", "--psf", "b.npy", "--dark", "red=c.npy"], "Give --dark FILE without a name."),
        (["--channel", "green", "a.npy", "b.npy", "--dark", "red=c.npy"], "which is no channel"),
        (["--channel", "green", "a.npy", "b.npy", "--psf", "b.npy"], "a PSF of its own"),
        (["--channel", "green", "a.npy", "b.npy"], "Give --channel again for another colour."),
        (["--channel", "green", "a", "b", "--channel", "red", "c", "b", "--even"], "Leave --even and --sweep out."),
        ([], "no raw is given"),
    ],
)
def test_wrong_channels_are_refused_with_the_remedy(folder: Path, words: list[str], message: str) -> None:
    assert message in refusal(call(["reconstruct", "-o", str(folder / "x.npy"), *words]))


def test_channels_of_different_size_or_without_a_file_are_refused(folder: Path) -> None:
    assert "344 x 480" in refusal(call(reconstruct(folder, "red=small.npy", "green=green.npy")))
    assert "missing.npy" in refusal(call(reconstruct(folder, "red=missing.npy", "green=green.npy")))


@pytest.mark.parametrize("input", ["red.npy", "psf.npy", "dark.npy"])
def test_no_input_of_a_colour_picture_is_overwritten(folder: Path, input: str) -> None:
    before = (folder / input).read_bytes()
    words = [*reconstruct(folder, "red=red.npy", "green=green.npy", out=input), "--dark", f"red={folder / 'dark.npy'}"]
    assert "would be overwritten" in refusal(call(words))
    assert (folder / input).read_bytes() == before


def test_a_time_budget_is_shared_by_the_channels(folder: Path) -> None:
    words = [*reconstruct(folder, "red=red.npy", "green=green.npy"), "--budget-s", "20"]
    assert call(words).code == 0
    assert json.loads((folder / "report.json").read_text())["given"]["budget_s"] == 20


LIGHTS: tuple[Colour, ...] = ("green", "red")


@pytest.fixture(scope="module")
def archive(folder: Path) -> Path:
    """An archive whose calibration in force has a PSF in green and one in red, which is that of green upside down."""
    centred = np.load(folder / "psf.npy").astype(np.float32)
    turned = np.ascontiguousarray(np.roll(centred[::-1], 1, axis=0))  # its centre stays at rows // 2
    psfs = tuple(Psf(pixels, name, name) for name, pixels in zip(LIGHTS, (centred, turned), strict=True))
    np.save(folder / "turned.npy", turned)
    provenance = Provenance("D1", VirtualClock().wall(), "test", "0")
    Archive(folder / "archive").add_and_activate(replace(burst_calibration(), psfs=psfs), provenance)
    return folder / "archive"


def raw_in(light: Colour, folder: Path) -> Path:
    """Return a raw frame of the instrument that states its light."""
    place = folder / f"stated-{light}.tiff"
    stated = RawMetadata(illumination=Illumination(light, 1.0), simulated=True)
    place.write_bytes(raw_tiff(frame(seen(RETINA, (0, 0)), 8000, 3), stated))
    return place


def test_one_raw_is_solved_with_the_psf_of_the_light_that_it_states(folder: Path, archive: Path) -> None:
    """The other PSF explains the frame better, and would be taken from a stack."""
    words = ["reconstruct", str(raw_in("red", folder)), "--method", "tikhonov", "-o"]
    assert call([*words, str(folder / "archived.npy"), "--calibration", str(archive)]).code == 0
    for name in ("psf", "turned"):
        assert call([*words, str(folder / f"by-{name}.npy"), "--psf", str(folder / f"{name}.npy")]).code == 0
    made, green, red = (np.load(folder / f"{name}.npy").ravel() for name in ("archived", "by-psf", "by-turned"))
    assert np.corrcoef(made, red)[0, 1] > np.corrcoef(made, green)[0, 1]


def test_a_raw_in_a_light_without_a_psf_is_refused(folder: Path, archive: Path) -> None:
    words = ["reconstruct", str(raw_in("blue", folder)), "--calibration", str(archive), "-o", str(folder / "x.npy")]
    assert "was taken in blue light, and the calibration has no PSF for it" in refusal(call(words))


def test_a_raw_that_states_another_light_than_its_channel_is_refused(folder: Path) -> None:
    red, psf = str(raw_in("red", folder)), str(folder / "psf.npy")
    words = ["--channel", "green", red, psf, "--channel", "blue", str(folder / "green.npy"), psf]
    assert "was taken in red light, and is given as green" in refusal(
        call(["reconstruct", *words, "-o", str(folder / "x.npy")])
    )
