"""Features of a picture that follow the truth: edges along a row, bright and dark spots."""

import numpy as np
from scipy import ndimage

from device.values import Image
from tests.paper.bench import SimulatedFrame

SOFT_DEG = 0.3  # blur of a cutline before edge detection; the resolution is about 0.5
EDGE_STEP = 0.05  # step of a clear edge over the blur's width, of the field's mean
LESION_DEG, AROUND_DEG, LESION_STEP = 0.35, 1.2, 0.03  # blur, surroundings, least contrast of a spot


def edge_signs(take: SimulatedFrame, picture: Image, down_deg: float, step: float = EDGE_STEP) -> tuple[int, int]:
    """Return the number of clear edges of the truth along a row, and how many have the same sign in the picture.

    `step` is the least height of a clear edge over the width of the blur, as a share of the field's mean.
    """
    row, sigma = take.row(down_deg), SOFT_DEG * take.px_per_deg
    cols = np.flatnonzero(take.inside[row])[round(3 * sigma) : -round(3 * sigma)]
    slopes = [
        np.gradient(ndimage.gaussian_filter(np.where(take.inside, x, 0).astype(np.float64), sigma)[row])[cols]
        for x in (take.truth, picture)
    ]
    steep = np.abs(slopes[0])
    clear = step * float(take.truth[take.inside].mean()) / (2 * sigma)
    edges = (steep > clear) & (steep == ndimage.maximum_filter1d(steep, round(2 * sigma) | 1))
    return int(edges.sum()), int((np.sign(slopes[0][edges]) == np.sign(slopes[1][edges])).sum())


def spots_followed(take: SimulatedFrame, picture: Image) -> tuple[int, int]:
    """Return the number of bright and dark spots of the truth away from vessels, and how many the picture shows.

    A spot differs by LESION_STEP of the field's mean from its surroundings after a blur of LESION_DEG. A picture
    shows it if the spot's mean differs in the same direction there.
    """
    fine, coarse = LESION_DEG * take.px_per_deg, AROUND_DEG * take.px_per_deg

    def local(image: Image) -> np.ndarray:
        plane = np.where(take.inside, image, image[take.inside].mean()).astype(np.float64)
        return np.asarray(ndimage.gaussian_filter(plane, fine) - ndimage.gaussian_filter(plane, coarse))

    truth, shown = local(take.truth), local(picture)
    known = take.staged.vessels
    assert known is not None
    vessels = ndimage.binary_dilation(take.sampled(known.astype(np.float32)) > 0.2, iterations=round(fine))
    deep = ndimage.binary_erosion(take.inside, iterations=round(coarse)) & ~vessels
    spots, count = ndimage.label(deep & (np.abs(truth) > LESION_STEP * float(take.truth[take.inside].mean())))
    if not count:
        return 0, 0
    each = range(1, count + 1)
    large = ndimage.sum_labels(np.ones_like(truth), spots, each) >= fine**2
    same = np.sign(ndimage.mean(truth, spots, each)) == np.sign(ndimage.mean(shown, spots, each))
    return int(large.sum()), int((large & same).sum())
