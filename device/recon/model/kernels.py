"""Compiled single-pass kernels over pixels and frequencies, each in place of several numpy passes; cached on disk.

At 1080 x 1920 a planned FFT pair takes about 15 ms on one core of a laptop; each numpy pass over the frame costs 1 to 3
ms of memory traffic. Fusing them keeps counts-to-picture below 1.5 FFT pairs (`make bench`).
"""

import numpy as np
from numpy.typing import NDArray

from device.recon.model.compiled import compiled
from device.values import Image, Mask

Single = np.float32
Series = NDArray[np.float64]
Box = tuple[int, int, int, int]
Axes = tuple[Image, Image]
Sums = tuple[float, float, float, float, float]
Spectrum = NDArray[np.complex64]
Pixels = NDArray[np.uint16] | NDArray[np.float32]
Places = NDArray[np.int64]


@compiled
def linearise(
    counts: Pixels,
    dark: Pixels,
    bend_per_dn: float,
    gain: Image,
    white_dn: float,
    first: tuple[int, int],
    n: int,
    out: Image,
    good: Image,
) -> tuple[int, int, float]:
    """Convert counts to linear DN from pixel `first` on, n x n to one: out = mean of s(counts - dark) * gain.

    The mean is over good pixels. s is the inverse of the sensor's nonlinearity b: s (1 + b s) = counts - dark, to the
    third order. `gain` is 1/flat, and 0 for bad pixels; NaN counts and counts at or above `white_dn` are left out too.
    A `dark` or a `gain` of one row holds for all rows. `good` becomes the good share of each block, 0 to 1; `out` of a
    block without a good pixel becomes 0. Return the numbers of saturated and of good pixels, and the sum of the light
    on the good ones in DN.
    """
    rows, cols = out.shape
    wide = cols * n
    total = np.empty(wide, np.float32)
    used = np.empty(wide, np.float32)
    offset = np.empty(wide, np.float32)
    saturated = good_pixels = light = np.float64(0)
    bend = np.float32(bend_per_dn)
    for i in range(rows):
        if n == 1:
            total = out[i]
            used = good[i]
        total[:], used[:] = 0, 0
        for a in range(first[0] + i * n, first[0] + i * n + n):
            begin = first[1]
            end = first[1] + wide
            if len(dark) > 1 or a == first[0]:  # a separate loop: inside the loop below it halves the speed
                _copy(dark[a % len(dark)][begin:end], offset)
            gain_row = gain[a % len(gain)][begin:end]
            saturated += _add_row(counts[a][begin:end], offset, gain_row, bend, np.float32(white_dn), total, used)
        row = _bin_row(total, used, n, out[i], good[i])
        good_pixels += row[0]
        light += row[1]
    return int(saturated), int(good_pixels), float(light)


@compiled
def _copy(source: Pixels, target: Image) -> None:
    """Copy a row; the assignment to a slice would compile the text of its error for seconds."""
    for j in range(target.size):
        target[j] = source[j]


@compiled
def _add_row(
    counts: Pixels, dark: Image, gain: Image, bend: Single, white_dn: Single, total: Image, used: Image
) -> Single:
    zero = np.float32(0)
    one = np.float32(1)
    two = np.float32(2)
    lowest = np.float32(-3e38)
    saturated = zero
    for b in range(total.size):  # selects instead of branches: eight pixels to an instruction
        value = np.float32(counts[b])
        ok = (value < white_dn) & (value > lowest) & (gain[b] > zero)
        saturated += one if value >= white_dn else zero
        light = value - dark[b]
        bent = bend * light
        total[b] += light * (one - bent * (one - two * bent)) * gain[b] if ok else zero
        used[b] += one if ok else zero
    return saturated


