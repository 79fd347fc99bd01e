"""Lensless data sets in local folders: published layouts, and their recognition by the files of a folder.

The facts are those of the publications and of the code that their authors published with the data: Antipa et al.,
Optica 5, 1 (2018); Monakhova et al., Optics Express 27, 28075 (2019); Bezzam et al., JOSS 8, 4747 (2023). Nothing is
downloaded.
"""

import csv
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from device.config.image_files import SUFFIXES, read_counts
from device.errors import FrameError, SettingError
from device.user_files import files_in
from services.research.dataset_pairs import Dataset, Entry, Layout, Region, psf_factor

Split = Literal["test", "all"]
Files = dict[str, Path]  # by stem

DIFFUSERCAM = "Antipa et al., DiffuserCam: lensless single-exposure 3D imaging, Optica 5, 1 (2018)"
MONAKHOVA = "Monakhova et al., Learned reconstructions for mask-based lensless imaging, Optics Express 27, 28075 (2019)"
LENSLESSPICAM = "Bezzam et al., LenslessPiCam, Journal of Open Source Software 8, 4747 (2023)"
UNSTATED = "not stated with the data; ask the authors before you pass them on"
BSD = "BSD-3-Clause (Waller Lab, UC Berkeley)"

DLMD = Layout(
    "dlmd",
    "DiffuserCam Lensless Mirflickr Dataset (DLMD)",
    frames="upside down",
    truths="upside down",
    bgr=True,
    region=Region(60, 270, 62, 442),
    region_of=(270, 480),
    aligned=True,
    citation=MONAKHOVA,
    licence="BSD-3-Clause for the authors' sample pairs; the whole set: as its page states",
)
TUTORIAL = Layout("diffusercam-tutorial", "DiffuserCam tutorial", citation=DIFFUSERCAM, licence=BSD)
DEPTHS = Layout("diffusercam-3d", "DiffuserCam, PSFs over depth", citation=DIFFUSERCAM, licence=BSD)
EXPORT = Layout(
    "lenslesspicam", "pairs in LenslessPiCam's layout", citation=LENSLESSPICAM, licence="as the data set's card states"
)
MEASURED = Layout("lenslesspicam-raw", "raw frames in LenslessPiCam's layout", citation=LENSLESSPICAM, licence=UNSTATED)
SIMULATED = Layout("simulated", "scenes of diffuscope simulate", aligned=True, licence="your own")
PAIRS = Layout("pairs", "own pairs", licence="your own")

# Orientation and place of the truth for data sets that LenslessPiCam 1.0.8 lists, by the start of the folder's name.
EXPORTS = {
    "DiffuserCam-Lensless-Mirflickr": replace(
        DLMD, name="lenslesspicam", title=f"{DLMD.title}, export of LenslessPiCam", bgr=False
    ),
    "TapeCam-Mirflickr": replace(EXPORT, placement=Region(45, 295, 95, 428), aligned=True, licence="MIT"),
    "MultiLens-Mirflickr-Ambient": replace(EXPORT, placement=Region(118, 241, 220, 343), aligned=True, licence="MIT"),
    "DigiCam-Mirflickr": replace(
        EXPORT, frames="rotated by 180 degrees", placement=Region(80, 280, 100, 366), aligned=True
    ),
}


@dataclass(frozen=True)
class Found:
    """Files of a recognised layout: raw frames and truths by stem, PSFs; `listed` are the names of a test list."""

    layout: Layout
    raws: Files
    truths: Files
    psfs: tuple[Path, ...]
    listed: frozenset[str] = frozenset()
    own_psfs: bool = False


@dataclass(frozen=True)
class Recogniser:
    """Recognition of one layout: the files in words, and a function that returns them, None if they are not there."""

    files: str
    find: Callable[[Path], Found | None]


