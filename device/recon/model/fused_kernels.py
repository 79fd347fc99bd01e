"""Compiled kernels of the iterative solvers and the likelihood fits, each in place of several numpy passes."""

import numpy as np
from numpy.typing import NDArray

from device.recon.model.compiled import compiled
from device.recon.model.kernels import Series, Spectrum
from device.values import Image


@compiled
def shrink(
    x: Image, ux: Image, uy: Image, uw: Image, mask: Image, threshold: float, px: Image, py: Image, out: Image
) -> None:
    """Evaluate ADMM's proximal steps: z = shrink(D x + (ux, uy), threshold) (isotropic TV), w = max(x + uw, 0) mask.

    ux, uy, uw are the scaled multipliers, updated in place; px, py are work arrays. out = D^T(z - u) + (w - uw), with
    the updated multipliers, is the image part of the next x step. D is the periodic forward difference.
    """
    rows, cols = x.shape
    t = np.float32(threshold)
    zero = np.float32(0)
    one = np.float32(1)
    tiny = np.float32(1e-30)
    for i in range(rows):
        here = x[i]
        below = x[i + 1 if i + 1 < rows else 0]
        for j in range(cols):
            gx = (here[j + 1] if j + 1 < cols else here[0]) - here[j] + ux[i, j]
            gy = below[j] - here[j] + uy[i, j]
            keep = max(zero, one - t / np.sqrt(gx * gx + gy * gy + tiny))
            ux[i, j] = gx - gx * keep
            uy[i, j] = gy - gy * keep
            px[i, j] = (keep + keep - one) * gx
            py[i, j] = (keep + keep - one) * gy
            v = here[j] + uw[i, j]
            w = max(v, zero) * mask[i, j]
            uw[i, j] = v - w
            out[i, j] = w + w - v
        above = py[i - 1 if i > 0 else rows - 1]
        row_x = px[i]
        row_y = py[i]
        row = out[i]
        row[0] += row_x[cols - 1] - row_x[0]
        for j in range(1, cols):
            row[j] += row_x[j - 1] - row_x[j]
        if i > 0:
            for j in range(cols):
                row[j] += above[j] - row_y[j]
        else:
            for j in range(cols):
                row[j] -= row_y[j]
    for j in range(cols):
        out[0, j] += py[rows - 1, j]


@compiled
def solve_data_step(blurred: Image, a: Image, weighted: Image, inverse: Image, stiffness: float, out: Image) -> None:
    """Evaluate ADMM's data step: v = (W y + r (Hx + a)) / (W + r); update the multiplier a in place; out = v - a.
    `blurred` is Hx, `weighted` is W y, `inverse` is 1/(W + r), `stiffness` is r.
    """
    r = np.float32(stiffness)
    rows, cols = blurred.shape
    for i in range(rows):
        for j in range(cols):
            q = blurred[i, j] + a[i, j]
            v = (weighted[i, j] + r * q) * inverse[i, j]
            a[i, j] = q - v
            out[i, j] = v + v - q


@compiled
def data_weights(
    blurred: Image,
    y: Image,
    good: Image,
    per_dn: float,
    floor: float,
    stiffness: float,
    at: tuple[int, int],
    weighted: Image,
    inverse: Image,
) -> None:
    """Write W y to `weighted` and 1/(W + r) to `inverse`, on the grid; `blurred` is Hx, `stiffness` is r.
    W = good / (per_dn max(Hx, 0) + floor), the share of good pixels over the noise variance, in the window; else 0.
    """
    p = np.float32(per_dn)
    f = np.float32(floor)
    r = np.float32(stiffness)
    zero = np.float32(0)
    weighted[:], inverse[:] = zero, np.float32(1) / r
    rows, cols = y.shape
    for i in range(rows):
        for j in range(cols):
            w = good[i, j] / (p * max(blurred[at[0] + i, at[1] + j], zero) + f)
            weighted[at[0] + i, at[1] + j] = w * y[i, j]
            inverse[at[0] + i, at[1] + j] = np.float32(1) / (w + r)


