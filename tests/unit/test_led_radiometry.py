"""Tests of the LED readings: checked, stored with the calibration, and used for ring trims and the light guard."""

from pathlib import Path

import pytest

from device.calibration.archive import Archive
from device.calibration.led_radiometry import load_led_readings, missing_readings, with_led_radiometry
from device.clock import VirtualClock
from device.config.head_file import ChainSpec, InstrumentSpec, load_head
from device.errors import SpecError
from device.head import hazard_of, open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.optics.illumination import photon_budget
from services.instrument.calibration_request import CalibrationRequest
from services.workshop.calibrate_head import calibrate
from tests.unit.test_calibration_measurements import small_world

RING = (19, 20, 26, 29, 34, 37, 43, 44)
HEADS = Path(__file__).parents[2] / "hardware" / "heads"


def entry(led: int, colour: str = "green", peak_nm: float = 522.0, **keys: float) -> str:
    values = {"power_mw": 0.0175, "waist_mw_per_cm2": 1.8} | keys
    lines = [f"led = {led}", f'colour = "{colour}"', f"peak_nm = {peak_nm}", *(f"{k} = {v}" for k, v in values.items())]
    return "\n[[led]]\n" + "\n".join(lines)


def readings(folder: Path, *entries: str, before: str = "") -> Path:
    path = folder / "leds.toml"
    path.write_text(f'measured = "2026-11-20, a power meter"\n{before}' + "".join(entries), encoding="utf-8")
    return path


@pytest.fixture
def spec() -> InstrumentSpec:
    return load_head(HEADS / "imx296.toml")


def test_readings_are_stored_with_the_calibration_and_used_when_the_head_opens(tmp_path: Path) -> None:
    greens = (entry(led, power_mw=0.0175 * (1 + led / 100), peak_nm=520 + led / 10) for led in RING)
    path = readings(tmp_path, *greens, *(entry(led, "red", 622.0) for led in RING[1:]))
    spec = small_world(coarser=8).spec
    light = spec.light.model_copy(update={"chain": ChainSpec()})
    spec = spec.model_copy(update={"light": light})
    messages: list[str] = []
    kept = calibrate(
        spec,
        CalibrationRequest(tmp_path, None, "me", None, leds=path),
        VirtualClock(),
        messages.append,
        messages.append,
    )
    assert kept.provenance.meter == "2026-11-20, a power meter"
    assert messages[:2] == [
        "red: not LED 19 was measured in full; the guard takes this colour at its worst",
        "blue: no LED was measured in full; the guard takes this colour at its worst",
    ]
    assert Archive(tmp_path).load().provenance == kept.provenance
    table = type("T", (), {"archive": tmp_path})()
    clock = VirtualClock()
    with_archive = spec.model_copy(update={"calibration": table})
    head = open_head(with_archive, clock, MemoryLedger(clock))
    chain, measured = head.spec.light.chain, head.spec.light.radiometry
    assert chain is not None
    assert measured is not None
    assert chain.leds == RING
    assert chain.trims == pytest.approx([1.19 / (1 + led / 100) for led in RING])
    assert measured.red is None
    assert measured.blue is None
    assert measured.green is not None
    assert measured.green.wavelength_um == pytest.approx(0.5219)
    whole = (
        1.4  # the centre over the mean of the narrowest cap
        * photon_budget("green", 1.0, leds=12).retina_mw_per_cm2
        * 8
        * 0.0175
        * 1.19
        / photon_budget("green", 1.0).cornea_mw
    )
    assert measured.green.retina_mw_per_cm2 == pytest.approx(whole, rel=1e-6)
    guard, unmeasured = head.light.hazard, hazard_of(spec)
    assert guard.beams["green"].retina_w_per_cm2 == pytest.approx(1.3e-3 * whole)
    assert guard.beams["red"] == unmeasured.beams["red"]
    assert guard.beams["green"].retina_w_per_cm2 < unmeasured.beams["green"].retina_w_per_cm2


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        (
            [entry(20), entry(19, peak_nm=622)],
            "line 9: led.1: LED 19 in green: 622 is not between 500 and 560 (peak_nm)",
        ),
        ([entry(19, power_mw=17.5)], "17.5 is not between 0.0001 and 1 (power_mw)"),
        ([entry(19, waist_mw_per_cm2=0)], "0 is not between 0.01 and 130"),
        ([entry(19, waist_mw_per_cm2=18)], "0.141 mW in a disc of 1 mm are more than the 0.0175 mW"),
        ([entry(19), entry(19)], "LED 19 in green stands there twice"),
        ([entry(19), entry(20, power_mw=0.002, waist_mw_per_cm2=0.1)], "LED 20 in green: 0.002 mW are 11% of"),
        ([entry(5)], "LED 5 is not on the ring"),
        ([entry(19, "amber")], "colour"),
        ([entry(19), entry(20, current=3)], "leds.toml, line 15: 'led.1.current' is not a known key"),
        ([], "led"),
    ],
)
def test_an_implausible_reading_is_refused_with_its_led(
    tmp_path: Path, spec: InstrumentSpec, entries: list[str], words: str
) -> None:
    with pytest.raises(SpecError) as caught:
        load_led_readings(readings(tmp_path, *entries), spec)
    assert words in caught.value.message
    assert caught.value.remedy


def test_a_head_without_a_chain_refuses_readings(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"light\.chain"):
        load_led_readings(readings(tmp_path, entry(19)), load_head(HEADS / "sim.toml"))


def test_missing_readings_stay_unknown(tmp_path: Path, spec: InstrumentSpec) -> None:
    green = '\n[[led]]\nled = 19\ncolour = "green"\npeak_nm = 522\n'
    read = load_led_readings(readings(tmp_path, green, before="guard_factor = 2.0\n"), spec)
    assert [line.split(":")[0] for line in missing_readings(read, spec)] == ["red", "green", "blue"]
    found = with_led_radiometry(spec, read.figures, "calibration x")
    assert found.light.radiometry is not None
    assert found.light.radiometry.green is None
    assert found.light.radiometry.guard_factor == 2.0
    assert hazard_of(found).beams == hazard_of(spec).beams
    assert with_led_radiometry(spec, {}, "calibration x") is spec


def test_radiometry_of_the_head_file_takes_precedence(tmp_path: Path, spec: InstrumentSpec) -> None:
    read = load_led_readings(readings(tmp_path, *(entry(led) for led in RING)), spec)
    once = with_led_radiometry(spec, read.figures, "first")
    assert with_led_radiometry(once, read.figures, "second") is once