def open_dataset(folder: Path | str, psf: Path | str | None = None, split: Split = "test") -> Dataset:
    """Return the data set in a folder, whose layout is recognised by its files.

    Parameters
    ----------
    folder
        Folder of the data set.
    psf
        File that replaces the PSF of the folder, for folders with none or with several.
    split
        "test" leaves out pairs that a list of test files (`dataset_test.csv`) does not name, "all" keeps
        them.

    Returns
    -------
    Dataset
        Pairs in natural order of their names; no image is read yet.

    Raises
    ------
    SettingError
        The folder has no known layout or no PSF that fits, or the split is unknown.
    """
    folder = Path(folder)
    if split not in get_args(Split):
        raise SettingError(f"there is no split '{split}'", f"Choose one of: {', '.join(get_args(Split))}.")
    if not folder.is_dir():
        raise SettingError(f"{folder} is not a folder", "Give the folder into which you unpacked the data set.")
    for recogniser in RECOGNISERS:
        found = recogniser.find(folder)
        if found is not None:
            return _dataset(folder, found, None if psf is None else Path(psf), split)
    looked_for = "; ".join(recogniser.files for recogniser in RECOGNISERS)
    parquet = any(files_in(folder / "data", "*.parquet"))
    raise SettingError(
        f"{folder} has none of the known layouts: {looked_for}",
        "Export the parquet files as pictures first: the page on data sets has the ten lines."
        if parquet
        else "Give the folder that holds these files; the page on data sets shows each layout.",
    )


def _dataset(folder: Path, found: Found, psf: Path | None, split: Split) -> Dataset:
    """Return the data set of recognised files: test list applied, PSF selected, names in natural order."""
    names = sorted(found.raws, key=natural_order)
    notes = []
    if found.listed and split == "test":
        kept = [name for name in names if name in found.listed]
        notes.append(f"{len(kept)} of {len(names)} raw frames are in the list of test files.")
        if missing := len(found.listed - set(names)):
            notes.append(f"{missing} names of the list of test files have no raw frame here.")
        names = kept
    if not names:
        raise SettingError(f"{folder} holds no raw frames", f"Give frames as {', '.join(SUFFIXES)}.")
    if lonely := len(set(found.truths) - set(found.raws)):
        notes.append(f"{lonely} truths have no raw frame of the same name and are left out.")
    psfs: tuple[Path, ...] = ()
    if psf is not None:
        psfs = (psf,)
    elif not found.own_psfs:
        psfs = _fitting(folder, found.psfs, found.raws[names[0]], is_stack=found.layout is DEPTHS)
    entries = tuple(
        Entry(name, found.raws[name], psfs or (_image(found.raws[name].parent, "psf"),), found.truths.get(name))
        for name in names
    )
    return Dataset(folder, found.layout, entries, tuple(notes))


def _fitting(folder: Path, psfs: tuple[Path, ...], raw: Path, is_stack: bool) -> tuple[Path, ...]:
    """Return the PSF whose size fits the raw frame, or a whole stack; SettingError for none or several."""
    if is_stack or len(psfs) == 1:
        return psfs
    shape = _size(raw)
    fitting = [path for path in psfs if shape is None or psf_factor(_size(path) or (0, 0), shape) is not None]
    if len(fitting) == 1:
        return (fitting[0],)
    names = ", ".join(path.name for path in fitting or psfs) or "none"
    what = f"{len(fitting)} PSFs that fit" if fitting else "no PSF that fits"
    raise SettingError(
        f"{folder} holds {what} its raw frames ({names})", "Give the one that belongs to them: --psf FILE."
    )


def _size(path: Path) -> tuple[int, int] | None:
    """Return (rows, cols) of an image file, None if it cannot be read; reading the pair then gives the reason."""
    try:
        rows, cols = read_counts(path).shape[:2]
    except FrameError:
        return None
    return rows, cols