@compiled
def solve_x_step(
    data: Spectrum,
    image: Spectrum,
    otf: Spectrum,
    row_g: Image,
    col_g: Image,
    stiffness: float,
    rho: float,
    scale: float,
    x: Spectrum,
    blurred: Spectrum,
) -> None:
    """Solve ADMM's x step in Fourier space: x = scale (r conj(H) data + rho image) / (r |H|^2 + rho |D|^2 + rho).

    The spectra of x and of H x are written to `x` and `blurred`. `row_g` and `col_g` are the parts of |D|^2, see
    `gradient_symbol`; r is `stiffness`.
    """
    rows, cols = data.shape
    r = np.float32(stiffness)
    q = np.float32(rho)
    s = np.float32(scale)
    one = np.float32(1)
    for i in range(rows):
        for j in range(cols):
            h = otf[i, j]
            d = data[i, j]
            m = image[i, j]
            power = h.real * h.real + h.imag * h.imag
            weight = s / (r * power + q * (row_g[i] + col_g[j] + one))
            real = (r * (h.real * d.real + h.imag * d.imag) + q * m.real) * weight
            imag = (r * (h.real * d.imag - h.imag * d.real) + q * m.imag) * weight
            x[i, j] = complex(real, imag)
            blurred[i, j] = complex(real * h.real - imag * h.imag, real * h.imag + imag * h.real)


@compiled
def wiener_with(spectrum: Spectrum, otf: Spectrum, reg: Image, scale: float) -> None:
    """Apply a Wiener filter in place: multiply a spectrum by scale conj(H) / (|H|^2 + reg)."""
    rows, cols = spectrum.shape
    s = np.float32(scale)
    for i in range(rows):
        for j in range(cols):
            h = otf[i, j]
            y = spectrum[i, j]
            weight = s / (h.real * h.real + h.imag * h.imag + reg[i, j])
            spectrum[i, j] = complex(
                (y.real * h.real + y.imag * h.imag) * weight, (y.imag * h.real - y.real * h.imag) * weight
            )


@compiled
def ring_levels(
    seen: Series, power: Series, ring: NDArray[np.int64], noise_dn2: float, repetitions: int, levels: Series
) -> None:
    """Write the estimated g of each ring in seen = power g + noise_dn2 to `levels`; at least 1e-6 noise_dn2.
    Least squares, then `repetitions` reweighted ones. `seen` is |Y|^2, `power` |H|^2, `ring` the index of the ring.
    """
    above = np.zeros(levels.size)
    below = np.zeros(levels.size)
    for repetition in range(repetitions + 1):
        above[:], below[:] = 0, 0
        for k in range(seen.size):
            w = 1.0 if repetition == 0 else 1 / (power[k] * levels[ring[k]] + noise_dn2) ** 2
            above[ring[k]] += (seen[k] - noise_dn2) * power[k] * w
            below[ring[k]] += power[k] * power[k] * w
        for b in range(levels.size):
            levels[b] = max(above[b] / max(below[b], 1e-300), 1e-6 * noise_dn2)


@compiled
def most_likely_power_law(
    seen: Series, power: Series, logs: Series, noise_dn2: float, a: float, k: float, steps: int
) -> tuple[float, float]:
    """Return (a, k) of S = power exp(a - k log f) + noise_dn2 after `steps` of Fisher scoring of sum(log S + seen / S).
    `a` and `k` are the start values, `logs` holds log f, `seen` |Y|^2 and `power` |H|^2; k is limited to 0.5 to 4.
    """
    for _ in range(steps):
        ga = gk = hak = 0.0
        haa = hkk = 1e-9
        for n in range(seen.size):
            m = power[n] * np.exp(a - k * logs[n])
            s = m + noise_dn2
            t = m / s
            e = t * (seen[n] / s - 1)
            ga += e
            gk -= e * logs[n]
            haa += t * t
            hak -= t * t * logs[n]
            hkk += t * t * logs[n] * logs[n]
        det = max(haa * hkk - hak * hak, 1e-30)
        a += min(max((hkk * ga - hak * gk) / det, -1.5), 1.5)
        k += min(max((haa * gk - hak * ga) / det, -0.7), 0.7)
        k = min(max(k, 0.5), 4.0)  # pictures have 1.5 to 3
    return a, k


