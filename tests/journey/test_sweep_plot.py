"""PSF selection from a stack: the sharpest PSF is reported and marked in the plot."""

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from services.cli import main
from tests import scenes

SHAPE = (120, 160)


@pytest.fixture
def arguments(tmp_path: Path) -> list[str]:
    """Return the arguments of `reconstruct` for a frame blurred by the second of three PSFs."""
    rng = np.random.default_rng(3)
    picture = np.zeros(SHAPE)
    for row in range(30, 90, 12):
        picture[row : row + 5, 40:120] = rng.uniform(0.4, 1)
    psfs = [scenes.speckle(SHAPE, seed) for seed in (1, 2, 3)]
    otf = np.fft.rfft2(np.fft.ifftshift(psfs[1]))
    seen = np.fft.irfft2(np.fft.rfft2(picture) * otf, SHAPE)
    np.save(tmp_path / "raw.npy", (3000 * seen / seen.max() + rng.normal(0, 2, SHAPE)).astype(np.float32))
    words = ["reconstruct", str(tmp_path / "raw.npy"), "-o", str(tmp_path / "out.npy")]
    for name, psf in zip(("near", "middle", "far"), psfs, strict=True):
        np.save(tmp_path / f"{name}.npy", psf)
        words += ["--psf", str(tmp_path / f"{name}.npy")]
    return words


def test_the_sharpest_psf_is_named_and_marked_in_the_plot(arguments: list[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--report", str(tmp_path / "r.json"), "--sweep", str(tmp_path / "sweep.svg")])
    assert ended.value.code == 0
    assert json.loads((tmp_path / "r.json").read_text())["psf_index"] == 1
    drawing = ElementTree.parse(tmp_path / "sweep.svg")
    words = " ".join(part for text in drawing.iter() for part in text.itertext())
    assert "sharpest: middle" in words
    for name in ("near", "middle", "far"):
        assert name in words


def test_a_sweep_of_one_psf_is_refused(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*arguments[:6], "--sweep", str(tmp_path / "sweep.svg")])
    assert ended.value.code == 2
    assert "more than once" in capsys.readouterr().err
    assert not (tmp_path / "out.npy").exists()
