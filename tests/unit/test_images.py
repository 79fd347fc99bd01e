"""Image files and counts of every kind brought to one kind, and a clear word about all others."""

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from device.errors import FrameError, PsfError, SettingError
from device.images import as_psf, as_raw, read_image, read_psf, refuse_other_sizes, says_simulated, write_linear
from device.values import Psf
from services.records.picture import raw_tiff

SHAPE = (200, 300)


def twelve_bit(seed: int = 0, shape: tuple[int, ...] = SHAPE) -> Any:
    return np.random.default_rng(seed).integers(0, 4096, shape).astype(np.uint16)


# Counts


def test_left_justified_counts_come_back_and_two_stray_pixels_are_bad() -> None:
    counts = twelve_bit()
    words = counts << np.uint16(4)
    words[0, :2] = 0x1239, 0x0007  # what the DiffuserCam tutorial's files begin with
    raw = as_raw(words)
    assert raw.shift == 4
    assert raw.white_dn == 4095
    assert raw.pixels.dtype == np.uint16
    assert np.array_equal(raw.pixels[1:], counts[1:])
    assert raw.bad.sum() == 2
    assert raw.bad[0, :2].all()


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_any_converter_moved_to_the_left_is_moved_back(bits: int) -> None:
    counts = np.random.default_rng(1).integers(0, 2**bits, SHAPE).astype(np.uint16)
    raw = as_raw(counts << np.uint16(16 - bits))
    assert (raw.shift, raw.white_dn, raw.bad.any()) == (16 - bits, 2**bits - 1, False)
    assert np.array_equal(raw.pixels, counts)


def test_three_channels_share_one_justification_and_one_bad_mask() -> None:
    counts = twelve_bit(2, (*SHAPE, 3))
    words = counts << np.uint16(4)
    words[7, 9, 1] |= 1
    raw = as_raw(words)
    assert raw.shift == 4
    assert raw.bad.shape == SHAPE
    assert raw.bad.sum() == 1
    assert raw.bad[7, 9]


@given(hnp.arrays(np.uint16, st.tuples(st.integers(1, 40), st.integers(1, 40))))
@settings(max_examples=200)
def test_right_justified_counts_are_never_moved_nor_marked(counts: Any) -> None:
    counts[0, 0] |= 1  # an odd count among at most 1600: no left-justified file looks like that
    raw = as_raw(counts)
    assert raw.shift == 0
    assert not raw.bad.any()
    assert np.array_equal(raw.pixels, counts)
    assert raw.pixels.max() <= raw.white_dn


@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
def test_a_few_stars_on_a_black_sky_are_not_taken_for_left_justified(seed: int, stars: int) -> None:
    rng = np.random.default_rng(seed)
    sky = np.zeros((400, 500), np.uint16)
    sky.flat[rng.choice(sky.size, stars, replace=False)] = rng.integers(1, 65536, stars)
    sky[0, 0] = 4097
    raw = as_raw(sky)
    assert raw.shift == 0
    assert not raw.bad.any()


