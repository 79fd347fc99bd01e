"""Image files: all types of counts and files are converted to one type, or refused with a reason."""

import struct
import zlib
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
from PIL import Image, ImageOps

from device.config.dng_levels import Levels
from device.config.image_files import (
    as_psf,
    as_raw,
    read_counts,
    read_image,
    read_image_file,
    read_psf,
    require_same_shape,
    with_levels,
)
from device.config.marked_files import is_marked_simulated, write_linear
from device.errors import FrameError, PsfError, SettingError
from device.values import Psf
from services.imaging.picture_files import raw_tiff, to_png
from services.imaging.raw_metadata import RawMetadata

SHAPE = (200, 300)


def twelve_bit(seed: int = 0, shape: tuple[int, ...] = SHAPE) -> Any:
    return np.random.default_rng(seed).integers(0, 4096, shape).astype(np.uint16)


# Counts


def test_left_justified_counts_come_back_and_two_stray_pixels_are_bad() -> None:
    counts = twelve_bit()
    words = counts << np.uint16(4)
    words[0, :2] = 0x1239, 0x0007  # the first pixels of the DiffuserCam tutorial's files
    raw = as_raw(words)
    assert raw.shift == 4
    assert raw.white_dn == 4095
    assert raw.pixels.dtype == np.uint16
    assert np.array_equal(raw.pixels[1:], counts[1:])
    assert raw.bad.sum() == 2
    assert raw.bad[0, :2].all()


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_left_justified_counts_are_shifted_back(bits: int) -> None:
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
def test_right_justified_counts_are_unchanged(counts: Any) -> None:
    counts[0, 0] |= 1  # an odd count among at most 1600: impossible in a left-justified file
    raw = as_raw(counts)
    assert raw.shift == 0
    assert not raw.bad.any()
    assert np.array_equal(raw.pixels, counts)
    assert raw.pixels.max() <= raw.white_dn


@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
def test_sparse_bright_pixels_are_not_taken_for_left_justified(seed: int, stars: int) -> None:
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


def test_negative_and_too_large_counts_are_refused() -> None:
    with pytest.raises(FrameError, match="negative"):
        as_raw(np.array([[1, -1]], np.int16))
    with pytest.raises(FrameError, match="70000"):
        as_raw(np.array([[1, 70000]], np.int32))


@given(hnp.arrays(np.float64, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.floats(width=32)))
def test_float_pixels_are_kept_and_non_finite_ones_are_bad(array: Any) -> None:
    raw = as_raw(array)
    assert raw.pixels.dtype == np.float32
    assert np.array_equal(raw.bad, ~np.isfinite(array))
    assert np.array_equal(raw.pixels[~raw.bad], array[~raw.bad].astype(np.float32))
    assert (raw.pixels[raw.bad] == 0).all()


def test_float_pixels_that_are_not_clipped_have_no_saturation_level() -> None:
    assert as_raw(np.random.default_rng(5).random(SHAPE)).white_dn == float("inf")


# Point spread functions


def spot() -> Any:
    rows, cols = np.ogrid[:60, :80]
    return np.exp(-((rows - 30) ** 2 + (cols - 40) ** 2) / 40.0).astype(np.float32)


@given(st.floats(0, 1000))
def test_psf_pedestal_is_subtracted(pedestal: float) -> None:
    with_pedestal = as_psf(spot() * 1000 + np.float32(pedestal), "p")
    assert np.allclose(with_pedestal.pixels, as_psf(spot(), "q").pixels, atol=2e-6)
    assert abs(float(with_pedestal.pixels[0].mean())) < 1e-6


