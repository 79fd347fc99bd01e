"""Frames of photographs of the retina that move behind a field that stands still, in several colours of light.

The PSF of each colour is a wave propagation through one diffuser at the wavelength of that LED, with the eye's own
chromatic defocus; it is calibrated from sixteen noisy frames of a point in focus. No operator is shared with the
solver: photographs are shifted by their Fourier transform, wider than the field, before the field cuts them.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image as Pictures
from scipy import fft

from device.config.head_file import OpticsSpec
from device.optics.diffuser import EMMETROPIA, Refraction, caustic
from device.optics.illumination import LED
from device.recon.model.grid import disc
from device.values import Calibration, Colour, Counts, Image, Psf, Sensor

SEED = 21  # of the diffuser
BLACK_DN, CALIBRATION_FRAMES, FILL = 64.0, 16, 0.8
MARGIN_PX = 64  # of a photograph beyond the field: the largest shift
COLOURS: tuple[Colour, ...] = ("red", "green", "blue")


@dataclass(frozen=True)
class SensorCase:
    """Sensor of a case: pixels, pitch, full well and read noise in electrons, bits."""

    rows: int
    cols: int
    pitch_um: float
    well_e: float
    read_e: float
    bits: int

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.rows, self.cols

    @property
    def gain_e(self) -> float:
        """Electrons per count."""
        return self.well_e / ((1 << self.bits) - 1 - BLACK_DN)


PAPER = SensorCase(1080, 1920, 5.04, 23000.0, 1.03, 12)
IMX296 = SensorCase(1088, 1456, 3.45, 10700.0, 2.2, 10)
FIELD_DEG = 33.4
OPTICS = OpticsSpec(field_deg=FIELD_DEG, bandwidth_um=0.03)

# Seven photographs; the field is a part of it: centre (x, y) and side as shares of the photograph's shorter side.
FIELDS: dict[str, tuple[str, tuple[float, float, float]]] = {
    "06_dr a": ("hrf/images/06_dr.JPG", (0.42, 0.5, 0.68)),
    "06_dr b": ("hrf/images/06_dr.JPG", (0.62, 0.5, 0.68)),
    "07_h a": ("hrf/images/07_h.jpg", (0.40, 0.5, 0.68)),
    "07_h b": ("hrf/images/07_h.jpg", (0.62, 0.5, 0.68)),
    "09_g a": ("hrf/images/09_g.jpg", (0.40, 0.5, 0.68)),
    "09_g b": ("hrf/images/09_g.jpg", (0.62, 0.5, 0.68)),
    "cc0 a": ("skimage/retina.jpg", (0.42, 0.5, 0.68)),
    "cc0 b": ("skimage/retina.jpg", (0.58, 0.5, 0.68)),
    "01L": ("chase/Image_01L.jpg", (0.5, 0.5, 0.85)),
    "05R": ("chase/Image_05R.jpg", (0.5, 0.5, 0.85)),
    "11L": ("chase/Image_11L.jpg", (0.5, 0.5, 0.85)),
}


def eye_dpt(colour: Colour) -> float:
    """Return the refraction of an eye that is emmetropic in green light: L. Thibos et al., Appl. Opt. 31, 3594, 1992.

    Rx(lambda) = 1.68524 - 633.46 / (lambda - 214.102), nm and dioptres; positive M is myopia, so M = -Rx.
    """
    green, own = (1.68524 - 633.46 / (1e3 * LED[name].wavelength_um - 214.102) for name in ("green", colour))
    return green - own


def field_px(sensor: SensorCase) -> float:
    """Return the diameter of the lit field in pixels."""
    return FIELD_DEG * OPTICS.geometry(sensor.pitch_um).px_per_deg


@cache
def photograph(file: Path, place: tuple[float, float, float], sensor: SensorCase) -> Image:
    """Return a part of a photograph, (side, side, 3) in 0..1, whose middle is as wide as the field.

    `place`: its centre (x, y) from the middle of the picture and side as shares of the shorter side, x from the left of
    the central square. The values of the file are taken as linear.
    """
    inner = int(np.ceil(field_px(sensor))) + 2
    side_px = inner + 2 * MARGIN_PX
    with Pictures.open(file) as picture:
        rgb = picture.convert("RGB")
    short = min(rgb.size)
    x, y = (rgb.width - short) / 2 + place[0] * short, (rgb.height - short) / 2 + place[1] * short
    half = place[2] * short * side_px / inner / 2
    big = Pictures.new("RGB", (rgb.width + 2 * short, rgb.height + 2 * short))
    big.paste(rgb, (short, short))  # a part may reach beyond the photograph
    box = (x - half + short, y - half + short, x + half + short, y + half + short)
    square = big.resize((side_px, side_px), Pictures.Resampling.LANCZOS, box, 3.0)
    return np.asarray(square, np.float32) / np.float32(255)


def retina(pixels: Image, sensor: SensorCase, shift_px: tuple[float, float] = (0.0, 0.0)) -> Image:
    """Return one plane of a photograph in the field on the sensor: what is at (r, c) stands at (r, c) + `shift_px`."""
    size = fft.next_fast_len(pixels.shape[0], real=True)
    rows, cols = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    phase = np.exp(-2j * np.pi * (rows * shift_px[0] + cols * shift_px[1]))
    moved = fft.irfft2(fft.rfft2(pixels, (size, size)) * phase, (size, size))[: pixels.shape[0], : pixels.shape[1]]
    out = np.zeros(sensor.shape, np.float32)
    rows_px, cols_px = (min(pixels.shape[0], n) for n in sensor.shape)
    top, left = (sensor.rows - rows_px) // 2, (sensor.cols - cols_px) // 2
    inside = [slice((pixels.shape[0] - n) // 2, (pixels.shape[0] - n) // 2 + n) for n in (rows_px, cols_px)]
    out[top : top + rows_px, left : left + cols_px] = np.maximum(moved[inside[0], inside[1]], 0)
    return out * disc(sensor.shape, ((sensor.rows - 1) / 2, (sensor.cols - 1) / 2), field_px(sensor) / 2)


@cache
def wave_psf(sensor: SensorCase, colour: Colour, m_dpt: float = 0.0) -> Image:
    """Return the PSF of one colour behind an eye of mean sphere `m_dpt`, (n, n) float32, sum 1."""
    optics = OPTICS.model_copy(update={"wavelength_um": LED[colour].wavelength_um})
    return caustic(optics, sensor.pitch_um, SEED, Refraction(m_dpt) if m_dpt else EMMETROPIA)


def exposed(plane: Image, psf: Image) -> Image:
    """Return the light on the sensor, (rows, cols), of an object of that shape."""
    size = [fft.next_fast_len(n + k, real=True) for n, k in zip(plane.shape, psf.shape, strict=True)]
    light = fft.irfft2(fft.rfft2(plane, size) * fft.rfft2(psf, size), size)
    top, left = (k // 2 for k in psf.shape)
    return np.asarray(np.maximum(light[top : top + plane.shape[0], left : left + plane.shape[1]], 0), np.float32)


def counted(light_e: Image, sensor: SensorCase, seed: int) -> Counts:
    """Return the counts of a frame with `light_e` expected electrons, (rows, cols)."""
    random = np.random.default_rng(seed)
    electrons = random.poisson(light_e) + random.normal(0, sensor.read_e, light_e.shape)
    counts = np.round(np.minimum(electrons, sensor.well_e) / sensor.gain_e + BLACK_DN)
    return np.clip(counts, 0, 2**sensor.bits - 1).astype(np.uint16)


@cache
def calibrated(sensor: SensorCase, colour: Colour) -> Calibration:
    """Return the calibration of one colour: PSF of sixteen noisy frames of a point in focus."""
    point = wave_psf(sensor, colour)
    canvas = np.zeros(sensor.shape, np.float32)
    parts = [min(k, n) for k, n in zip(point.shape, sensor.shape, strict=True)]
    to = [n // 2 - k // 2 for k, n in zip(parts, sensor.shape, strict=True)]
    of = [k // 2 - p // 2 for k, p in zip(point.shape, parts, strict=True)]
    central = point[of[0] : of[0] + parts[0], of[1] : of[1] + parts[1]]
    canvas[to[0] : to[0] + parts[0], to[1] : to[1] + parts[1]] = central
    peak_e = FILL * sensor.well_e
    random = np.random.default_rng(1000 + COLOURS.index(colour))
    clean_e = canvas * np.float32(peak_e / canvas.max())
    sd_e = np.sqrt((clean_e + 2 * sensor.read_e**2 + sensor.gain_e**2 / 6) / CALIBRATION_FRAMES)
    pixels = (clean_e + sd_e * random.standard_normal(clean_e.shape)).astype(np.float32)
    return Calibration(
        (Psf(pixels),),
        Sensor(BLACK_DN, sensor.gain_e, sensor.read_e, float(2**sensor.bits - 1)),
        OPTICS.geometry(sensor.pitch_um),
        FIELD_DEG,
        simulated=True,
    )


CHANNEL_PLANE: dict[Colour, int] = {"red": 0, "green": 1, "blue": 2}
