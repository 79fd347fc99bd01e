"""Value types: validated on construction, frozen, and read-only."""

import dataclasses
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.errors import FrameError, PsfError, SettingError
from device.values import (
    Calibration,
    Colour,
    ExposureSettings,
    Frame,
    Geometry,
    Illumination,
    Psf,
    Reconstruction,
    Report,
    Sensor,
    check_image_shape,
)
from services.records.capture import Capture

COUNTS = np.arange(12, dtype=np.uint16).reshape(3, 4)
DESIGNED = [  # public interface: keys of report.json
    "method",
    "bin",
    "rounds",
    "stopped",
    "seconds",
    "psf_index",
    "psf_scale",
    "psf_cylinder",
    "refraction_dpt",
    "refraction_scatter",
    "regularisation",
    "noise_dn",
    "residual",
    "quality",
    "warnings",
    "frames",
    "channels",
]


def frame(counts: Any = COUNTS) -> Frame:
    return Frame(counts, 0.1, 1, Illumination("green"), simulated=True)


def psf(shape: tuple[int, ...] = (5, 6)) -> Any:
    return np.random.default_rng(0).random(shape).astype(np.float32)


def test_report_fields_are_the_public_keys() -> None:
    assert [field.name for field in dataclasses.fields(Report)] == DESIGNED


@pytest.mark.parametrize("level", [0.0, -0.1, 1.01, float("nan"), float("inf")])
def test_invalid_lamp_level_is_refused(level: float) -> None:
    with pytest.raises(SettingError, match="lamp level"):
        Illumination("green", level)


@pytest.mark.parametrize("exposure_s", [0.0, -1, 10.1, float("nan"), float("inf")])
def test_invalid_exposure_is_refused(exposure_s: float) -> None:
    with pytest.raises(SettingError, match="exposure"):
        ExposureSettings(exposure_s)


