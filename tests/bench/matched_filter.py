"""Detector of lesions of known size: a matched filter on the relative picture, the same for every head."""

from dataclasses import dataclass
from functools import cached_property
from math import ceil, pi

import numpy as np
from scipy import fft, ndimage

from device.values import Image, Mask
from tests.bench.drawn_lesions import Kind, Lesion, profile

BACKGROUND_WIDTHS = 1.5  # sigma of the background that the filter subtracts, in widths of the lesion
EVEN_UM = 600.0  # sigma of the brightness that a contrast is relative to
TURNS = 12  # directions of a vessel


def relative(picture: Image, field: Mask, um_per_px: float) -> Image:
    """Return a picture (rows, cols) over its own local brightness, less 1; 0 outside of the field."""
    sigma_px = EVEN_UM / um_per_px
    share = ndimage.gaussian_filter(field.astype(np.float32), sigma_px)
    smooth = ndimage.gaussian_filter(np.where(field, picture, 0).astype(np.float32), sigma_px)
    even = smooth / np.maximum(share, 1e-6)
    return np.where(field, picture / np.maximum(even, 1e-12) - 1, 0).astype(np.float32)


@dataclass(frozen=True)
class Candidates:
    """Local maxima of a response: (n, 2) rows and cols in pixels, and (n,) contrasts, all above 0."""

    places: Image
    contrasts: Image

    def best_near(self, lesion: Lesion, um_per_px: float) -> float:
        """Return the highest contrast within the reach of a lesion, 0 if there is none."""
        apart_um = np.hypot(*(self.places - (lesion.row, lesion.col)).T) * um_per_px
        return float(self.contrasts[apart_um <= lesion.kind.reach_um].max(initial=0.0))

    def inside(self, mask: Mask) -> Image:
        """Return the contrasts of the candidates inside a mask (rows, cols), (n,)."""
        rows, cols = self.places.astype(int).T
        return self.contrasts[mask[rows, cols]]


class MatchedFilter:
    """Matched filter of one kind of lesion: its response is the Weber contrast of such a lesion at each pixel.

    The kernel is the lesion's shape less its Gaussian blur, so it has no mean; for white noise it is optimal but for
    the background, which is unknown.
    """

    def __init__(self, kind: Kind, um_per_px: float) -> None:
        self.kind, self.um_per_px = kind, um_per_px

    @cached_property
    def kernels(self) -> list[Image]:
        """Kernels, one for each direction of a vessel, one of a disc."""
        sigma_px = BACKGROUND_WIDTHS * self.kind.width_um / self.um_per_px
        found = []
        for k in range(TURNS if self.kind.length_um else 1):
            shape = np.pad(profile(self.kind, self.um_per_px, turn_rad=pi * k / TURNS), ceil(4 * sigma_px))
            kernel = shape - ndimage.gaussian_filter(shape, sigma_px, mode="constant", truncate=4)
            kernel -= kernel.mean()
            found.append(np.asarray(kernel / np.vdot(kernel, shape), np.float32))
        return found

    def response(self, detail: Image) -> Image:
        """Return the contrast of a lesion at each pixel of `relative` (rows, cols), positive where it has its sign."""
        signed = detail * np.float32(np.sign(self.kind.contrast))
        half, (rows, cols) = self.kernels[0].shape[0] // 2, detail.shape
        shape = tuple(fft.next_fast_len(n + 2 * half, real=True) for n in detail.shape)
        spectrum = fft.rfft2(signed, shape)
        highest = np.full(detail.shape, -np.inf, np.float32)
        for kernel in self.kernels:  # symmetric about its middle: correlation and convolution are the same
            whole = fft.irfft2(spectrum * fft.rfft2(kernel, shape), shape)
            np.maximum(highest, whole[half : half + rows, half : half + cols], out=highest)
        return highest

    def candidates(self, detail: Image) -> Candidates:
        """Return the maxima of the response that are the highest within one width."""
        response = self.response(detail)
        reach_px = max(self.kind.width_um / self.um_per_px, 1.5)
        steps = np.arange(-int(reach_px), int(reach_px) + 1)
        near = np.hypot(steps[:, None], steps[None]) <= reach_px
        highest = ndimage.maximum_filter(response, footprint=near)
        places = np.argwhere((response == highest) & (response > 0))
        return Candidates(places, response[tuple(places.T)])