def natural_order(name: str) -> list[tuple[int, str]]:
    """Return a sorting key that orders im2 before im10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _images(folder: Path) -> Files:
    """Return the image files of a folder by stem; empty if the folder does not exist."""
    if not folder.is_dir():
        return {}
    return {path.stem: path for path in files_in(folder) if path.suffix.lower() in SUFFIXES}


def _image(folder: Path, stem: str) -> Path:
    """Return the image file of a stem in a folder; FrameError if there is none."""
    found = _images(folder).get(stem)
    if found is None:
        raise FrameError(f"{folder} holds no image called {stem}", f"Give it as {', '.join(SUFFIXES)}.")
    return found


def _psfs(*folders: Path) -> tuple[Path, ...]:
    """Return the PSF files of the first folder that has any: one with a published name, or all that say `psf`."""
    for folder in folders:
        images = _images(folder)
        for stem in ("psf", "psf_measured", "psf_simulated"):
            if stem in images:
                return (images[stem],)
        if named := tuple(path for stem, path in images.items() if "psf" in stem.lower()):
            return named
    return ()


def _within(folder: Path, *names: str) -> Iterable[Path]:
    """Return the folder itself and its sub-folders of these names: an archive may unpack to either."""
    return folder, *(folder / name for name in names)


def _find_dlmd(folder: Path) -> Found | None:
    for place in _within(folder, "dataset"):
        for raws, truths in (("diffuser_images", "ground_truth_lensed"), ("diffuser", "lensed")):
            if (place / raws).is_dir() and (place / truths).is_dir():
                listed = _test_list(place) or _test_list(folder)
                psfs = _psfs(place, folder)
                return Found(DLMD, _images(place / raws), _images(place / truths), psfs, listed)
    return None


def _test_list(folder: Path) -> frozenset[str]:
    """Return the stems in the first column of dataset_test.csv; empty without that file."""
    path = folder / "dataset_test.csv"
    if not path.is_file():
        return frozenset()
    with path.open(newline="", encoding="utf-8") as file:
        names = [row[0].split(".")[0] for row in csv.reader(file) if row]
    return frozenset(name for name in names if re.search(r"\d", name))  # without the heading of the column


def _find_export(folder: Path) -> Found | None:
    if not ((folder / "lensless").is_dir() and (folder / "lensed").is_dir()):
        return None
    names = [name for name in EXPORTS if folder.resolve().name.startswith(name)]
    layout = EXPORTS[names[0]] if names else EXPORT
    return Found(layout, _images(folder / "lensless"), _images(folder / "lensed"), _psfs(folder))


def _find_measured(folder: Path) -> Found | None:
    for place in _within(folder, "data"):
        if (place / "raw_data").is_dir() and (place / "psf").is_dir():
            return Found(MEASURED, _images(place / "raw_data"), {}, tuple(_images(place / "psf").values()))
    return None


def _find_depths(folder: Path) -> Found | None:
    for place in _within(folder, "example_data"):
        raws = {stem: path for stem, path in _images(place).items() if stem.endswith("raw")}
        stack = tuple(_images(place / "psf").values()) or tuple(files_in(place, "*psf*.mat"))
        if raws and stack:
            return Found(DEPTHS, raws, {}, tuple(sorted(stack, key=lambda path: natural_order(path.stem))))
    return None


def _find_tutorial(folder: Path) -> Found | None:
    for place in _within(folder, "tutorial"):
        images = _images(place)
        raws = {stem: path for stem, path in images.items() if stem.startswith("rawdata")}
        if raws and "psf_sample" in images:
            return Found(TUTORIAL, raws, {}, (images["psf_sample"],))
    return None


def _find_simulated(folder: Path) -> Found | None:
    places = [folder, *(path for path in files_in(folder) if path.is_dir())]
    scenes = {place.name: images for place in places if {"raw", "psf"} <= set(images := _images(place))}
    if not scenes:
        return None
    raws = {name: images["raw"] for name, images in scenes.items()}
    truths = {name: images["truth"] for name, images in scenes.items() if "truth" in images}
    return Found(SIMULATED, raws, truths, (), own_psfs=True)


def _find_pairs(folder: Path) -> Found | None:
    raws = _images(folder / "raw")
    psfs = _psfs(folder)
    return Found(PAIRS, raws, _images(folder / "truth"), psfs) if raws and psfs else None


RECOGNISERS = (
    Recogniser("DLMD (diffuser_images/ and ground_truth_lensed/, or diffuser/ and lensed/, with psf.tiff)", _find_dlmd),
    Recogniser("LenslessPiCam (lensless/ and lensed/ with psf.png)", _find_export),
    Recogniser("LenslessPiCam's raw frames (raw_data/ and psf/)", _find_measured),
    Recogniser("DiffuserCam over depth (example_raw.png with psf/ or example_psfs.mat)", _find_depths),
    Recogniser("DiffuserCam tutorial (rawdata*.tif and psf_sample.tif)", _find_tutorial),
    Recogniser("diffuscope simulate (folders with raw.tiff, psf.tiff and truth.npy)", _find_simulated),
    Recogniser("own pairs (raw/ and truth/ with psf.tiff)", _find_pairs),
)
