"""Textbook versions of the deconvolution: float64, whole arrays, no plans; the reference for the fast solvers."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def otf(psf: Array, shape: tuple[int, int]) -> NDArray[np.complex128]:
    """Return the spectrum of a PSF whose centre (rows//2, cols//2) is moved to the origin of a torus of `shape`."""
    torus = np.zeros(shape)
    for i in range(psf.shape[0]):
        for j in range(psf.shape[1]):
            di, dj = i - psf.shape[0] // 2, j - psf.shape[1] // 2
            if -(shape[0] // 2) <= di < shape[0] - shape[0] // 2 and -(shape[1] // 2) <= dj < shape[1] - shape[1] // 2:
                torus[di % shape[0], dj % shape[1]] = psf[i, j]
    return np.fft.fft2(torus / torus.sum())


def gradient_power(shape: tuple[int, int]) -> Array:
    """Return |D|^2 of first differences on the torus, by transforming the differences themselves."""
    rows, cols = np.zeros(shape), np.zeros(shape)
    rows[0, 0], cols[0, 0] = -1, -1
    rows[-1, 0] += 1
    cols[0, -1] += 1
    return np.abs(np.fft.fft2(rows)) ** 2 + np.abs(np.fft.fft2(cols)) ** 2


def blur(x: Array, H: NDArray[np.complex128]) -> Array:
    """Return h * x on the torus."""
    return np.real(np.fft.ifft2(np.fft.fft2(x) * H))


def tikhonov(y: Array, H: NDArray[np.complex128], reg: Array | float) -> Array:
    """Return argmin |y - h * x|^2 + <x, reg x>: paper, section "Algorithm"."""
    return np.real(np.fft.ifft2(np.conj(H) * np.fft.fft2(y) / (np.abs(H) ** 2 + reg)))


def flat_subtracted(y: Array, H: NDArray[np.complex128], mask: Array, reg: Array, fit_background: bool = True) -> Array:
    """Return the Tikhonov solution of y minus its flat-field fit, plus the flat field, zero outside the mask."""
    flat = blur(mask, H)
    basis = np.stack([flat.ravel(), np.ones(flat.size)], axis=1) if fit_background else flat.reshape(-1, 1)
    fit, *_ = np.linalg.lstsq(basis, y.ravel(), rcond=None)
    residual = y - (basis @ fit).reshape(y.shape)
    return (tikhonov(residual, H, reg) + fit[0]) * mask


def differences(x: Array) -> tuple[Array, Array]:
    """Return the periodic first differences of x along rows and columns."""
    return np.roll(x, -1, axis=1) - x, np.roll(x, -1, axis=0) - x


def total_variation(
    x: Array, y: Array, W: Array, H: NDArray[np.complex128], mask: Array, tau: float, rho: float, r: float, rounds: int
) -> Array:
    """Return x after `rounds` of ADMM for 1/2 sum W (y - h * x)^2 + tau sum |D x|: NUMERICS.md 4.2.

    All arrays have the shape of the torus; W is 0 outside the sensor. `rho` is the penalty of z and w, `r` that of v.
    """
    ux, uy, uw, uv = (np.zeros_like(x) for _ in range(4))
    for _ in range(rounds):
        gx, gy = (d + u for d, u in zip(differences(x), (ux, uy), strict=True))
        keep = np.maximum(0, 1 - tau / rho / np.maximum(np.hypot(gx, gy), 1e-300))
        zx, zy = gx * keep, gy * keep
        ux, uy = gx - zx, gy - zy
        w = mask * np.maximum(x + uw, 0)
        uw = x + uw - w
        v = (W * y + r * (blur(x, H) + uv)) / (W + r)
        uv = blur(x, H) + uv - v
        px, py = zx - ux, zy - uy
        back = np.roll(px, 1, axis=1) - px + np.roll(py, 1, axis=0) - py
        image = rho * np.fft.fft2(back + w - uw)
        data = r * np.conj(H) * np.fft.fft2(v - uv)
        x = np.real(np.fft.ifft2((data + image) / (r * np.abs(H) ** 2 + rho * (gradient_power(x.shape) + 1))))
    return x