def test_negative_noise_of_a_psf_is_not_clipped() -> None:
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
def test_invalid_psf_is_refused_with_its_file_name(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "measured.npy"
    np.save(path, NO_PSF[kind]())
    with pytest.raises(PsfError) as refused:
        read_psf(path)
    assert refused.value.remedy
    assert "measured.npy" in refused.value.message


def test_psfs_of_another_camera_mode_are_refused() -> None:
    psf = Psf(np.ones((4, 6), np.float32), "half.tiff")
    require_same_shape((psf,), (4, 6))
    with pytest.raises(PsfError, match=r"half\.tiff has 4 x 6 pixels, the raw 8 x 12"):
        require_same_shape((psf,), (8, 12))


# Layouts


@pytest.mark.parametrize(
    ("shape", "frames", "each"),
    [
        ((6, 8), 1, (6, 8)),
        ((6, 8, 1), 1, (6, 8)),
        ((1, 6, 8), 1, (6, 8)),
        ((1, 6, 8, 1), 1, (6, 8)),
        ((1, 6, 8, 3), 1, (6, 8, 3)),
        ((6, 8, 3), 1, (6, 8, 3)),
        ((3, 6, 8), 3, (6, 8)),
        ((5, 6, 8, 3), 5, (6, 8, 3)),
    ],
)
@pytest.mark.parametrize("suffix", ["npy", "tiff", "npz"])
def test_layouts_of_frames_and_stacks_are_read(
    tmp_path: Path, shape: tuple[int, ...], frames: int, each: tuple[int, ...], suffix: str
) -> None:
    array, path = np.arange(np.prod(shape), dtype=np.uint16).reshape(shape), tmp_path / f"a.{suffix}"
    if suffix == "npz":
        np.savez_compressed(path, picture=array)
    elif suffix == "npy":
        np.save(path, array)
    else:
        tifffile.imwrite(path, array, photometric="rgb" if shape[-1] == 3 else "minisblack")
    read = read_image_file(path).frames
    assert len(read) == frames
    assert read[0].shape == each
    assert np.array_equal(np.stack(read).ravel(), array.ravel())
    if frames > 1:
        with pytest.raises(FrameError, match=f"holds {frames} frames"):
            read_image(path)


def test_tiff_with_channels_as_planes_is_a_colour_frame(tmp_path: Path) -> None:
    colour = np.arange(72, dtype=np.uint16).reshape(3, 4, 6)
    tifffile.imwrite(tmp_path / "planes.tiff", colour, photometric="rgb", planarconfig="separate")
    assert np.array_equal(read_image(tmp_path / "planes.tiff"), np.moveaxis(colour, 0, -1))


def test_array_of_an_npz_is_selected_by_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "two.npz", raw=np.ones((4, 6), np.uint8), psf=np.zeros((4, 6), np.uint8))
    assert read_image(tmp_path / "two.npz:raw").all()
    refused_file(tmp_path / "two.npz", "holds raw, psf")
    with pytest.raises(FrameError, match="holds raw, psf") as refused:
        read_image(tmp_path / "two.npz:dark")
    assert "two.npz:raw" in refused.value.remedy


@pytest.mark.parametrize("pixels", [(6, 8, 4), (1, 6, 8, 4)])
def test_fourth_channel_is_refused(tmp_path: Path, pixels: tuple[int, ...]) -> None:
    np.save(tmp_path / "a.npy", np.ones(pixels, np.uint16))
    refused_file(tmp_path / "a.npy", "fourth channel")


def test_transparent_png_is_refused(tmp_path: Path) -> None:
    Image.fromarray(np.full((4, 6, 4), 9, np.uint8)).save(tmp_path / "clear.png")
    refused_file(tmp_path / "clear.png", "transparent")


DNG_TAGS = [
    (33421, "H", 2, (2, 2), True),
    (33422, "B", 4, b"\1\0\2\1", True),
    (50714, "2I", 1, (640, 10), True),
]


def test_plain_dng_is_read_with_pattern_and_black_level(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "a.dng") as file:  # as cameras write it: a thumbnail first, the mosaic below it
        file.write(np.zeros((3, 4, 3), np.uint8), photometric="rgb", subifds=1)
        file.write(GOOD["grey.tiff"], photometric="cfa", extratags=DNG_TAGS)
    read = read_image_file(tmp_path / "a.dng")
    assert np.array_equal(read.frames[0], GOOD["grey.tiff"])
    assert read.levels == Levels("grbg", 64, None)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("size", [(6, 8), (7, 9), (6, 9)])
