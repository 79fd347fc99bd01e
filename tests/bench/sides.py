"""`make bench-sides DATA=folder`: rate of laterality estimates, and of wrong ones, on real photographs.

Each photograph is rotated, mirrored, blurred and imaged by the simulated head in more and less light; its picture is
made as by the instrument. The two photographs that set the limits are listed apart from the unseen ones.
"""

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image as Pictures
from PIL import ImageFilter, ImageOps

from device.clock import Deadline, SystemClock
from device.config.head_file import InstrumentSpec, load_head
from device.config.scene import ObjectSpec
from device.recon.assessment.laterality import laterality
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_box
from device.recon.reconstructor import Reconstructor
from device.sim.scene_files import simulate_exposure
from device.values import Eye
from tests.simulated import coarse, with_keys

HEAD = coarse(load_head(Path("hardware/heads/sim.toml")), 2)
CLOCK, PLANNER = SystemClock(), Planner(Path.home() / ".cache" / "diffuscope")
OTHER: dict[Eye, Eye] = {"OD": "OS", "OS": "OD"}
BUDGET_S = 1.0


@dataclass(frozen=True)
class Photo:
    """A photograph: its eye, its width in degrees, and the positions of disc and fovea as shares of its width."""

    file: str
    eye: Eye
    wide_deg: float
    disc: tuple[float, float]
    fovea: tuple[float, float] | None
    seen: bool = False


PHOTOS = (
    Photo("skimage/retina.jpg", "OS", 45.8, (0.167, 0.463), (0.497, 0.497), seen=True),
    Photo("hrf/images/07_h.jpg", "OD", 64.4, (0.781, 0.328), (0.538, 0.340), seen=True),
    Photo("hrf/images/06_dr.JPG", "OD", 64.4, (0.744, 0.313), (0.506, 0.331)),
    Photo("hrf/images/09_g.jpg", "OS", 64.4, (0.269, 0.325), (0.500, 0.354)),
    Photo("chase/Image_01L.jpg", "OS", 32.2, (0.534, 0.475), None, seen=True),
    Photo("chase/Image_05R.jpg", "OD", 32.2, (0.531, 0.487), None, seen=True),
    Photo("chase/Image_11L.jpg", "OS", 32.2, (0.546, 0.430), None),
)
CONDITIONS: dict[str, tuple[float, float, float]] = {  # blur in degrees, light, field in degrees
    "as it is": (0.0, 1.0, 33.4),
    "blurred 0.3 deg": (0.3, 1.0, 33.4),
    "blurred 1 deg": (1.0, 1.0, 33.4),
    "a tenth of the light": (0.0, 0.1, 33.4),
    "a fiftieth": (0.0, 0.02, 33.4),
    "45 deg": (0.0, 1.0, 45.0),
}


def prepared(photo: Photo, data: Path, mirrored: bool, turned_deg: float, blur_deg: float, aim: str, to: Path) -> Eye:
    """Write the object for the head, at the width of the photograph; return its eye."""
    with Pictures.open(data / photo.file) as picture:
        rgb = picture.convert("RGB")
    rgb.thumbnail((1200, 1200))
    per_deg = rgb.width / photo.wide_deg
    x, y = photo.disc
    if aim == "centre" and photo.fovea is not None:  # a third of the way from the macula to the disc
        x, y = (x + 2 * photo.fovea[0]) / 3, (y + 2 * photo.fovea[1]) / 3
    middle = (x * rgb.width, y * rgb.width)
    rgb = rgb.rotate(turned_deg, Pictures.Resampling.BICUBIC, center=middle)
    half = rgb.width // 2
    box = tuple(round(v) for v in (middle[0] - half, middle[1] - half, middle[0] + half, middle[1] + half))
    rgb = rgb.crop(box)
    if blur_deg:
        rgb = rgb.filter(ImageFilter.GaussianBlur(blur_deg * per_deg))
    (ImageOps.mirror(rgb) if mirrored else rgb).save(to)
    return OTHER[photo.eye] if mirrored else photo.eye


class Maker:
    """Reconstruction of images as by the instrument, planned once per field."""

    def __init__(self) -> None:
        self._made: dict[float, Reconstructor] = {}

    def estimate_eye(self, image: Path, wide_deg: float, light: float, field_deg: float) -> tuple[Eye | None, float]:
        """Return the estimated eye of an image's picture, and the confidence."""
        assert HEAD.sim is not None
        assert HEAD.optics is not None
        looked = with_keys(HEAD, peak_e=HEAD.sim.peak_e * light)
        assert looked.sim is not None
        thing = ObjectSpec(kind="image", image=image, size_deg=wide_deg)
        spec: InstrumentSpec = looked.model_copy(
            update={
                "sim": looked.sim.model_copy(update={"object": thing}),
                "optics": HEAD.optics.model_copy(update={"field_deg": field_deg}),
            }
        )
        shot = simulate_exposure(spec)
        if field_deg not in self._made:
            self._made[field_deg] = Reconstructor(shot.calibration, shot.counts.shape, PLANNER, CLOCK)
        made = self._made[field_deg](shot.counts, simulated=True, deadline=Deadline.after(CLOCK, BUDGET_S))
        seen = made.picture[field_box(shot.calibration, shot.counts.shape)]
        assert shot.calibration.geometry is not None
        estimate = laterality(seen, shot.calibration.geometry.px_per_deg, field_deg)
        return estimate.eye, estimate.confidence


def tries(data: Path, maker: Maker, aim: str) -> Iterator[tuple[Photo, str, str, float]]:
    """Yield the result of every photograph in every condition: `right`, `wrong` or `nothing`."""
    with TemporaryDirectory() as folder:
        there = Path(folder) / "eye.png"
        for photo, (name, (blur, light, field)) in product(PHOTOS, CONDITIONS.items()):
            if (aim == "centre" and photo.fovea is None) or not (data / photo.file).is_file():
                continue
            for mirrored, turned in product((False, True), (-10.0, 0.0, 10.0)):
                eye = prepared(photo, data, mirrored, turned, blur, aim, there)
                eye_found, sure = maker.estimate_eye(there, photo.wide_deg, light, field)
                yield photo, name, "nothing" if eye_found is None else "right" if eye_found == eye else "wrong", sure


def main() -> None:
    """Print a table per aim, and the time of one estimate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    data, maker = parser.parse_args().data, Maker()
    for aim in ("centre", "nerve"):
        counts: dict[tuple[bool, str], Counter[str]] = defaultdict(Counter)
        for photo, name, result, sure in tries(data, maker, aim):
            counts[photo.seen, name][result] += 1
            if result == "wrong":
                print(f"wrong: {photo.file}, {name}, {sure:.3f}")
        print(f"\naim: {aim}\n{'':24}{'limits chosen by them':>28}{'never seen before':>28}")
        for name in CONDITIONS:
            cells = [counts[seen, name] for seen in (True, False)]
            print(f"{name:24}" + "".join(f"{c['right']:>12} right {c['wrong']} of {c.total():>3}" for c in cells))
    picture = np.random.default_rng(0).random((1080, 1920), np.float32)
    begin_s = CLOCK.now_s()
    for _ in range(10):
        laterality(picture, 32.0, 33.4)
    print(f"\none look at a picture of 2 MP: {100 * (CLOCK.now_s() - begin_s):.1f} ms")


if __name__ == "__main__":
    main()