@compiled
def rms_residual(blurred: Image, y: Image, good: Image, per_dn: float, floor: float, at: tuple[int, int]) -> float:
    """Return the rms of y - Hx in units of its noise, weighted by `good`: 1 for noise alone, 0 if all are missing.
    `blurred` is Hx on the grid, whose window begins at `at`; the noise variance is per_dn max(Hx, 0) + floor.
    """
    p = np.float32(per_dn)
    f = np.float32(floor)
    zero = np.float32(0)
    total = weight = np.float64(0)
    rows, cols = y.shape
    for i in range(rows):
        row_total = row_weight = zero
        for j in range(cols):
            b = blurred[at[0] + i, at[1] + j]
            e = y[i, j] - b
            row_total += good[i, j] * e * e / (p * max(b, zero) + f)
            row_weight += good[i, j]
        total += row_total
        weight += row_weight
    return np.sqrt(total / weight) if weight > 0 else np.float64(0)


@compiled
def _read(table: Spectrum, row: float, col: float) -> complex:
    """Return the value of a table at (row, col) by bilinear interpolation; rows are -last to last, columns 0 to last.

    For col < 0 it is the conjugate of the value at (-row, -col); outside the table it is 0.
    """
    last = table.shape[1] - 1
    left = col < 0
    if left:
        row = -row
        col = -col
    row += last
    if not (0 <= row < 2 * last and col < last):
        return complex(np.float32(0), np.float32(0))
    k = int(row)
    m = int(col)
    t = np.float32(row - k)
    u = np.float32(col - m)
    one = np.float32(1)
    value = (one - t) * ((one - u) * table[k, m] + u * table[k, m + 1]) + t * (
        (one - u) * table[k + 1, m] + u * table[k + 1, m + 1]
    )
    return complex(value.real, -value.imag) if left else value


@compiled
def stretch(
    table: Spectrum, matrix: Series, rows: Series, cols: Series, row_share: Image, col_share: Image, out: Spectrum
) -> None:
    """Write the table's values at matrix (col, row), for all pairs of the frequencies `rows` and `cols`, to `out`, each
    multiplied by row_share col_share, the transfer of a sample along the two axes.
    """
    for i in range(rows.size):
        across = matrix[0, 1] * rows[i]
        down = matrix[1, 1] * rows[i]
        share = row_share[i]
        for j in range(cols.size):
            value = _read(table, matrix[1, 0] * cols[j] + down, matrix[0, 0] * cols[j] + across)
            out[i, j] = value * (share * col_share[j])


@compiled
def stretch_at(table: Spectrum, matrix: Series, rows: Series, cols: Series, share: Image, out: Spectrum) -> None:
    """Write the table's values at matrix (col, row), for single frequencies `rows`, `cols`, to `out`, times `share`."""
    for i in range(rows.size):
        down = matrix[1, 0] * cols[i] + matrix[1, 1] * rows[i]
        out[i] = _read(table, down, matrix[0, 0] * cols[i] + matrix[0, 1] * rows[i]) * share[i]