def test_a_dim_or_black_frame_stays_as_it_is() -> None:
    for counts in (np.zeros(SHAPE, np.uint16), np.full(SHAPE, 16, np.uint16), twelve_bit() // 16 * 16 // 16):
        raw = as_raw(counts)
        assert raw.shift == 0
        assert np.array_equal(raw.pixels, counts)


@pytest.mark.parametrize(
    ("dtype", "top", "white"),
    [(np.uint8, 200, 255), (np.uint16, 1000, 1023), (np.int32, 4000, 4095), (np.uint64, 65535, 65535)],
)
def test_whole_numbers_of_any_width_become_counts(dtype: Any, top: int, white: int) -> None:
    array = np.array([[1, 7], [3, top]], dtype)
    raw = as_raw(array)
    assert raw.pixels.dtype == np.uint16
    assert np.array_equal(raw.pixels, array)
    assert raw.white_dn == white


def test_what_no_sensor_counts_is_refused() -> None:
    with pytest.raises(FrameError, match="negative"):
        as_raw(np.array([[1, -1]], np.int16))
    with pytest.raises(FrameError, match="70000"):
        as_raw(np.array([[1, 70000]], np.int32))


@given(hnp.arrays(np.float64, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.floats(width=32)))
def test_floats_stay_and_what_is_no_number_is_bad_and_zero(array: Any) -> None:
    raw = as_raw(array)
    assert raw.pixels.dtype == np.float32
    assert np.array_equal(raw.bad, ~np.isfinite(array))
    assert np.array_equal(raw.pixels[~raw.bad], array[~raw.bad].astype(np.float32))
    assert (raw.pixels[raw.bad] == 0).all()
    assert raw.white_dn == float("inf")


# Point spread functions


def spot() -> Any:
    rows, cols = np.ogrid[:60, :80]
    return np.exp(-((rows - 30) ** 2 + (cols - 40) ** 2) / 40.0).astype(np.float32)


@given(st.floats(0, 1000))
def test_a_pedestal_is_taken_off(pedestal: float) -> None:
    with_pedestal = as_psf(spot() * 1000 + np.float32(pedestal), "p")
    assert np.allclose(with_pedestal.pixels, as_psf(spot(), "q").pixels, atol=2e-6)
    assert abs(float(with_pedestal.pixels[0].mean())) < 1e-6


def test_noise_around_the_pedestal_is_not_clipped_into_mass() -> None:
    noise = np.random.default_rng(3).normal(0, 5, (60, 80))
    psf = as_psf((spot() * 1000 + noise + 64).astype(np.float32), "p")
    assert (psf.pixels < 0).sum() > 1000
    assert psf.pixels[20:40, 30:50].sum() == pytest.approx(1, abs=0.15)


def test_a_psf_in_left_justified_counts_is_the_same_psf() -> None:
    counts = np.rint(spot() * 4000).astype(np.uint16)
    assert np.allclose(as_psf(counts, "p").pixels, as_psf(counts << np.uint16(4), "q").pixels, atol=1e-9)


def test_a_colour_psf_is_averaged() -> None:
    colour = np.stack([spot(), 2 * spot(), 3 * spot()], axis=2)
    assert np.allclose(as_psf(colour, "p").pixels, as_psf(spot(), "q").pixels, atol=1e-7)


NO_PSF: dict[str, Callable[[], Any]] = {
    "nan": lambda: np.where(spot() > 0.99, np.nan, spot()),
    "infinite": lambda: np.where(spot() > 0.99, np.inf, spot()),
    "zero": lambda: np.zeros(SHAPE, np.float32),
    "even": lambda: np.full(SHAPE, 7.0, np.float32),
    "negative": lambda: -spot(),
    "negative counts": lambda: -(spot() * 100).astype(np.int16),
}


@pytest.mark.parametrize("kind", NO_PSF)
def test_what_cannot_be_a_psf_is_refused_by_name(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "measured.npy"
    np.save(path, NO_PSF[kind]())
    with pytest.raises(PsfError) as refused:
        read_psf(path)
    assert refused.value.remedy
    assert "measured.npy" in refused.value.message


def test_psfs_of_another_camera_mode_are_refused() -> None:
    psf = Psf(np.ones((4, 6), np.float32), "half.tiff")
    refuse_other_sizes((psf,), (4, 6))
    with pytest.raises(PsfError, match=r"half\.tiff has 4 x 6 pixels, the raw 8 x 12"):
        refuse_other_sizes((psf,), (8, 12))


# Files

GOOD: dict[str, Any] = {
    "grey.png": np.arange(24, dtype=np.uint8).reshape(4, 6),
    "deep.png": np.arange(24, dtype=np.uint16).reshape(4, 6) * 1000,
    "colour.png": np.arange(72, dtype=np.uint8).reshape(4, 6, 3),
    "grey.tiff": np.arange(24, dtype=np.uint16).reshape(4, 6),
    "colour.tif": np.arange(72, dtype=np.uint16).reshape(4, 6, 3),
    "float.tiff": np.linspace(-1, 1, 24, dtype=np.float32).reshape(4, 6),
    "double.npy": np.linspace(-1, 1, 24).reshape(4, 6),
    "colour.npy": np.arange(72, dtype=np.uint16).reshape(4, 6, 3),
    "UPPER.NPY": np.arange(24, dtype=np.uint8).reshape(4, 6),
}


def write(path: Path, array: Any) -> None:
    match path.suffix.lower():
        case ".npy":
            with path.open("wb") as file:
                np.save(file, array)
        case ".png":
            Image.fromarray(array).save(path)
        case _:
            tifffile.imwrite(path, array, photometric="rgb" if array.ndim == 3 else "minisblack")


@pytest.mark.parametrize("name", GOOD)
def test_what_was_written_is_read_as_it_was(tmp_path: Path, name: str) -> None:
    write(tmp_path / name, GOOD[name])
    back = read_image(tmp_path / name)
    assert back.dtype == GOOD[name].dtype
    assert np.array_equal(back, GOOD[name])


def test_an_alpha_channel_is_dropped_and_a_palette_resolved(tmp_path: Path) -> None:
    alpha = np.dstack([GOOD["colour.png"], np.full((4, 6), 255, np.uint8)])
    write(tmp_path / "a.png", alpha)
    assert np.array_equal(read_image(tmp_path / "a.png"), GOOD["colour.png"])
    Image.fromarray(GOOD["colour.png"]).convert("P").save(tmp_path / "p.png")
    assert read_image(tmp_path / "p.png").shape == (4, 6, 3)


def test_a_png_of_sixteen_bit_colour_is_refused_and_not_halved(tmp_path: Path) -> None:
    file = bytearray(b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + b"\0\0\0\x01\0\0\0\x01" + b"\x10\x02\0\0\0")
    (tmp_path / "deep.png").write_bytes(file)
    with pytest.raises(FrameError, match="16-bit colour") as refused:
        read_image(tmp_path / "deep.png")
    assert "tiff" in refused.value.remedy


def refused_file(path: Path, words: str) -> None:
    with pytest.raises(FrameError, match=words) as refused:
        read_image(path)
    assert str(path) in refused.value.message
    assert refused.value.remedy


def test_what_is_no_image_file_is_refused_by_its_name(tmp_path: Path) -> None:
    refused_file(tmp_path / "none.tiff", "No such file")
    refused_file(tmp_path, "cannot be read")
    for name in ("empty.tiff", "empty.png", "empty.npy"):
        (tmp_path / name).touch()
        refused_file(tmp_path / name, "is empty")
    for name in ("text.png", "text.tiff", "text.npy"):
        (tmp_path / name).write_text("This is a text, not an image.\n" * 20)
        refused_file(tmp_path / name, "is not a whole")
    (tmp_path / "raw.jpg").write_bytes(b"whatever")
    refused_file(tmp_path / "raw.jpg", "the ending '.jpg' is not one of")


def test_arrays_that_are_no_images_are_refused(tmp_path: Path) -> None:
    for name, array in {
        "line": np.zeros(5), "two": np.zeros((4, 4, 2)), "none": np.zeros((0, 4)), "complex": np.zeros((4, 4), complex),
        "bool": np.zeros((4, 4), bool), "text": np.array([["a", "b"]]), "stack": np.zeros((2, 4, 4, 3)),
    }.items():  # fmt: skip
        np.save(tmp_path / f"{name}.npy", array)
        refused_file(tmp_path / f"{name}.npy", "shape|type")
    np.save(tmp_path / "object.npy", np.array([[{}]]), allow_pickle=True)
    refused_file(tmp_path / "object.npy", "is not a whole")


def test_a_header_that_promises_the_whole_memory_is_refused(tmp_path: Path) -> None:
    out = BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": "<f8", "fortran_order": False, "shape": (2**24, 2**24)})
    (tmp_path / "huge.npy").write_bytes(out.getvalue())
    refused_file(tmp_path / "huge.npy", "is not a whole")


def read_or_refuse(path: Path) -> tuple[str, Any]:
    try:
        return "", read_image(path)
    except FrameError as error:
        return f"{error.message} {error.remedy}", None


@pytest.mark.parametrize("name", ["grey.png", "deep.png", "grey.tiff", "packed.tiff", "colour.npy"])
def test_a_file_cut_off_anywhere_is_refused_with_words(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "packed.tiff":
        path.write_bytes(raw_tiff(twelve_bit(0, (20, 30)), {"eye": "OD"}))
    else:
        write(
            path, np.random.default_rng(0).integers(0, 255, (20, 30)).astype(np.uint8 if "grey" in name else np.uint16)
        )
    whole, image = path.read_bytes(), read_image(path)
    refused = 0
    for length in range(1, len(whole), max(1, len(whole) // 60)):
        path.write_bytes(whole[:length])
        words, back = read_or_refuse(path)
        if back is None:
            refused += 1
            assert str(path) in words
        else:  # what was cut off was not part of the picture
            assert np.array_equal(back, image)
    assert refused > 20


@given(st.integers(0, 2**32 - 1), st.sampled_from([".tiff", ".png", ".npy"]))
@settings(max_examples=150, deadline=None, derandomize=True)
def test_damaged_files_are_images_or_refused_and_nothing_else(seed: int, suffix: str) -> None:
    path = Path("/dev/shm") / f"diffuscope-damaged{suffix}"
    try:
        write(path, twelve_bit(0, (16, 16)))
        data, rng = bytearray(path.read_bytes()), np.random.default_rng(seed)
        for place in rng.integers(0, min(len(data), 200), 4):
            data[place] = rng.integers(0, 256)
        path.write_bytes(data)
        words, back = read_or_refuse(path)
        assert words if back is None else back.ndim in (2, 3)
    finally:
        path.unlink(missing_ok=True)


def test_a_kept_raw_says_that_it_was_simulated_and_others_do_not(tmp_path: Path) -> None:
    counts = twelve_bit()
    for name, facts, said in (("a.tiff", {"simulated": True}, True), ("b.tiff", {"simulated": False}, False)):
        (tmp_path / name).write_bytes(raw_tiff(counts, facts))
        assert says_simulated(tmp_path / name) is said
    tifffile.imwrite(tmp_path / "c.tiff", counts)
    tifffile.imwrite(tmp_path / "d.tiff", counts, description="simulated: true", metadata=None)
    np.save(tmp_path / "e.npy", counts)
    assert not any(says_simulated(tmp_path / name) for name in ("c.tiff", "d.tiff", "e.npy", "none.tiff"))


@pytest.mark.parametrize("name", ["x.npy", "x.tiff", "x.tif"])
def test_linear_pictures_come_back_exactly(tmp_path: Path, name: str) -> None:
    picture = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    write_linear(tmp_path / name, picture)
    assert np.array_equal(read_image(tmp_path / name), picture)
    with pytest.raises(SettingError, match=r"not '\.bmp'"):
        write_linear(tmp_path / "x.bmp", picture)
