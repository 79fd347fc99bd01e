"""Image files of other programs: what they say about their pixels is applied, or refused by its name."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from services.research.python_api import reconstruct
from tests.property.encoded_images import (
    Encoded,
    difference,
    encoded_images,
    random_array,
    random_dng,
    random_png,
    random_tiff,
)


def test_500_files_hold_the_pixels_that_they_mean_or_are_refused_by_name(tmp_path: Path) -> None:
    wrong = [found for file in encoded_images(0, 500) if (found := difference(file, tmp_path))]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("writer", [random_tiff, random_dng, random_png, random_array])
def test_a_file_gives_the_picture_of_the_same_values_in_an_array(
    tmp_path: Path, writer: Callable[[np.random.Generator], Encoded]
) -> None:
    tried = 0
    for seed in range(20):
        file = writer(np.random.default_rng((7, seed)))
        if tried == 3 or file.meant.max() < 8:  # 2 bits are no scene
            continue
        path = tmp_path / f"raw{file.suffix}"
        path.write_bytes(file.data)
        rows, cols = file.meant.shape[:2]
        y, x = np.ogrid[:rows, :cols]
        spots = ((rows // 2, cols // 2), (rows // 2 - 5, cols // 2 + 4), (rows // 2 + 3, cols // 2 - 6))
        psf = sum(np.exp(-((y - top) ** 2 + (x - left) ** 2) / 4.0) for top, left in spots)
        made, expected = (reconstruct(raw, psf.astype(np.float32)).picture for raw in (path, file.meant))
        assert np.corrcoef(made.ravel(), expected.ravel())[0, 1] > 0.99, file.names
        tried += 1
    assert tried == 3