def test_pattern_of_a_dng_follows_its_areas_and_its_orientation(
    tmp_path: Path, orientation: int, size: tuple[int, int]
) -> None:
    """The counts of a mosaic are the places of its filters in rgb, so that the pixels read tell their own pattern."""
    filters = np.tile(np.array([[1, 2], [0, 1]], np.uint16), (9, 9))
    for top, left, row, col in ((0, 0, 0, 0), (1, 2, 0, 1), (3, 0, 1, 1), (2, 1, 3, 2)):
        pattern = bytes(filters[top : top + 2, left : left + 2].ravel().astype(np.uint8))
        tags = [
            (33421, "H", 2, (2, 2), True),
            (33422, "B", 4, pattern, True),
            (274, "H", 1, orientation, True),
            (50829, "I", 4, (top, left, 18, 18), True),
            (50719, "I", 2, (col, row), True),
            (50720, "I", 2, size[::-1], True),
        ]
        tifffile.imwrite(tmp_path / "a.dng", filters, photometric="cfa", extratags=tags)
        read = read_image_file(tmp_path / "a.dng")
        (pixels,) = read.frames
        assert pixels.shape == (size if orientation < 5 else size[::-1])
        assert read.levels.bayer == "".join("rgb"[int(colour)] for colour in pixels[:2, :2].ravel())


def test_levels_of_a_dng_are_those_of_the_counts_after_their_shift(tmp_path: Path) -> None:
    """A Raspberry Pi 5 stores the counts of any sensor left-justified in 16 bits, and the levels with them."""
    counts = twelve_bit()
    tags = [(50714, "I", 1, 256 * 16, True), (50717, "I", 1, 3900 * 16 + 15, True)]
    tifffile.imwrite(tmp_path / "a.dng", counts << np.uint16(4), photometric="cfa", extratags=tags)
    file = read_image_file(tmp_path / "a.dng")
    raw, black_dn = with_levels(as_raw(file.frames[0]), file.levels)
    assert np.array_equal(raw.pixels, counts)
    assert (raw.shift, black_dn, raw.white_dn) == (4, 256, 3900)


def test_dng_that_needs_another_decoder_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.dng", GOOD["grey.tiff"], photometric="cfa", compression="zlib", extratags=DNG_TAGS)
    assert np.array_equal(read_image(tmp_path / "a.dng"), GOOD["grey.tiff"])
    with tifffile.TiffFile(tmp_path / "a.dng", mode="r+b") as file:
        file.pages.first.tags["Compression"].overwrite(7)
    refused_file(tmp_path / "a.dng", "compressed by JPEG")
    tifffile.imwrite(tmp_path / "b.dng", GOOD["grey.tiff"])
    refused_file(tmp_path / "b.dng", "no raw image")
    (tmp_path / "c.dng").write_bytes((tmp_path / "b.dng").read_bytes()[:90])
    refused_file(tmp_path / "c.dng", "is not a whole dng")


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
def test_images_round_trip(tmp_path: Path, name: str) -> None:
    write(tmp_path / name, GOOD[name])
    back = read_image(tmp_path / name)
    assert back.dtype == GOOD[name].dtype
    assert np.array_equal(back, GOOD[name])


def test_an_alpha_channel_is_dropped_and_a_palette_resolved(tmp_path: Path) -> None:
    alpha = np.dstack([GOOD["colour.png"], np.full((4, 6), 255, np.uint8)])
    write(tmp_path / "a.png", alpha)
    assert np.array_equal(read_image(tmp_path / "a.png"), GOOD["colour.png"])
    indices = Image.fromarray(GOOD["grey.png"], "P")
    indices.putpalette(np.roll(np.arange(768, dtype=np.uint8), 1).tobytes())
    for name in ("p.png", "p.tiff"):
        indices.save(tmp_path / name)
        assert np.array_equal(read_image(tmp_path / name), np.asarray(indices.convert("RGB")))