@compiled
def negative_log_likelihood(
    seen: Spectrum,
    otf: Spectrum,
    ring: NDArray[np.int64],
    s2: float,
    smear: float,
    repetitions: int,
    levels: Series,
    energy: Image,
    power: Image,
) -> float:
    """Return the negative log likelihood of a spectrum under S = q g + s2, with the best level g of each ring.

    The result is sum(log S + |seen|^2 / S) in nats, NUMERICS.md 7.1. `seen`, `otf` (H) and `ring` are (K,), s2 is the
    noise. q = |H|^2 + smear (its mean over the ring), since a tapered window mixes frequencies.
    |seen|^2 is written to `energy`, q to `power`, g to `levels`; `repetitions` is the number of reweighted fits of g.
    """
    above = np.zeros(levels.size)
    below = np.zeros(levels.size)
    for m in range(seen.size):
        f = seen[m]
        h = otf[m]
        b = ring[m]
        energy[m] = f.real * f.real + f.imag * f.imag
        power[m] = h.real * h.real + h.imag * h.imag
        above[b] += power[m]
        below[b] += 1
    for m in range(seen.size):
        power[m] += np.float32(smear * above[ring[m]] / below[ring[m]])
    for repetition in range(repetitions + 1):
        above[:], below[:] = 0, 0
        for m in range(seen.size):
            b = ring[m]
            w = 1.0 if repetition == 0 else 1 / (power[m] * levels[b] + s2)
            above[b] += (energy[m] - s2) * power[m] * w * w
            below[b] += power[m] * power[m] * w * w
        for b in range(levels.size):
            levels[b] = max(above[b] / max(below[b], 1e-300), 1e-6 * s2)
    total = 0.0
    for m in range(seen.size):
        s = power[m] * levels[ring[m]] + s2
        total += np.log(s) + energy[m] / s
    return total


@compiled
def filter_spectrum(spectrum: Spectrum, weight: Image, out: Spectrum) -> None:
    """Evaluate out = weight * spectrum, for real weights of the frequencies."""
    rows, cols = spectrum.shape
    for i in range(rows):
        for j in range(cols):
            out[i, j] = weight[i, j] * spectrum[i, j]


@compiled
def multiply_conjugate(spectrum: Spectrum, otf: Spectrum) -> None:
    """Multiply a spectrum by the conjugate of an OTF, in place."""
    rows, cols = spectrum.shape
    for i in range(rows):
        for j in range(cols):
            a = spectrum[i, j]
            h = otf[i, j]
            spectrum[i, j] = complex(a.real * h.real + a.imag * h.imag, a.imag * h.real - a.real * h.imag)


@compiled
def squared_length(spectrum: Spectrum, weight: Image, twice: Series) -> float:
    """Return the sum of weight * |spectrum|^2 over all frequencies; `twice` counts those that an rfft leaves out."""
    rows, cols = spectrum.shape
    total = 0.0
    for i in range(rows):
        for j in range(cols):
            a = spectrum[i, j]
            total += twice[j] * weight[i, j] * (a.real * a.real + a.imag * a.imag)
    return total


@compiled
def add_normal_part(spectrum: Spectrum, root: Image, direction: Spectrum, twice: Series, moved: Spectrum) -> float:
    """Evaluate moved = root * spectrum + direction, the normal operator of conjugate gradients on their direction.

    Return the inner product of direction and moved.
    """
    rows, cols = spectrum.shape
    total = 0.0
    for i in range(rows):
        for j in range(cols):
            d = direction[i, j]
            m = root[i, j] * spectrum[i, j] + d
            moved[i, j] = m
            total += twice[j] * (d.real * m.real + d.imag * m.imag)
    return total


@compiled
def step_along(
    factor: float, direction: Spectrum, moved: Spectrum, weight: Image, twice: Series, x: Spectrum, rest: Spectrum
) -> float:
    """Take a step of conjugate gradients: x += factor * direction, rest -= factor * moved.

    Return the sum of weight * |rest|^2, as `squared_length` does.
    """
    rows, cols = x.shape
    total = 0.0
    along = np.float32(factor)
    for i in range(rows):
        for j in range(cols):
            x[i, j] += along * direction[i, j]
            r = rest[i, j] - along * moved[i, j]
            rest[i, j] = r
            total += twice[j] * weight[i, j] * (r.real * r.real + r.imag * r.imag)
    return total


@compiled
def next_direction(ratio: float, rest: Spectrum, weight: Image, direction: Spectrum) -> None:
    """Evaluate direction = weight * rest + ratio * direction, in place."""
    rows, cols = rest.shape
    b = np.float32(ratio)
    for i in range(rows):
        for j in range(cols):
            direction[i, j] = weight[i, j] * rest[i, j] + b * direction[i, j]
