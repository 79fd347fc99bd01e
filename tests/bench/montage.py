"""`make bench-montage`: acceptance figures of the montage on photographs behind wave optics of its own.

Each photograph is seen in pairs of gaze directions: moved, turned, convolved with a PSF that is propagated here
(angular spectrum behind a random phase surface), exposed with photon and read noise, and reconstructed by the default
method. No operator is shared with the solver. Overlaps are those of the lit discs.

With `--field-deg` the photograph is a map of the directions of an eye that turns, linear in the angle from its centre,
and the field has that diameter: the same frames are joined on the plane and on the sphere. Without it the photograph is
a plane that is shifted, and the montage has no scale. The error of a pair is that of its shift at the centre; "common"
is the rms distance between found and true places over the common part of both fields.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from math import acos, pi, sqrt
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from scipy import fft, ndimage, optimize
from scipy.spatial.transform import Rotation

from device.clock import SystemClock
from device.recon.model.fft_plans import Planner
from device.recon.montage import Montage, make_montage
from device.recon.reconstructor import Reconstructor
from device.values import Calibration, Geometry, Image, Psf, Sensor
from tests.moving_retina import directions, eye_turn, places

SIZE, FIELD_PX, IRIS_PX = 760, 520, 220  # sensor rows and columns, diameters of field and iris image
PITCH_UM, WAVELENGTH_UM, DISTANCE_UM = 5.04, 0.53, 8000.0
SURFACE_CELL_UM, SURFACE_SLOPE = 35.0, 0.009  # correlation length, rms slope of the wavefront: 0.5 degrees
PEAK_E, READ_E, GAIN_E, BLACK_DN, WHITE_DN = 15000.0, 2.5, 4.0, 64.0, 4095.0
OVERLAPS = (0.84, 0.64, 0.54, 0.48, 0.44, 0.36, 0.31, 0.27, 0.15, 0.12, 0.08)
TORSIONS_DEG = (0.0, 3.0)
SPAN = 1.9  # part of a photograph that is used, in fields
PHOTOGRAPHS = {
    "06_dr": ("hrf/images/06_dr.JPG", 1),
    "07_h": ("hrf/images/07_h.jpg", 2),
    "09_g": ("hrf/images/09_g.jpg", 3),
    "01L": ("chase/Image_01L.jpg", 4),
    "05R": ("chase/Image_05R.jpg", 5),
    "11L": ("chase/Image_11L.jpg", 6),
    "cc0": ("skimage/retina.jpg", 7),
}
LIT_DIAMETER = {"hrf": 3260, "chase": 900, "skimage": 1300}  # of the photographs, pixels
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """Two gaze directions of one photograph: true shift of the second in pixels, its torsion, and the overlap."""

    photograph: str
    overlap: float
    torsion_deg: float
    shift_px: tuple[float, float]


def pairs() -> Iterator[Pair]:
    """Yield each photograph at each overlap and torsion, in directions of a fixed random sequence."""
    random = np.random.default_rng(21)
    for name, (path, _) in PHOTOGRAPHS.items():
        steep = 0.25 if path.startswith("hrf") else pi  # HRF's discs are cut above and below
        for overlap in OVERLAPS:
            for torsion_deg in TORSIONS_DEG:
                angle = random.uniform(-steep, steep) + pi * random.integers(2)
                length = FIELD_PX * distance_of(overlap) * random.uniform(0.999, 1.001)
                sign = random.choice((-1, 1))
                yield Pair(name, overlap, sign * torsion_deg, (length * np.sin(angle), length * np.cos(angle)))


def distance_of(overlap: float) -> float:
    """Return the distance of two discs of diameter 1 whose common part is this share of one."""
    return float(optimize.brentq(lambda d: 2 / pi * (acos(d) - d * sqrt(1 - d * d)) - overlap, 0, 1))


@cache
def psf() -> Image:
    """Return the intensity behind a random phase surface with a round iris, on the sensor's pixels, sum 1."""
    fine, n = PITCH_UM / 2, 1024
    random = np.random.default_rng(3)
    surface = ndimage.gaussian_filter(random.normal(size=(n, n)), SURFACE_CELL_UM / fine, mode="wrap")
    surface *= SURFACE_SLOPE * fine / np.sqrt(np.mean(np.gradient(surface, axis=0) ** 2))  # wavefront, um
    at = (np.arange(n) - n / 2) * fine
    iris = np.hypot(at[:, None], at) < IRIS_PX * PITCH_UM / 2
    wave = iris * np.exp(2j * pi / WAVELENGTH_UM * surface)
    f = fft.fftfreq(n, fine)
    along = np.sqrt(np.maximum(1 / WAVELENGTH_UM**2 - f[:, None] ** 2 - f**2, 0))
    light = np.abs(fft.ifft2(fft.fft2(wave) * np.exp(2j * pi * DISTANCE_UM * along))) ** 2
    pixels = light.reshape(n // 2, 2, n // 2, 2).sum(axis=(1, 3))
    cut = slice(n // 4 - 190, n // 4 + 190)
    return np.asarray(pixels[cut, cut] / pixels[cut, cut].sum(), np.float32)


def disc() -> Image:
    """Return the lit field on the sensor, with an edge of one pixel."""
    at = np.arange(SIZE) - (SIZE - 1) / 2
    return np.asarray(np.clip(FIELD_PX / 2 + 0.5 - np.hypot(at[:, None], at), 0, 1), np.float32)


def seen(photograph: Floats, scale: float, moved_px: Floats, turn_deg: float) -> Image:
    """Return the photograph on the sensor: what is at p stands at R(p + moved), both from the centre."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    back = np.array([[c, s], [-s, c]])  # p = R^-1 q - moved
    middle, source = np.full(2, (SIZE - 1) / 2), (np.array(photograph.shape) - 1) / 2
    offset = source - scale * (moved_px + back @ middle)
    return np.asarray(ndimage.affine_transform(photograph, scale * back, offset, (SIZE, SIZE), order=3) * disc())


def seen_turned(photograph: Floats, scale: float, eye: Rotation, px_per_deg: float) -> Image:
    """Return the photograph of a turned eye on the sensor."""
    rows, cols = np.indices((SIZE, SIZE)).reshape(2, -1) - (SIZE - 1) / 2
    there = places(eye.inv().apply(directions(np.stack([rows, cols], axis=1), px_per_deg)), px_per_deg)
    at = scale * there + (np.array(photograph.shape) - 1) / 2
    return np.asarray(ndimage.map_coordinates(photograph, at.T, order=3).reshape(SIZE, SIZE) * disc())


def exposed(image: Image, seed: int) -> NDArray[np.uint16]:
    """Return the counts of a frame whose brightest pixel holds PEAK_E electrons."""
    rows = fft.next_fast_len(SIZE + psf().shape[0], real=True)
    blurred = fft.irfft2(fft.rfft2(image, (rows, rows)) * fft.rfft2(psf(), (rows, rows)), (rows, rows))
    start = psf().shape[0] // 2
    light = np.maximum(blurred[start : start + SIZE, start : start + SIZE], 0)
    random = np.random.default_rng(seed)
    electrons = random.poisson(light * PEAK_E / light.max()) + random.normal(0, READ_E, light.shape)
    return np.clip(np.rint(electrons / GAIN_E + BLACK_DN), 0, WHITE_DN).astype(np.uint16)


@cache
def reconstructor() -> Reconstructor:
    """Return the default reconstructor with a PSF that was measured in 16 noisy frames."""
    clean = psf() / psf().max() * 16 * PEAK_E
    measured = np.maximum(np.random.default_rng(4).poisson(clean) / clean.max(), 0).astype(np.float32)
    geometry = Geometry(PITCH_UM, DISTANCE_UM, 1.0)
    sensor = Sensor(BLACK_DN, GAIN_E, READ_E, WHITE_DN)
    calibration = Calibration((Psf(measured),), sensor, geometry, FIELD_PX / geometry.px_per_deg)
    return Reconstructor(calibration, (SIZE, SIZE), Planner(Path.home() / ".cache" / "diffuscope"), SystemClock())


@cache
def photograph(folder: Path, name: str) -> tuple[Floats, float]:
    """Return the green channel, smoothed for the sensor's pixels, and the photograph's pixels per pixel of it."""
    path = PHOTOGRAPHS[name][0]
    green = np.asarray(Pillow.open(folder / path))[..., 1] / 255
    scale = LIT_DIAMETER[path.split("/")[0]] / (SPAN * FIELD_PX)
    return np.asarray(ndimage.gaussian_filter(green, 0.5 * max(scale, 0.5))), scale


def picture(
    folder: Path, name: str, moved_px: Floats, turn_deg: float, seed: int, px_per_deg: float | None = None
) -> Image:
    """Return the reconstruction of one gaze direction, of an eye with a scale or of a plane."""
    if px_per_deg is None:
        scene = seen(*photograph(folder, name), moved_px, turn_deg)
    else:
        scene = seen_turned(*photograph(folder, name), eye_turn(moved_px, turn_deg, px_per_deg), px_per_deg)
    return reconstructor()(exposed(scene, seed)).picture


def joined(folder: Path, pair: Pair, seed: int, px_per_deg: float | None) -> dict[str, Montage]:
    """Return the montages of a pair by their projection; on the sphere only with a scale."""
    half = np.array(pair.shift_px) / 2
    # The second stands at R(p + half), so at R(q + shift) of the first one's q = p - half. Both turns have one axis, so
    # that this holds for an eye too.
    both = [
        picture(folder, pair.photograph, -half, 0.0, seed, px_per_deg),
        picture(folder, pair.photograph, half, pair.torsion_deg, seed + 1, px_per_deg),
    ]
    plane = {"plane": make_montage(both)}
    return plane if px_per_deg is None else plane | {"sphere": make_montage(both, px_per_deg=px_per_deg)}


def common_error_px(found: Montage, pair: Pair, px_per_deg: float | None) -> float:
    """Return the rms distance of found and true places in the second picture, over the common part of both fields."""
    place = found.placed[1]
    if place.shift_px is None or place.rotation_deg is None:
        return float("nan")
    here = (np.indices((53, 53)).reshape(2, -1).T - 26.0) * FIELD_PX / 52
    true = place_in_second(here, np.array(pair.shift_px), pair.torsion_deg, px_per_deg)
    product = place_in_second(here, np.array(place.shift_px), place.rotation_deg, found.px_per_deg)
    common = (np.linalg.norm(here, axis=1) < FIELD_PX / 2) & (np.linalg.norm(true, axis=1) < FIELD_PX / 2)
    return float(np.sqrt(np.mean(np.sum((product - true)[common] ** 2, axis=1))))


def place_in_second(here: Floats, shift_px: Floats, turn_deg: float, px_per_deg: float | None) -> Floats:
    """Return where places of the first picture stand in the second, on the sphere or on the plane."""
    if px_per_deg is not None:
        return places(eye_turn(shift_px, turn_deg, px_per_deg).apply(directions(here, px_per_deg)), px_per_deg)
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return np.asarray((here + shift_px) @ np.array([[c, -s], [s, c]]).T)


Line = tuple[str, float, float]  # projection, overlap, size of the torsion


def same_eye(folder: Path, px_per_deg: float | None, stride: int) -> dict[Line, list[tuple[float, float, bool]]]:
    """Measure every `stride`-th pair of one eye; return errors in pixels (centre, common part) and acceptance."""
    found: dict[Line, list[tuple[float, float, bool]]] = {}
    for seed, pair in enumerate(pairs()):
        if seed % stride:
            continue
        for projection, montage in joined(folder, pair, 2 * seed, px_per_deg).items():
            place = montage.placed[1]
            error_px = float(np.hypot(*np.subtract(place.shift_px or (np.nan, np.nan), pair.shift_px)))
            common_px = common_error_px(montage, pair, px_per_deg)
            turn_deg = (np.nan if place.rotation_deg is None else place.rotation_deg) - pair.torsion_deg
            line = projection, pair.overlap, abs(pair.torsion_deg)
            found.setdefault(line, []).append((error_px, common_px, place.used))
            print(
                f"{projection} {pair.photograph:6} overlap {pair.overlap:.2f} torsion {pair.torsion_deg:+.0f} used "
                f"{place.used!s:5} error {error_px:5.2f} px, common {common_px:5.2f} px, {turn_deg:+.2f} deg, "
                f"peak {place.peak:.2f}, overlap found {place.overlap:.2f}",
                flush=True,
            )
    return found


def different_eyes(folder: Path) -> list[bool]:
    """Return for 20 pairs of different photographs whether they were refused."""
    random = np.random.default_rng(22)
    refused = []
    for seed, (a, b) in enumerate(list(combinations(PHOTOGRAPHS, 2))[:20]):
        steps = [np.array([random.uniform(-0.1, 0.1), random.uniform(-0.4, 0.4)]) * FIELD_PX for _ in range(2)]
        both = [picture(folder, name, step, 0.0, 900 + 2 * seed) for name, step in zip((a, b), steps, strict=True)]
        place = make_montage(both).placed[1]
        refused.append(not place.used)
        print(f"{a:6} {b:6} used {place.used!s:5} peak {place.peak:.2f}, overlap {place.overlap:.2f}", flush=True)
    return refused


def main() -> None:
    """Print all figures; exit status 1 if a line of the acceptance fails, on the sphere with --field-deg."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with fundus/")
    parser.add_argument("--field-deg", type=float, help="diameter of the field of an eye that turns")
    parser.add_argument("--stride", type=int, default=1, help="measure every n-th pair only")
    asked = parser.parse_args()
    folder, px_per_deg = asked.data / "fundus", None if asked.field_deg is None else FIELD_PX / asked.field_deg
    if not folder.is_dir():
        raise SystemExit("say where the photographs are: DATA=folder, which holds fundus/")
    found, refused, failed = same_eye(folder, px_per_deg, asked.stride), different_eyes(folder), False
    for (projection, overlap, torsion_deg), pairs_there in found.items():
        used = sum(is_used for _, _, is_used in pairs_there)
        errors_px = np.array([pair[:2] for pair in pairs_there if pair[2]]).reshape(-1, 2)
        rms_px, common_px = np.sqrt(np.mean(errors_px**2, axis=0)) if used else (np.nan, np.nan)
        limit_px = 0.6 if overlap >= 0.44 else 1.5
        holds = used == 0 if overlap <= 0.15 else used == len(pairs_there) and rms_px <= limit_px
        failed |= not holds and (projection == "sphere" or px_per_deg is None)
        print(
            f"{'ok  ' if holds else 'MISS'} {projection} overlap {overlap:.2f}, torsion {torsion_deg:.0f} deg: "
            f"{used} of {len(pairs_there)} placed, rms error {rms_px:.2f} px, {common_px:.2f} px over the common part"
        )
    failed |= not all(refused)
    print(f"{'ok  ' if all(refused) else 'MISS'} different eyes: {sum(refused)} of {len(refused)} refused")
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    main()