@compiled
def _bin_row(total: Image, used: Image, n: int, out: Image, good: Image) -> tuple[Single, Single]:
    zero = np.float32(0)
    one = np.float32(1)
    good_pixels = light = zero
    if n == 1:  # `total` and `used` are `out` and `good` themselves
        for j in range(good.size):
            good_pixels += good[j]
            light += out[j]
        return good_pixels, light
    for j in range(out.size):
        v = u = zero
        for b in range(j * n, j * n + n):
            v += total[b]
            u += used[b]
        out[j] = v / max(u, one)
        good[j] = u / np.float32(n * n)
        good_pixels += u
        light += v
    return good_pixels, light


@compiled
def exclude_pixels(
    counts: Pixels,
    dark: Image,
    bend_per_dn: float,
    gain: Image,
    white_dn: float,
    first: tuple[int, int],
    n: int,
    places: Places,
    out: Image,
    good: Image,
) -> tuple[int, float]:
    """Remove the pixels `places` (flat indices) from the result of `linearise`; return their number and light in DN.

    The other arguments are those of `linearise`; `out` and `good` are updated in place. Pixels that it left out, and
    pixels outside the window, are skipped. `places` must not hold a pixel twice.
    """
    rows, cols = out.shape
    bend = np.float32(bend_per_dn)
    white = np.float32(white_dn)
    lowest = np.float32(-3e38)
    one = np.float32(1)
    two = np.float32(2)
    all_px = np.float32(n * n)
    lost = 0
    light = np.float64(0)
    for place in places:
        a = place // counts.shape[1]
        b = place % counts.shape[1]
        i = (a - first[0]) // n
        j = (b - first[1]) // n
        value = np.float32(counts[a, b])
        weight = gain[a % len(gain), b]
        is_good = (value < white) & (value > lowest) & (weight > 0)
        if a < first[0] or b < first[1] or i >= rows or j >= cols or not is_good:
            continue
        value -= dark[a % len(dark), b]
        bent = bend * value
        value *= (one - bent * (one - two * bent)) * weight
        used = np.round(good[i, j] * all_px)
        out[i, j] = (out[i, j] * used - value) / (used - one) if used > one else np.float32(0)
        good[i, j] = (used - one) / all_px
        lost += 1
        light += value
    return lost, light


@compiled
def flat_fit_sums(y: Image, flat: Image, good: Image) -> Sums:
    """Return the sums for the fit y = a flat + b: <y,f>, <y,1>, <f,f>, <f,1>, <1,1>, each weighted by `good`."""
    yf = y1 = ff = f1 = n = np.float64(0)
    rows, cols = y.shape
    for i in range(rows):
        ryf = ry1 = rff = rf1 = rn = np.float32(0)  # float32 within a row, float64 over the rows
        for j in range(cols):
            w = good[i, j]
            f = flat[i, j] * w
            ryf += y[i, j] * f
            ry1 += y[i, j] * w
            rff += flat[i, j] * f
            rf1 += f
            rn += w
        yf += ryf
        y1 += ry1
        ff += rff
        f1 += rf1
        n += rn
    return yf, y1, ff, f1, n


@compiled
def residual(y: Image, flat: Image, good: Image, a: float, b: float, at: tuple[int, int], out: Image) -> None:
    """Write (y - a flat - b) * good, the residual of the flat model, into `out` from sample `at` on."""
    a32 = np.float32(a)
    b32 = np.float32(b)
    rows, cols = y.shape
    for i in range(rows):
        for j in range(cols):
            out[at[0] + i, at[1] + j] = (y[i, j] - a32 * flat[i, j] - b32) * good[i, j]


MIN_GRADIENT_POWER = 1e-6  # added to |D|^2 as a divisor; smaller than |D|^2 of one cycle across any frame


