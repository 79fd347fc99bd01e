"""Tests of the conversion of raw bytes to counts: every justification, any stride, undefined padding."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.drivers.raw_counts import black_dn, pi_layout, v4l2_layout
from device.errors import CameraMismatch, CameraPacked


def padded(words, stride, seed=0):
    """Return rows of `stride` bytes with random bytes after the pixels, as a camera delivers them."""
    raw = np.random.default_rng(seed).integers(0, 256, (words.shape[0], stride)).astype(np.uint8)
    raw[:, : words.shape[1] * words.itemsize] = words.view(np.uint8).reshape(words.shape[0], -1)
    return raw


@given(
    st.sampled_from(
        [("R8", 8, 8), ("R10", 10, 10), ("R12", 12, 12), ("R16", 10, 16), ("R16", 12, 16), ("R16", 16, 16)]
    ),
    st.integers(2, 9),
    st.integers(1, 40),
    st.integers(0, 5),
    st.integers(0, 2**32 - 1),
)
def test_counts_are_exact_for_every_justification_and_stride(kind, rows, cols, extra, seed):
    name, depth, container = kind
    truth = np.random.default_rng(seed).integers(0, 1 << depth, (rows, cols)).astype(np.uint16)
    truth[0, 0] = (1 << depth) - 1
    shift = container - depth if container == 16 else 0
    words = (truth << shift).astype(np.uint8 if container == 8 else np.uint16)
    raw = padded(words, words.itemsize * (cols + extra), seed)
    layout = pi_layout(name, rows, cols, depth)
    layout.check(raw)
    out = np.full((rows, cols), 7, np.uint16)
    assert layout.counts(raw, out) is out
    assert np.array_equal(out, truth)


@pytest.mark.parametrize(
    ("name", "depth", "word", "says"),
    [
        ("R16", 10, 0b1111, "lowest 6 bits"),  # a 16-bit format that is right-justified
        ("R10", 10, 1 << 12, "beyond 10 bits"),  # a left-justified 10-bit format
        ("R10", 10, 0, "every count"),
    ],
)
def test_wrong_justification_is_detected_in_the_first_frame(name, depth, word, says):
    raw = padded(np.full((4, 6), word, np.uint16), 16)
    with pytest.raises(CameraMismatch, match=says):
        pi_layout(name, 4, 6, depth).check(raw)


@pytest.mark.parametrize("name", ["R10_CSI2P", "SRGGB12_CSI2P", "MONO_PISP_COMP1", "BGGR_PISP_COMP2", "YUV420"])
def test_packed_and_compressed_formats_are_refused_with_their_name(name):
    with pytest.raises(CameraPacked, match=name) as refused:
        pi_layout(name, 4, 6, 10)
    assert "operating system" in refused.value.remedy


def test_a_mode_of_another_depth_is_refused():
    with pytest.raises(CameraMismatch, match="12 bits"):
        pi_layout("R10", 4, 6, 12)


def test_a_buffer_that_is_too_short_is_refused():
    with pytest.raises(CameraMismatch, match="cannot hold"):
        pi_layout("R10", 4, 6, 10).words(np.zeros((4, 11), np.uint8))


def test_bayer_formats_are_accepted_like_mono_ones():
    assert pi_layout("SBGGR16", 4, 6, 12).shift == 4
    assert pi_layout("SRGGB10", 4, 6, 10).shift == 0


def test_v4l2_formats_are_identified_by_their_fourcc():
    assert [v4l2_layout(f, 4, 6, d).row_bytes for f, d in (("GREY", 8), ("Y10 ", 10), ("Y16 ", 12))] == [6, 12, 12]
    with pytest.raises(CameraPacked, match="MJPG"):
        v4l2_layout("MJPG", 4, 6, 8)


def test_libcameras_black_levels_are_those_of_the_data_sheets():
    """3840 and 4096 in the tuning files of IMX296 and OV9281: 60 and 64 DN at 10 bits."""
    assert black_dn(3840, 10) == 60
    assert black_dn(4096, 10) == 64
    assert black_dn(4096, 12) == 256
