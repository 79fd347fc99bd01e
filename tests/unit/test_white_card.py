"""White card: its light in each colour, its refusals, its place in the archive, and colours balanced by it."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.calibration.archive import Archive, Provenance, StoredCalibration, parse_calibration, sealed, unsealed
from device.calibration.white_card import CardFrames, white_reference
from device.clock import SystemClock
from device.config.head_file import InstrumentSpec, load_head
from device.errors import CalibrationDamaged, CalibrationRefused, SpecError
from device.head import open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.optics.retina_chart import PAPER_REFLECTANCE
from device.recon.colour import RGB
from device.recon.colour_reconstructor import ColourReconstruction
from device.recon.white_balance import OVER_GREEN, balanced, light_dn_per_s, white_ratios
from device.sim.simulated_calibration import simulated_calibration
from device.values import Calibration, Colour, Frame, Illumination, Psf, Sensor, WhiteReference
from services.instrument.capture_pipeline import plan_pipeline
from services.instrument.press_exposure import expose_press
from services.workshop.calibration_words import details
from services.workshop.check_head import with_archive
from services.workshop.white_card_check import measure_white_card
from tests.scenes import speckle
from tests.simulated import coarse, world

SIM = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"
WHO = Provenance("sim-1", datetime(2026, 11, 26, tzinfo=UTC), "test", "0")
SENSOR = Sensor(black_dn=64.0, white_dn=4095.0)
CALIBRATION = Calibration((Psf(speckle((9, 9))),), SENSOR)
WHITE = WhiteReference((("green", 1000.0), ("red", 2500.0)))


@dataclass(frozen=True)
class Measured:
    """The simulated head with pixels of 10 um, its id before the white card, and the calibration with the card."""

    spec: InstrumentSpec
    archive: Archive
    before: str
    stored: StoredCalibration


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    folder = tmp_path_factory.mktemp("archive")
    spec, archive = with_archive(coarse(load_head(SIM), 2), folder), Archive(folder)
    archive.add_and_activate(simulated_calibration(world(spec)), WHO)
    before = archive.active_id()
    assert before is not None
    stored = measure_white_card(spec, SystemClock(), lambda _: pytest.fail("no operator is needed"), lambda _: None)
    return Measured(spec, archive, before, stored)


def test_a_card_makes_a_new_calibration_in_force(measured: Measured) -> None:
    archive, stored = measured.archive, measured.stored
    assert archive.active_id() == stored.calibration.id != measured.before
    assert archive.load().calibration.white == stored.calibration.white
    assert archive.load(measured.before).calibration.white is None, "the earlier calibration is as it was"


def test_the_card_gives_a_press_the_colours_of_the_retina(measured: Measured, tmp_path: Path) -> None:
    """Exposures, levels of the lamp and dark frames cancel: what is left is the reflectance of the retina over white.

    The simulated card is lit as the simulated eye is, so that lamp, sensor and diffuser are not tested.
    """
    clock = SystemClock()
    head = open_head(measured.spec, clock, MemoryLedger(clock))
    try:
        pipeline = plan_pipeline(head, clock, tmp_path)
        press = expose_press(head, ("OD",), clock, colours=("red",))
        retina = world(measured.spec).retina
        assert press.dark is not None
        lights = {
            lit(frame).colour: (frame.counts.mean() - press.dark.counts.mean()) / (frame.exposure_s * lit(frame).level)
            for frame in (press.lit[0], press.colours["red"])
        }
        green = pipeline.reconstructor.steps(press.lit[0].counts, simulated=True)
        assert pipeline.colours is not None
        red = {"red": [press.colours["red"].counts]}
        *_, made = pipeline.colours.steps(green, red, simulated=True, lights_dn_per_s=lights)
    finally:
        head.close()
    assert isinstance(made, ColourReconstruction)
    shares = {channel.name: channel.white_ratio for channel in made.report.channels}
    planes = {colour: retina.plane(colour) for colour in lights}
    # 1 %: a dark level that is off by 0.2 DN under the mean of 30 DN of the eye
    assert shares == {
        **{c: pytest.approx(plane[plane > 0].mean() / PAPER_REFLECTANCE, rel=0.01) for c, plane in planes.items()},
        "blue": None,
    }


def lit(frame: Frame) -> Illumination:
    assert frame.illumination is not None
    return frame.illumination


def card(light_dn: float, *, room_dn: float = 0.0, spread: float = 0.0, colour: Colour = "green") -> CardFrames:
    """Return frames of a card of this light in DN, with light of the room, whose second frame is brighter."""

    def frame(level_dn: float, number: int) -> Frame:
        counts = np.full((20, 30), min(round(SENSOR.black_dn + room_dn + level_dn), 4095), np.uint16)
        return Frame(counts, 0.01, number, Illumination(colour), True)

    return CardFrames([frame(light_dn, 1), frame(light_dn * (1 + spread), 2)], frame(0, 0), 0.5)


def test_the_reference_is_the_light_at_full_drive() -> None:
    found = dict(white_reference({"green": card(1000), "red": card(2000, colour="red")}, CALIBRATION).dn_per_s)
    assert found == pytest.approx({"green": 200_000.0, "red": 400_000.0})


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ({"green": card(5)}, r"in green light the card returns 5\.0 DN \(at least 20\)"),
        ({"green": card(5000)}, "in green light 100.0% of the pixels are saturated"),
        ({"green": card(1000, room_dn=400)}, r"the room's light is 40% of the lamp's in green \(at most 30%\)"),
        ({"green": card(1000, spread=0.05)}, r"in green light the frames differ by 4\.9% \(at most 2%\)"),
        ({"green": card(60), "red": card(3000)}, r"50 times as much red light as green light \(at most 20\)"),
    ],
)
def test_what_is_no_white_card_is_refused_with_its_remedy(frames: dict[Colour, CardFrames], message: str) -> None:
    with pytest.raises(CalibrationRefused, match=message) as caught:
        white_reference(frames, CALIBRATION)
    assert caught.value.remedy


@given(
    red=st.floats(0.001, 1.0),
    green=st.floats(0.001, 1.0),
    level=st.floats(0.1, 1e4),
    means=st.tuples(*[st.floats(0.01, 100.0)] * 3),
)
def test_the_means_of_a_balanced_picture_are_those_of_the_card(
    red: float, green: float, level: float, means: tuple[float, float, float]
) -> None:
    """For any level of the solved channels; blue, which was not taken, keeps the hue of an average retina."""
    field = np.zeros((8, 8), np.float32)
    field[2:6, 2:6] = 1
    picture = (np.array(means) * np.ones((8, 8, 3))).astype(np.float32)
    made = balanced(picture, field, {"red": red * level, "green": green * level})
    inside = made[field > 0.5].mean(axis=0)
    assert inside / inside[1] == pytest.approx([red / green, 1, OVER_GREEN["blue"]], rel=1e-4)
    assert inside[1] == pytest.approx(means[1], rel=1e-5)


@pytest.mark.parametrize("shares", [{}, {"red": 0.3}])
def test_without_a_card_the_hue_is_that_of_an_average_retina(shares: dict[Colour, float]) -> None:
    made = balanced(np.ones((4, 4, 3), np.float32), np.ones((4, 4), np.float32), shares)
    assert made.mean(axis=(0, 1)) == pytest.approx([OVER_GREEN[colour] for colour in RGB])


def test_colours_without_light_or_card_have_no_share() -> None:
    calibration = replace(CALIBRATION, white=WHITE)
    assert white_ratios(calibration, {"green": 10.0, "red": -1.0, "blue": 3.0}) == {"green": 0.01}
    assert white_ratios(CALIBRATION, {"green": 10.0}) == {}


def test_the_archive_keeps_a_white_reference_and_refuses_a_damaged_one(tmp_path: Path) -> None:
    archive = Archive(tmp_path)
    with_white = replace(CALIBRATION, white=WHITE)
    assert with_white.id != CALIBRATION.id
    archive.add_and_activate(with_white, WHO)
    kept = archive.load()
    assert kept.calibration.white == WHITE
    assert any("white card" in line and "green 1e+03, red 2.5e+03 DN/s" in line for line in details(kept))
    files = archive.files(with_white.id)
    text = unsealed(files["manifest.toml"])
    assert text.count("2500.0") == 1
    with pytest.raises(CalibrationDamaged, match="no light"):
        parse_calibration({**files, "manifest.toml": sealed(text.replace("2500.0", "-2500.0"))})


def test_a_simulated_card_does_not_change_the_calibration_of_a_real_head(tmp_path: Path) -> None:
    spec, archive = with_archive(coarse(load_head(SIM), 2), tmp_path), Archive(tmp_path)
    before = archive.add_and_activate(replace(simulated_calibration(world(spec)), simulated=False), WHO)
    with pytest.raises(CalibrationRefused, match="holds the calibration of a real one"):
        measure_white_card(spec, SystemClock(), lambda _: None, lambda _: None)
    assert archive.active_id() == before


def test_a_frame_of_another_shape_has_no_ratio() -> None:
    """The solver refuses it with its own error; what is measured beside must not end the process."""
    bad = np.zeros((20, 30), np.bool_)
    light = light_dn_per_s(np.ones((10, 15), np.uint16), None, replace(CALIBRATION, bad=bad), 0.1)
    assert white_ratios(replace(CALIBRATION, white=WHITE), {"green": light}) == {}


def test_a_head_with_green_leds_only_is_refused(tmp_path: Path) -> None:
    power = with_archive(load_head(SIM.with_name("imx296_power.toml")), tmp_path)
    assert power.light.sinks is not None
    green = power.light.sinks.model_copy(update={"amber": None})
    power = power.model_copy(update={"light": power.light.model_copy(update={"sinks": green})})
    with pytest.raises(SpecError, match="takes no colour pictures"):
        measure_white_card(power, SystemClock(), lambda _: None, lambda _: None)


def test_a_head_file_without_an_archive_is_refused() -> None:
    with pytest.raises(SpecError, match="no archive"):
        measure_white_card(load_head(SIM), SystemClock(), lambda _: None, lambda _: None)