@compiled
def wiener(
    spectrum: Spectrum, otf: Spectrum, gradient: Axes, slope: float, floor: float, psf_term: float, scale: float
) -> None:
    """Apply a Wiener filter in place: multiply by scale conj(H) / (|H|^2 + slope |D|^2 + floor + psf_term / |D|^2).

    `gradient` holds |D|^2 as a row part and a column part, to which MIN_GRADIENT_POWER is added.
    """
    rows, cols = spectrum.shape
    slope32 = np.float32(slope)
    floor32 = np.float32(floor)
    term32 = np.float32(psf_term)
    scale32 = np.float32(scale)
    for i in range(rows):
        for j in range(cols):
            h = otf[i, j]
            steep = gradient[0][i] + gradient[1][j] + np.float32(MIN_GRADIENT_POWER)
            power = h.real * h.real + h.imag * h.imag
            weight = scale32 * steep / ((power + slope32 * steep + floor32) * steep + term32)  # one division
            s = spectrum[i, j]
            spectrum[i, j] = complex(
                (s.real * h.real + s.imag * h.imag) * weight, (s.imag * h.real - s.real * h.imag) * weight
            )


@compiled
def add_flat(x: Image, mask: Image, a: float, box: Box, out: Image) -> None:
    """Write (x + a) mask into `out` inside `box` (top, bottom, left, right): add the flat model again.

    `out` is not changed outside the box.
    """
    a32 = np.float32(a)
    top, bottom, left, right = box
    for i in range(top, bottom):
        for j in range(left, right):
            out[i, j] = (x[i, j] + a32) * mask[i, j]


@compiled
def cross_validation(
    power: Series, prior: Series, delta: Series, energies: Series, candidates: Series, scores: Series
) -> None:
    """Write the generalised cross-validation score n sum(phi^2 |Y|^2) / (sum phi)^2 of each mu to `scores`.

    phi = reg / (|H|^2 + reg), reg = mu R + delta; `power` is |H|^2, `prior` is R, `energies` |Y|^2, all for n
    frequencies; `candidates` holds the values of mu.
    """
    for k in range(candidates.size):
        misfit = freedom = 0.0
        for i in range(power.size):
            reg = candidates[k] * prior[i] + delta[i]
            phi = reg / (power[i] + reg)
            misfit += phi * phi * energies[i]
            freedom += phi
        scores[k] = power.size * misfit / (freedom * freedom)


