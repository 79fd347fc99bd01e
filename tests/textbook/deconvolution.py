"""The formulas as a textbook writes them: float64, whole arrays, no plans; slow, plain, the judge of the fast ones."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def otf(psf: Array, shape: tuple[int, int]) -> NDArray[np.complex128]:
    """Spectrum of a PSF whose centre (rows//2, cols//2) is moved to the origin of a torus of `shape`."""
    torus = np.zeros(shape)
    for i in range(psf.shape[0]):
        for j in range(psf.shape[1]):
            di, dj = i - psf.shape[0] // 2, j - psf.shape[1] // 2
            if -(shape[0] // 2) <= di < shape[0] - shape[0] // 2 and -(shape[1] // 2) <= dj < shape[1] - shape[1] // 2:
                torus[di % shape[0], dj % shape[1]] = psf[i, j]
    return np.fft.fft2(torus / torus.sum())


def gradient_power(shape: tuple[int, int]) -> Array:
    """|D|^2 of first differences on the torus, by transforming the differences themselves."""
    rows, cols = np.zeros(shape), np.zeros(shape)
    rows[0, 0], cols[0, 0] = -1, -1
    rows[-1, 0] += 1
    cols[0, -1] += 1
    return np.abs(np.fft.fft2(rows)) ** 2 + np.abs(np.fft.fft2(cols)) ** 2


def blur(x: Array, H: NDArray[np.complex128]) -> Array:
    """h * x on the torus."""
    return np.real(np.fft.ifft2(np.fft.fft2(x) * H))


def tikhonov(y: Array, H: NDArray[np.complex128], reg: Array | float) -> Array:
    """argmin |y - h * x|^2 + <x, reg x>: paper, section "Algorithm"."""
    return np.real(np.fft.ifft2(np.conj(H) * np.fft.fft2(y) / (np.abs(H) ** 2 + reg)))


def flat_subtracted(y: Array, H: NDArray[np.complex128], mask: Array, reg: Array, fit_background: bool = True) -> Array:
    """The same of what a flat field leaves, the flat field added back, dark outside the mask."""
    flat = blur(mask, H)
    basis = np.stack([flat.ravel(), np.ones(flat.size)], axis=1) if fit_background else flat.reshape(-1, 1)
    fit, *_ = np.linalg.lstsq(basis, y.ravel(), rcond=None)
    residual = y - (basis @ fit).reshape(y.shape)
    return (tikhonov(residual, H, reg) + fit[0]) * mask
