"""Tiny data sets in every published layout, written from one simulated scene."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image as Pillow
from scipy.io import savemat

from device.config.head_file import load_head
from device.config.image_files import read_image
from services.research.simulate_scene import SelectedEffects, write_scene

SCENE = Path(__file__).parents[1] / "device" / "sim" / "scenes" / "diabetic.toml"
ROWS, COLS = 60, 80
Array = NDArray[np.generic]


@dataclass(frozen=True)
class Scene:
    """Arrays of one simulated exposure, upright: counts, PSF, truth; colour as red, green, blue."""

    folder: Path
    raw: NDArray[np.uint16]
    psf: NDArray[np.float32]
    truth: NDArray[np.float32]

    @property
    def colour(self) -> NDArray[np.float32]:
        """Counts as float of 0 to 1 with three channels of different gain."""
        grey = self.raw.astype(np.float32) / self.raw.max()
        return np.stack([grey, grey * np.float32(0.8), grey * np.float32(0.6)], axis=2)

    @property
    def colour_truth(self) -> NDArray[np.float32]:
        """Truth with three channels."""
        return np.stack([self.truth] * 3, axis=2)


def simulate_tiny(folder: Path) -> Scene:
    """Simulate the diabetic scene with 60 x 80 large pixels into a folder, as `diffuscope simulate` does."""
    spec = load_head(SCENE)
    size = {"rows": ROWS, "cols": COLS, "pitch_um": 90.0}
    write_scene(spec.model_copy(update={"camera": spec.camera.model_copy(update=size)}), folder, SelectedEffects())
    raw, psf, truth = (read_image(folder / name) for name in ("raw.tiff", "psf.tiff", "truth.npy"))
    return Scene(folder, raw, psf, truth)


def stored(array: Array) -> Array:
    """Return an upright red, green, blue array as DLMD stores it: upside down; blue, green, red."""
    return array[::-1, :, ::-1]


def stored_psf(psf: Array) -> Array:
    """Return a PSF upside down around its centre (rows//2, cols//2)."""
    return np.roll(psf[::-1], 1 - psf.shape[0] % 2, axis=0)


def write_dlmd(folder: Path, scene: Scene) -> None:
    """Write the sample layout of DLMD: two pairs."""
    for name, array in (("diffuser", scene.colour), ("lensed", scene.colour_truth)):
        (folder / name).mkdir(parents=True)
        for pair in ("im10", "im2"):
            np.save(folder / name / f"{pair}.npy", stored(array))
    np.save(folder / "psf.npy", stored_psf(scene.psf))


def write_full_dlmd(folder: Path, scene: Scene) -> None:
    """Write the layout of the whole DLMD: a list of test files, and a PSF of four times the size."""
    for name, array in (("diffuser_images", scene.colour), ("ground_truth_lensed", scene.colour_truth)):
        (folder / "dataset" / name).mkdir(parents=True)
        for k in (2, 3, 1001):
            np.save(folder / "dataset" / name / f"im{k}.npy", stored(array))
    (folder / "dataset_test.csv").write_text("name,\nim2.jpg.tiff,x\nim3.jpg.tiff,x\nim4.jpg.tiff,x\n")
    tifffile.imwrite(folder / "psf.tiff", np.kron(stored_psf(scene.psf), np.ones((4, 4), np.float32)))


def write_export(folder: Path, scene: Scene) -> None:
    """Write pictures as exported from Hugging Face for LenslessPiCam, 8 bits, with one truth missing."""
    for name, array in (("lensless", scene.colour), ("lensed", scene.colour_truth)):
        (folder / name).mkdir(parents=True)
        pixels = np.round(255 * array / array.max()).astype(np.uint8)
        for k in range(2 if name == "lensless" else 1):
            Pillow.fromarray(pixels).save(folder / name / f"{k}.png")
    np.save(folder / "psf.npy", scene.psf)


def write_raw_data(folder: Path, scene: Scene) -> None:
    """Write raw frames and PSFs as LenslessPiCam's own recordings; one PSF is of another camera."""
    (folder / "raw_data").mkdir(parents=True)
    (folder / "psf").mkdir()
    tifffile.imwrite(folder / "raw_data" / "thumbs_up.tiff", scene.raw)
    np.save(folder / "psf" / "tape.npy", scene.psf)
    np.save(folder / "psf" / "other.npy", np.ones((20, 30), np.float32))


def write_depths(folder: Path, scene: Scene) -> None:
    """Write a raw frame and a stack of three PSFs as images."""
    (folder / "psf").mkdir(parents=True)
    Pillow.fromarray(scene.raw).save(folder / "example_raw.png")
    for depth, shift in ((0, 3), (8, 0), (16, 6)):
        tifffile.imwrite(folder / "psf" / f"psf{depth:02}.tiff", np.roll(scene.psf, shift, axis=1))


def write_matlab_depths(folder: Path, scene: Scene) -> None:
    """Write a raw frame and a stack of three PSFs as a MATLAB file."""
    (folder / "example_data").mkdir(parents=True)
    Pillow.fromarray(scene.raw).save(folder / "example_data" / "example_raw.png")
    savemat(folder / "example_data" / "example_psfs.mat", {"psf": np.stack([scene.psf] * 3, axis=2)})


def write_tutorial(folder: Path, scene: Scene) -> None:
    """Write 12-bit counts shifted left by 4 bits."""
    folder.mkdir(parents=True)
    counts = np.left_shift(scene.raw >> max(int(scene.raw.max()).bit_length() - 12, 0), 4).astype(np.uint16)
    tifffile.imwrite(folder / "rawdata_hand_sample.tif", counts)
    np.save(folder / "psf_sample.npy", scene.psf)


def write_simulated(folder: Path, scene: Scene) -> None:
    """Write two folders as `diffuscope simulate` does."""
    for name in ("a", "b"):
        (folder / name).mkdir(parents=True)
        for file in ("raw.tiff", "psf.tiff", "truth.npy"):
            (folder / name / file).write_bytes((scene.folder / file).read_bytes())


def write_pairs(folder: Path, scene: Scene) -> None:
    """Write a folder of own pairs; the last raw frame is damaged."""
    for name, array in (("raw", scene.raw), ("truth", scene.truth)):
        (folder / name).mkdir(parents=True)
        for pair in ("eye1", "eye2"):
            np.save(folder / name / f"{pair}.npy", array)
    (folder / "raw" / "eye3.npy").write_bytes((folder / "raw" / "eye1.npy").read_bytes()[:500])
    tifffile.imwrite(folder / "psf.tiff", scene.psf)


WRITERS: dict[str, Callable[[Path, Scene], None]] = {
    "dlmd": write_dlmd,
    "full dlmd": write_full_dlmd,
    "lenslesspicam": write_export,
    "lenslesspicam-raw": write_raw_data,
    "diffusercam-3d": write_depths,
    "matlab": write_matlab_depths,
    "diffusercam-tutorial": write_tutorial,
    "simulated": write_simulated,
    "pairs": write_pairs,
}