@compiled
def interpolate_cubic(
    image: Image, first: NDArray[np.int64], weights: Image, offset: tuple[int, int], box: Box, out: Image
) -> None:
    """Fill `box` (top, bottom, left, right) of `out` by cubic interpolation, from 4 x 4 samples of `image` per pixel.

    `first` and `weights` are those of `cubic_weights`, for n x n pixels per sample. Pixel (i, j) of `out` lies in
    sample ((i + offset[0]) // n, (j + offset[1]) // n) of the image.
    """
    n = first.size
    rows, cols = image.shape
    top, bottom, left, right = box
    begin = left + offset[1]
    end = right + offset[1]
    low = max(begin // n - 2, 0)  # the columns used by the box
    high = min((end - 1) // n + 3, cols)
    row_up = np.zeros(cols + 4, np.float32)  # one interpolated row with two repeated samples at each end
    for i in range(top, bottom):
        p = (i + offset[0]) % n
        k = (i + offset[0]) // n + first[p]
        a = image[min(max(k, 0), rows - 1)]
        b = image[min(max(k + 1, 0), rows - 1)]
        c = image[min(max(k + 2, 0), rows - 1)]
        d = image[min(max(k + 3, 0), rows - 1)]
        wa, wb, wc, wd = weights[p]
        for j in range(low, high):
            row_up[j + 2] = wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]
        row_up[:2], row_up[cols + 2 :] = row_up[2], row_up[cols + 1]
        line = out[i]
        for q in range(n):
            va, vb, vc, vd = weights[q]
            shift = first[q] + 2
            for k in range((begin - q + n - 1) // n, (end - q + n - 1) // n):
                m = min(max(k + shift, 0), cols)
                line[k * n + q - offset[1]] = (
                    va * row_up[m] + vb * row_up[m + 1] + vc * row_up[m + 2] + vd * row_up[min(m + 3, cols + 3)]
                )


@compiled
def subtract_scaled(light: Image, smooth: Image, scale: float, good: Image, out: Image) -> None:
    """Write (light - scale smooth) good into `out`."""
    scale32 = np.float32(scale)
    rows, cols = light.shape
    for i in range(rows):
        for j in range(cols):
            out[i, j] = (light[i, j] - scale32 * smooth[i, j]) * good[i, j]


@compiled
def add_moved(
    image: Image,
    good: Image,
    whole: tuple[int, int],
    taps: Axes,
    weight: float,
    gain: float,
    total: Image,
    weights: Image,
) -> None:
    """Add weight gain image(r + shift) to `total`, and `weight` to `weights`, where the pixels under all taps are good.

    The shift is `whole` pixels, and the part of a pixel that `taps` interpolate: an odd number of weights per axis,
    rows and columns. `image` and `good`, 0 or 1, are 0 beyond the shifted image; under the taps they repeat the edge.
    """
    rows, cols = image.shape
    down, across = taps
    reach_down = down.size // 2
    reach_across = across.size // 2
    weight32 = np.float32(weight)
    gain32 = np.float32(gain)
    line = np.empty(cols + 2 * reach_across, np.float32)
    kept = np.empty(cols + 2 * reach_across, np.float32)
    value = np.empty(cols, np.float32)
    share = np.empty(cols, np.float32)
    low = max(0, -whole[1])
    high = min(cols, cols - whole[1])
    for i in range(max(0, -whole[0]), min(rows, rows - whole[0])):
        line[:], kept[:] = 0, 1
        for t in range(down.size):
            a = min(max(i + whole[0] + t - reach_down, 0), rows - 1)
            _add_line(image[a], good[a], down[t], line[reach_across : reach_across + cols], kept[reach_across:])
        line[:reach_across], line[reach_across + cols :] = line[reach_across], line[reach_across + cols - 1]
        kept[:reach_across], kept[reach_across + cols :] = kept[reach_across], kept[reach_across + cols - 1]
        size = high - low
        value[:size], share[:size] = 0, 1
        for t in range(across.size):
            first = low + whole[1] + t
            _add_line(line[first : first + size], kept[first : first + size], across[t], value[:size], share[:size])
        for j in range(size):
            total[i, low + j] += weight32 * gain32 * value[j] * share[j]
            weights[i, low + j] += weight32 * share[j]


@compiled
def _add_line(source: Image, good: Image, weight: Single, total: Image, kept: Image) -> None:
    for j in range(total.size):
        total[j] += weight * source[j]
        kept[j] = min(kept[j], good[j])


@compiled
def finish_mean(total: Image, weights: Image, least: float, base: Image, scale: float) -> None:
    """Replace `total` by total / weights + scale base, and by NaN where `weights` is less than `least`."""
    scale32 = np.float32(scale)
    least32 = np.float32(least)
    missing = np.float32(np.nan)
    rows, cols = total.shape
    for i in range(rows):
        for j in range(cols):
            weight = weights[i, j]
            mean = total[i, j] / max(weight, least32) + scale32 * base[i, j]
            total[i, j] = mean if weight >= least32 else missing


@compiled
def neighbours(counts: Pixels, dark: Image, places: Places, mean: Image, off: Image) -> None:
    """Write the mean light of the four neighbours of each pixel to `mean`, and its own light minus that mean to `off`.

    `places` are flat indices into the image without its one-pixel border. Light is counts - dark in DN.
    """
    inner = counts.shape[1] - 2
    light = np.empty(5, np.float32)
    for k in range(places.size):
        i = 1 + places[k] // inner
        j = 1 + places[k] % inner
        for m in range(5):
            a = i + (m == 1) - (m == 2)
            b = j + (m == 3) - (m == 4)
            light[m] = np.float32(counts[a, b]) - dark[a % len(dark), b]
        mean[k] = np.float32(0.25) * (light[1] + light[2] + light[3] + light[4])
        off[k] = light[0] - mean[k]


@compiled
def line_sums(counts: Pixels, width: int, bands: Image, bins: Image, texture: Image, unknown: Image) -> None:
    """Add up the rows and columns of a frame; all outputs are 0 before.

    `bands` (bands, cols): sums over equal numbers of rows. `bins` (rows, bins): sums of `width` pixels of a row.
    `texture` (rows, segments, 2): sums over a segment of a row of the squares of its fourth differences, and of their
    products with those of the row before. `unknown` (rows,): number of its values that are not numbers, in whose place
    those of the row before are taken.
    """
    rows, cols = counts.shape
    zero = np.float32(0)
    one = np.float32(1)
    highest = np.float32(3e38)
    segments = texture.shape[1]
    inner = max(cols - 4, 0)
    row = np.zeros(cols, np.float32)
    fine = np.zeros(inner, np.float32)
    before = np.zeros(inner, np.float32)
    for i in range(rows):
        band = bands[i * len(bands) // rows]
        lost = zero
        for j in range(cols):
            value = np.float32(counts[i, j])
            known = (value > -highest) & (value < highest)
            lost += zero if known else one
            row[j] = value if known else row[j]
            band[j] += row[j]
        for k in range(bins.shape[1]):
            part = row[k * width : (k + 1) * width]
            total = zero
            for j in range(width):
                total += part[j]
            bins[i, k] = total
        _fourth_differences(row, fine)
        for k in range(segments):
            begin = k * inner // segments
            end = (k + 1) * inner // segments
            texture[i, k, 0] = _product(fine[begin:end], fine[begin:end])
            texture[i, k, 1] = _product(fine[begin:end], before[begin:end])
        fine, before = before, fine
        unknown[i] = lost


@compiled
def _fourth_differences(row: Image, out: Image) -> None:
    """Write the fourth differences of `row` (cols,) to `out` (cols - 4,): a loop of its own is vectorised."""
    four = np.float32(4)
    six = np.float32(6)
    for j in range(out.size):
        out[j] = row[j] - four * row[j + 1] + six * row[j + 2] - four * row[j + 3] + row[j + 4]


@compiled
def _product(a: Image, b: Image) -> np.float32:
    """Return the sum of the products of two rows of the same length."""
    total = np.float32(0)
    for j in range(a.size):
        total += a[j] * b[j]
    return total


@compiled
def mark_suspects(
    counts: Pixels, dark: Image, slope_dn: float, floor_dn2: float, white_dn: float, least_dn: float, out: Mask
) -> int:
    """Mark in `out` (rows, cols) the pixels that reach `white_dn`, or have less than `least_dn` above dark, or differ
    from the mean m of their four neighbours by more than sqrt(slope_dn m + floor_dn2).

    Return their number. A dark of one row holds for all rows. NaN is not marked: `linearise` leaves it out. In the
    first and last row the pixel itself replaces the missing neighbour; in the first and last column only `white_dn` and
    `least_dn` apply.
    """
    rows, cols = counts.shape
    slope = np.float32(slope_dn)
    floor = np.float32(floor_dn2)
    white = np.float32(white_dn)
    least = np.float32(least_dn)
    above = np.zeros(cols, np.float32)
    here = np.zeros(cols, np.float32)
    below = np.zeros(cols, np.float32)
    _light(counts[0], dark[0], here)
    _copy(here, above)
    total = 0
    for i in range(rows):
        if i + 1 < rows:
            _light(counts[i + 1], dark[(i + 1) % len(dark)], below)
        else:
            _copy(here, below)
        _mark_row(counts[i], above, here, below, slope, floor, white, least, out[i])
        found = 0
        for j in range(cols):
            found += out[i, j]
        total += found
        above, here, below = here, below, above
    return total


@compiled
def _light(counts: Pixels, dark: Image, out: Image) -> None:
    for j in range(out.size):
        out[j] = np.float32(counts[j]) - dark[j]


@compiled
def _mark_row(
    counts: Pixels,
    above: Image,
    here: Image,
    below: Image,
    slope: Single,
    floor: Single,
    white: Single,
    least: Single,
    out: Mask,
) -> None:
    quarter = np.float32(0.25)
    zero = np.float32(0)
    last = out.size - 1
    for j in range(1, last):  # selects instead of branches, as in `_add_row`
        mean = quarter * (here[j - 1] + here[j + 1] + above[j] + below[j])
        off = here[j] - mean
        is_outlier = off * off > slope * max(mean, zero) + floor
        out[j] = is_outlier | (np.float32(counts[j]) >= white) | (here[j] < least)
    for j in (0, last):
        out[j] = (np.float32(counts[j]) >= white) | (here[j] < least)


@compiled
def _ring(counts: Pixels, dark: Image, bad: Mask, i: int, j: int, reach: int, out: Image) -> int:
    """Copy the light of the good pixels at Chebyshev distance `reach` from (i, j) to `out`; return their number."""
    rows, cols = counts.shape
    n = 0
    for a in range(max(i - reach, 0), min(i + reach, rows - 1) + 1):
        for b in range(max(j - reach, 0), min(j + reach, cols - 1) + 1):
            if max(abs(a - i), abs(b - j)) == reach and not bad[a, b]:
                out[n] = np.float32(counts[a, b]) - dark[a % len(dark), b]
                n += 1
    return n


@compiled
def _sort(values: Image, n: int) -> None:
    """Sort the first `n` values in place, by insertion: np.sort takes a second to compile, and n is at most 16."""
    for m in range(1, n):
        value = values[m]
        k = m
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value


@compiled
def outliers(
    counts: Pixels,
    dark: Image,
    known: Mask,
    places: Places,
    slope_dn: float,
    floor_dn2: float,
    ranges: tuple[float, float],
    is_outlier: Mask,
) -> int:
    """Mark in `is_outlier` which pixels `places` (flat indices) differ from a ring around them; return their number.

    Marks are only set, never cleared; pixels in `known` are skipped and not counted. A ring is the 8 pixels at distance
    1 (k = 0) or the 16 at distance 2 (k = 1), without `known` defects. A pixel differs when it is off the median of one
    of the rings by more than the noise, sqrt(slope_dn median + floor_dn2), plus `ranges[k]` times the range of the ring
    without its 1 + k highest and 1 + k lowest values. Rings of at most 2 k + 4 values are skipped.
    """
    ring = np.empty(16, np.float32)
    found = 0
    for m in range(places.size):
        i = places[m] // counts.shape[1]
        j = places[m] % counts.shape[1]
        if known[i, j]:
            continue
        light = np.float32(counts[i, j]) - dark[i % len(dark), j]
        for k in range(2):
            n = _ring(counts, dark, known, i, j, k + 1, ring)
            if n > 2 * k + 4:
                _sort(ring, n)
                middle = 0.5 * (ring[(n - 1) // 2] + ring[n // 2])
                spread = ring[n - 2 - k] - ring[1 + k]
                noise = np.sqrt(slope_dn * max(middle, np.float32(0)) + floor_dn2)
                is_outlier[m] |= abs(light - middle) > noise + ranges[k] * spread
        found += is_outlier[m]
    return found


@compiled
def ring_excess(
    image: Image, zero_row: Image, no_mask: Mask, least: float, slope_dn: float, floor_dn2: float, out: Series
) -> None:
    """Write for each pixel of at least `least` the smallest pair `ranges` with which `outliers` does not mark it.

    `out` is (pixels, 2), of zeros. The two outermost rows and columns are left out. `zero_row` is a row of zeros,
    `no_mask` a mask (rows, cols) of False.
    """
    rows, cols = image.shape
    ring = np.empty(16, np.float32)
    at = 0
    for i in range(2, rows - 2):
        for j in range(2, cols - 2):
            if image[i, j] < least:
                continue
            for k in range(2):
                n = _ring(image, zero_row, no_mask, i, j, k + 1, ring)
                _sort(ring, n)
                middle = 0.5 * (ring[(n - 1) // 2] + ring[n // 2])
                spread = ring[n - 2 - k] - ring[1 + k]
                excess = abs(image[i, j] - middle) - np.sqrt(slope_dn * max(middle, np.float32(0)) + floor_dn2)
                if excess > 0:
                    out[at, k] = excess / max(spread, np.float32(1e-30))
            at += 1