def test_picture_with_an_srgb_chunk_is_no_raw_frame(tmp_path: Path) -> None:
    path = tmp_path / "picture.png"
    path.write_bytes(to_png(spot(), simulated=False))
    assert read_image(path).shape == (60, 80)
    with pytest.raises(FrameError, match=r"picture\.png states that its values are not linear in the light \(sRGB\)"):
        read_counts(path)
    with pytest.raises(PsfError, match="sRGB"):
        read_psf(path)


def profile(curve: bytes) -> bytes:
    """Return an ICC profile of grey with a tone curve."""
    return bytes(128) + struct.pack(">I4sII", 1, b"kTRC", 144, len(curve)) + curve


CURVES: dict[bytes, str | None] = {
    b"curv" + bytes(8): None,
    struct.pack(">4sIIH", b"curv", 0, 1, 256): None,
    struct.pack(">4sII3H", b"curv", 0, 3, 0, 32768, 65535): None,
    struct.pack(">4sIHHi", b"para", 0, 0, 0, 65536): None,
    struct.pack(">4sIIH", b"curv", 0, 1, 563): "gamma 2.2",
    struct.pack(">4sII3H", b"curv", 0, 3, 0, 14000, 65535): "bent",
    struct.pack(">4sIHHi", b"para", 0, 0, 0, 144180): "power 2.2",
    b"curv": "cut short",
}


@pytest.mark.parametrize("curve", CURVES)
def test_profile_decides_whether_values_are_linear_in_the_light(tmp_path: Path, curve: bytes) -> None:
    for name in ("a.png", "a.tiff"):
        Image.fromarray(GOOD["grey.png"]).save(tmp_path / name, icc_profile=profile(curve))
        assert np.array_equal(read_image(tmp_path / name), GOOD["grey.png"])
        if CURVES[curve] is None:
            assert np.array_equal(read_counts(tmp_path / name), GOOD["grey.png"])
        else:
            with pytest.raises(FrameError, match=r"not linear in the light \((iCCP|ICC profile)\)"):
                read_counts(tmp_path / name)


@pytest.mark.parametrize("compression", ["tiff_lzw", "packbits", "tiff_adobe_deflate", "zstd", "lzma"])
def test_tiff_that_pillow_compressed_is_read(tmp_path: Path, compression: str) -> None:
    for name, pixels in (("a.tiff", twelve_bit(3)), ("b.tiff", np.stack([GOOD["grey.png"]] * 3, axis=2))):
        Image.fromarray(pixels).save(tmp_path / name, compression=compression)
        assert np.array_equal(read_image(tmp_path / name), pixels)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_file_is_as_upright_as_pillow_turns_it(tmp_path: Path, orientation: int) -> None:
    tags, pixels = Image.Exif(), GOOD["grey.png"]
    tags[274] = orientation
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=tags)
    tifffile.imwrite(tmp_path / "a.tiff", pixels, extratags=[(274, "H", 1, orientation, True)])
    with Image.open(tmp_path / "a.png") as shown:
        upright = np.asarray(ImageOps.exif_transpose(shown))
    assert np.array_equal(read_image(tmp_path / "a.png"), upright)
    assert np.array_equal(read_image(tmp_path / "a.tiff"), upright)


def test_frames_that_only_their_program_knows_are_refused(tmp_path: Path) -> None:
    stack = np.zeros((3, 40, 60), np.uint16)
    tifffile.imwrite(tmp_path / "a.tiff", stack, truncate=True, photometric="minisblack")
    refused_file(tmp_path / "a.tiff", "several frames in one page")