def test_frame_is_read_only_and_its_buffer_is_reusable() -> None:
    buffer = COUNTS.copy()
    taken = frame(buffer)
    with pytest.raises(ValueError, match="read-only"):
        taken.counts[0, 0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        taken.simulated = False  # type: ignore[misc]
    buffer[0, 0] = 99
    assert taken.counts[0, 0] == 99


@pytest.mark.parametrize("counts", [COUNTS.astype(np.float32), COUNTS.astype(np.int16), COUNTS.astype(np.uint8)])
def test_frame_requires_uint16(counts: Any) -> None:
    with pytest.raises(FrameError, match="uint16"):
        frame(counts)


@pytest.mark.parametrize("shape", [(), (3,), (0, 3), (3, 0), (3, 4, 1), (3, 4, 2), (3, 4, 4), (1, 3, 4, 3), (0, 0, 3)])
def test_invalid_image_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(FrameError, match="rows and columns"):
        check_image_shape(shape)
    with pytest.raises(FrameError):
        frame(np.zeros(shape, np.uint16))
    with pytest.raises(FrameError):
        Reconstruction(np.zeros(shape, np.float32), Report("m"), simulated=False)


@given(st.integers(1, 50), st.integers(1, 50), st.booleans())
def test_valid_image_shapes_are_accepted(rows: int, cols: int, colour: bool) -> None:
    check_image_shape((rows, cols, 3) if colour else (rows, cols))


def test_psf_is_normalised_to_sum_one() -> None:
    for scale in (1e-3, 1, 4095):
        made = Psf(psf() * np.float32(scale))
        assert made.pixels.sum(dtype=np.float64) == pytest.approx(1, rel=1e-4)
        assert made.pixels.dtype == np.float32
        assert not made.pixels.flags.writeable


BAD = {"nan": np.nan, "infinite": np.inf}


@pytest.mark.parametrize("value", BAD.values(), ids=BAD)
def test_psf_with_nan_or_infinity_is_refused(value: float) -> None:
    pixels = psf()
    pixels[2, 3] = value
    with pytest.raises(PsfError, match="holds 1 values that are not numbers"):
        Psf(pixels)


@pytest.mark.parametrize("pixels", [np.zeros((4, 4)), -np.ones((4, 4)), np.array([[1.0, -3.0]])])
def test_psf_without_positive_sum_is_refused(pixels: Any) -> None:
    with pytest.raises(PsfError, match="positive sum"):
        Psf(pixels)


@pytest.mark.parametrize("shape", [(5,), (5, 5, 3), (0, 5)])
def test_a_psf_has_rows_and_columns(shape: tuple[int, ...]) -> None:
    with pytest.raises(PsfError, match="rows and columns"):
        Psf(np.ones(shape, np.float32))


def test_a_calibration_needs_psfs_of_one_size() -> None:
    with pytest.raises(PsfError, match="without a PSF"):
        Calibration((), Sensor())
    with pytest.raises(PsfError, match="same rows and columns"):
        Calibration((Psf(psf()), Psf(psf((6, 6)))), Sensor())


COLOURS: tuple[Colour, ...] = ("red", "green", "blue")
COLOURED: tuple[tuple[str, Colour | None], ...] = (
    ("every", None),
    ("near", "green"),
    ("far", "green"),
    ("red", "red"),
)
CHANGES: dict[str, Any] = {
    "psfs": (Psf(psf() ** 2),),
    "sensor": Sensor(black_dn=1),
    "geometry": Geometry(5, 6000, 0.75),
    "field_deg": 33.0,
    "dark_dn": psf(),
    "flat": psf(),
    "bad": psf() > 0.5,
}


@pytest.mark.parametrize("what", CHANGES)
def test_calibration_id_changes_with_each_measured_value(what: str) -> None:
    before = Calibration((Psf(psf()),), Sensor())
    assert before.id == Calibration((Psf(psf()),), Sensor()).id
    assert len(before.id) == 16
    assert dataclasses.replace(before, **{what: CHANGES[what]}).id != before.id


def test_calibration_for_one_colour_selects_its_psfs() -> None:
    every, near, far, red = (Psf(psf(), name, colour) for name, colour in COLOURED)
    seen = {c: [p.name for p in Calibration((every, near, far, red), Sensor()).for_colour(c).psfs] for c in COLOURS}
    assert seen == {"red": ["red"], "green": ["near", "far"], "blue": ["every"]}
    assert Calibration((near, red), Sensor()).for_colour("blue").psfs == (near,)
    depths = Calibration((every, every), Sensor())
    assert depths.for_colour("green").psfs is not None
    assert depths.for_colour("green").id == depths.id


def test_calibration_id_depends_on_the_psfs_colour() -> None:
    assert Calibration((Psf(psf()),), Sensor()).id != Calibration((Psf(psf(), colour="red"),), Sensor()).id


def test_calibration_id_distinguishes_dark_and_flat() -> None:
    dark = Calibration((Psf(psf()),), Sensor(), dark_dn=psf())
    flat = Calibration((Psf(psf()),), Sensor(), flat=psf())
    assert dark.id != flat.id


def test_the_papers_numbers() -> None:
    geometry = Geometry(pitch_um=5.04, diffuser_to_sensor_um=6000, angular_magnification=0.75)
    assert geometry.px_per_deg == pytest.approx(15.58, abs=0.01)
    assert geometry.scale_per_dpt == pytest.approx(0.003375)


def test_measured_scale_per_dioptre_overrides_the_nominal() -> None:
    geometry = Geometry(5.04, 6000, 0.75, measured_scale_per_dpt=0.0035)
    assert geometry.scale_per_dpt == 0.0035
    assert geometry.nominal_scale_per_dpt == pytest.approx(0.003375)
    assert Geometry(5.04, 6000, 0.75).scale_per_dpt == geometry.nominal_scale_per_dpt


def test_capture_ids_sort_by_time_and_name_the_eye() -> None:
    names = [Capture.new_id(datetime(2026, 1, day, 9, 5, tzinfo=UTC), "OS", "ff") for day in (2, 10, 21)]
    assert names == sorted(names)
    assert names[0] == "20260102T090500-OS-ff"
