"""Bayer mosaics: planes, their convolution, the picture at full size, and the test for a mosaic."""

from typing import Any

import numpy as np
import pytest
from scipy import ndimage, signal

from device.config.bayer import PATTERNS, any_site, looks_like_mosaic, mosaic_of, split, whole_size
from device.errors import FrameError


@pytest.mark.parametrize("pattern", PATTERNS)
def test_planes_of_a_mosaic_are_its_colours(pattern: Any) -> None:
    colour = np.zeros((6, 9, 3), np.uint16) + np.array([10, 20, 30], np.uint16)
    planes = split(mosaic_of(colour, pattern), pattern)
    assert planes.shape == (3, 4, 3)
    assert np.array_equal(planes, np.broadcast_to([10, 20, 30], planes.shape))


def test_saturated_green_saturates_the_mean() -> None:
    planes = split(np.array([[1, 255], [7, 3]], np.uint16), "rggb", white_dn=255)
    assert planes.ravel().tolist() == [1, 255, 3]


def test_bad_pixels_of_a_block_are_joined() -> None:
    bad = np.zeros((4, 5), np.bool_)
    bad[3, 1] = True
    assert any_site(bad).tolist() == [[False, False], [True, False]]


def test_plane_of_a_frame_is_the_convolution_with_the_plane_of_the_psf() -> None:
    """An object on every other pixel, from the PSF's centre on, is seen by each plane without a displacement."""
    rng = np.random.default_rng(0)
    rows, cols = 22, 30  # the centre (11, 15) is odd along both axes
    psf, seen = rng.random((rows, cols)), np.zeros((rows, cols))
    points = np.zeros((rows // 2, cols // 2))
    points[3:7, 4:9] = rng.random((4, 5))
    seen[1::2, 1::2] = points
    full = signal.convolve(seen, psf)[rows // 2 : rows // 2 + rows, cols // 2 : cols // 2 + cols]
    planes, blurs = split(full, "grbg"), split(psf, "grbg")
    for c in range(3):
        expected = signal.convolve(points, blurs[..., c])[rows // 4 : rows // 4 + rows // 2, cols // 4 :][
            :, : cols // 2
        ]
        assert np.allclose(planes[..., c], expected, atol=1e-4)
    assert np.allclose(whole_size(points, (rows, cols))[1::2, 1::2], points, atol=1e-6)


def test_picture_of_planes_gets_the_size_of_the_mosaic() -> None:
    picture = np.dstack([np.linspace(0, 9, 12).reshape(3, 4)] * 3).astype(np.float32)
    whole = whole_size(picture, (7, 9))
    assert whole.shape == (7, 9, 3)
    assert whole.min() >= 0
    assert whole.max() <= 9


@pytest.mark.parametrize("gains", [(0.5, 1, 1, 0.3), (1, 0.6, 0.8, 1)])
def test_mosaic_is_recognised(gains: tuple[float, ...]) -> None:
    rng = np.random.default_rng(3)
    frame = 900 + 300 * ndimage.gaussian_filter(rng.normal(size=(96, 128)), 4)
    grey = rng.poisson(frame)
    tinted = grey * np.tile(np.reshape(gains, (2, 2)), (48, 64))
    assert looks_like_mosaic(tinted)
    assert not looks_like_mosaic(grey)
    assert not looks_like_mosaic(np.zeros((96, 128)))
    assert not looks_like_mosaic(tinted[:20, :20])


def test_frame_with_channels_is_no_mosaic() -> None:
    with pytest.raises(FrameError, match="without channels"):
        split(np.zeros((4, 4, 3)), "rggb")