@pytest.mark.parametrize("line_filter", [0, 2])
def test_png_of_16_bit_colour_is_read_whole(tmp_path: Path, line_filter: int) -> None:
    """LenslessPiCam's raw frames and PSFs; line filter 2 stores the difference from the line above."""
    pixels = np.random.default_rng(0).integers(0, 65536, (5, 7, 3)).astype(">u2")
    lines = pixels.view(np.uint8).reshape(5, -1)
    if line_filter:
        lines = np.diff(lines, axis=0, prepend=np.zeros((1, lines.shape[1]), np.uint8))
    packed = zlib.compress(b"".join(bytes([line_filter]) + line.tobytes() for line in lines))
    header = struct.pack(">IIBBBBB", 7, 5, 16, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", packed), (b"IEND", b""))
    parts = [
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    ]
    (tmp_path / "deep.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    read = read_image(tmp_path / "deep.png")
    assert read.dtype == np.uint16
    assert np.array_equal(read, pixels)
    (tmp_path / "cut.png").write_bytes((tmp_path / "deep.png").read_bytes()[:90])
    with pytest.raises(FrameError, match="not a whole png"):
        read_image(tmp_path / "cut.png")


def test_png_of_16_bit_colour_with_alpha_is_refused(tmp_path: Path) -> None:
    file = bytearray(b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + b"\0\0\0\x01\0\0\0\x01" + b"\x10\x06\0\0\0")
    (tmp_path / "deep.png").write_bytes(file)
    with pytest.raises(FrameError, match="16 bits with an alpha channel") as refused:
        read_image(tmp_path / "deep.png")
    assert "tiff" in refused.value.remedy


def refused_file(path: Path, words: str) -> None:
    with pytest.raises(FrameError, match=words) as refused:
        read_image(path)
    assert str(path) in refused.value.message
    assert refused.value.remedy


def test_invalid_image_file_is_refused_with_its_path(tmp_path: Path) -> None:
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
        "line": np.zeros(5),
        "two": np.zeros((4, 4, 2)),
        "none": np.zeros((0, 4)),
        "complex": np.zeros((4, 4), complex),
        "bool": np.zeros((4, 4), bool),
        "text": np.array([["a", "b"]]),
        "stack": np.zeros((2, 4, 4, 3)),
    }.items():
        np.save(tmp_path / f"{name}.npy", array)
        refused_file(tmp_path / f"{name}.npy", "shape|type")
    np.save(tmp_path / "object.npy", np.array([[{}]]), allow_pickle=True)
    refused_file(tmp_path / "object.npy", "Python objects")


def test_header_that_claims_too_much_memory_is_refused(tmp_path: Path) -> None:
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
def test_truncated_file_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "packed.tiff":
        path.write_bytes(raw_tiff(twelve_bit(0, (20, 30)), RawMetadata(eye="OD")))
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
        else:  # the missing bytes were not part of the picture
            assert np.array_equal(back, image)
    assert refused > 20


@given(st.integers(0, 2**32 - 1), st.sampled_from([".tiff", ".png", ".npy"]))
@settings(max_examples=150, deadline=None, derandomize=True)
def test_damaged_files_are_read_or_refused(seed: int, suffix: str) -> None:
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


def test_raw_tiff_is_marked_as_simulated(tmp_path: Path) -> None:
    counts = twelve_bit()
    for name, marked in (("a.tiff", True), ("b.tiff", False)):
        (tmp_path / name).write_bytes(raw_tiff(counts, RawMetadata(simulated=marked)))
        assert is_marked_simulated(tmp_path / name) is marked
    tifffile.imwrite(tmp_path / "c.tiff", counts)
    tifffile.imwrite(tmp_path / "d.tiff", counts, description="simulated: true", metadata=None)
    np.save(tmp_path / "e.npy", counts)
    assert not any(is_marked_simulated(tmp_path / name) for name in ("c.tiff", "d.tiff", "e.npy", "none.tiff"))


@pytest.mark.parametrize("name", ["x.npy", "x.tiff", "x.tif"])
def test_linear_pictures_round_trip(tmp_path: Path, name: str) -> None:
    picture = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    write_linear(tmp_path / name, picture, False)
    assert np.array_equal(read_image(tmp_path / name), picture)
    with pytest.raises(SettingError, match=r"not '\.bmp'"):
        write_linear(tmp_path / "x.bmp", picture, False)
