"""Sources of an archive: a store of the instrument, exported visits, and folders of raw frames with their PSFs.

Every source is only read. A store is read by the files of its records (`record.json`), not by its database, so it may
be in use, on a disk that takes no changes, or a restored backup.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import count, takewhile
from pathlib import Path
from typing import Literal

from device.calibration.archive import MANIFEST, Archive
from device.config.image_files import SUFFIXES
from device.errors import CalibrationError, SettingError
from device.user_files import files_in
from services.archive.plan import COLOUR_ROLES, Role
from services.records.capture import CaptureReport, OtherColour
from services.research.dataset_pairs import Entry
from services.research.datasets import open_dataset

COMPANIONS = ("dark", "flat")
RECORDING_REMEDY = "Give a store (captures/), a folder of exports, or a folder with raw frames and psf.tiff."


@dataclass(frozen=True)
class FoundCalibration:
    """Files of one calibration by role: PSFs, dark, flat; or a folder of a calibration archive.

    `colour_psfs`: PSFs of single colours of light; `psfs` hold for the burst and for every colour without one.
    `archived`: folder of an archived calibration, which replaces all other files.
    """

    psfs: tuple[Path, ...] = ()
    colour_psfs: tuple[tuple[OtherColour, Path], ...] = ()
    dark: Path | None = None
    flat: Path | None = None
    archived: Path | None = None

    @property
    def files(self) -> tuple[tuple[Role, Path], ...]:
        """Role and path of each file, in the order in which the digest of the calibration takes them."""
        if self.archived is not None:
            names = Archive(self.archived.parent).files(self.archived.name)
            return tuple(("archive", self.archived / name) for name in sorted(names))
        found: list[tuple[Role, Path]] = [("psf", path) for path in self.psfs]
        found += [(COLOUR_ROLES[colour], path) for colour, path in self.colour_psfs]
        found += [("dark", self.dark)] if self.dark is not None else []
        found += [("flat", self.flat)] if self.flat is not None else []
        return tuple(found)


@dataclass(frozen=True)
class FoundFrame:
    """One more raw frame of a capture: of the burst, or in another `colour` of light; `sha256` as in FoundCapture.

    `unusable`: the instrument's reason to leave the frame out for its quality; empty if it may be used.
    """

    path: Path
    sha256: str | None = None
    colour: OtherColour | Literal[""] = ""
    unusable: str = ""


@dataclass(frozen=True)
class FoundCapture:
    """A capture in a source; `refused` is the reason why it cannot be reconstructed, None if it can.

    `raw` is its first frame, `frames` are the others: of the burst in their order, then those in other colours.
    `raw_sha256` and `dark_sha256` are as recorded in a store, None where the file must be read. `device`: name of the
    folder of its calibration archive; `origin`: UUID of the device; both are empty if unknown.
    """

    id: str
    raw: Path
    calibration: FoundCalibration | None = None
    raw_sha256: str | None = None
    frames: tuple[FoundFrame, ...] = ()
    dark: Path | None = None
    dark_sha256: str | None = None
    truth: Path | None = None
    before: Path | None = None
    report: Path | None = None
    device: str = ""
    origin: str = ""
    eye: str = ""
    taken_at: str = ""
    refused: str | None = None


def find_captures(source: Path, calibrations: Mapping[str, Path]) -> Iterator[FoundCapture]:
    """Yield every capture of a source, sorted by name; `calibrations`: folders of archived calibrations by id.

    SettingError for a folder that is no source, or that does not exist.
    """
    if not source.is_dir():
        raise SettingError(f"{source} is not a folder", RECORDING_REMEDY)
    if is_store(source):
        yield from _of_store(source, dict(calibrations) | archived_calibrations(source))
    elif exports := _exports(source):
        for place in exports:
            yield from _of_export(place)
    else:
        yield from _of_recording(source)


def is_store(folder: Path) -> bool:
    """Return whether a folder is the store of an instrument."""
    return (folder / "captures").is_dir()


def archived_calibrations(folder: Path) -> dict[str, Path]:
    """Return the folder of each archived calibration below a folder (at most three levels), by its id."""
    found: dict[str, Path] = {}
    for pattern in (f"*/{MANIFEST}", f"*/*/{MANIFEST}", f"*/*/*/{MANIFEST}"):
        found |= {path.parent.name: path.parent for path in files_in(folder, pattern)}
    return found


def _of_store(store: Path, calibrations: Mapping[str, Path]) -> Iterator[FoundCapture]:
    unusable = {id: refusal for id, folder in calibrations.items() if (refusal := _refusal(folder))}
    places = [path for path in files_in(store / "captures") if path.is_dir()]
    for place in places:
        yield _stored(store, place, calibrations, unusable)


def _refusal(folder: Path) -> str | None:
    """Return why an archived calibration cannot be used, None if it is whole."""
    try:
        Archive(folder.parent).files(folder.name)
    except CalibrationError as error:
        return error.message
    return None


def _stored(store: Path, place: Path, calibrations: Mapping[str, Path], unusable: Mapping[str, str]) -> FoundCapture:
    """Return one capture of a store; refused without a record, a raw frame or a calibration."""
    from services.errors import StoreDamaged
    from services.records.capture import CaptureReport
    from services.records.record_files import RecordFiles  # deferred: imports SQLAlchemy, of the extra `instrument`

    found = FoundCapture(place.name, place / "raw.tiff")
    try:
        record = RecordFiles(store).read("capture", place.name)
    except StoreDamaged as error:
        return replace(found, refused=f"its record is damaged: {error.message}")
    if record is None:
        return replace(found, refused="it has no record; open the store once with this release")
    content = record.content
    digests = _digests(record.content.get("files"))
    try:
        report = CaptureReport.read(content.get("report"))
    except (ValueError, KeyError) as error:
        return replace(found, refused=f"its report cannot be read: {error}")
    id = str(content.get("calibration_id"))
    found = replace(
        found,
        raw_sha256=digests.get("raw.tiff"),
        dark_sha256=digests.get("dark.tiff"),
        dark=place / "dark.tiff" if "dark.tiff" in digests else None,
        report=place / "report.json",
        frames=_stored_frames(place, digests, report),
        before=place / "picture.png",
        eye=str(content.get("eye", "")),
        taken_at=str(content.get("taken_at", "")),
        device=calibrations[id].parent.name if id in calibrations else "",
        origin=(report.device and report.device.uuid) or "",
    )
    if gone := [path.name for path in (found.raw, *(frame.path for frame in found.frames)) if not path.is_file()]:
        return replace(found, refused=f"its raw frame {gone[0]} was removed")
    if id not in calibrations:
        return replace(found, refused=f"its calibration {id} is in no source; give the folder that holds it, too")
    if id in unusable:
        return replace(found, refused=f"its calibration {id} cannot be used: {unusable[id]}")
    return replace(found, calibration=FoundCalibration(archived=calibrations[id]))


def _stored_frames(place: Path, digests: Mapping[str, str], report: CaptureReport) -> tuple[FoundFrame, ...]:
    """Return the further frames of a stored capture, with the reasons why its report leaves some of them out."""
    from services.instrument.frame_preparation import FRAME_QUALITY  # deferred: imports SQLAlchemy

    uses = report.frames
    reasons = {use.index: use.reason for use in uses if use.reason and use.reason.startswith(FRAME_QUALITY)}
    named = {path.stem: path for path in (place / name for name in digests) if path.suffix == ".tiff"}
    return tuple(
        replace(frame, sha256=digests[frame.path.name], unusable="" if frame.colour else reasons.get(k, ""))
        for k, frame in enumerate(further_frames("raw", named), 1)
    )


def further_frames(stem: str, images: Mapping[str, Path]) -> tuple[FoundFrame, ...]:
    """Return the frames that belong to a first frame by their names, as the instrument writes them.

    `<stem>-1`, `<stem>-2` and so on without a gap are those of its burst, `<stem>-red`, `-blue` and `-amber` those in
    other colours of light. `images` are the files of the folder by stem.
    """
    burst = takewhile(lambda name: name in images, (f"{stem}-{k}" for k in count(1)))
    frames = [FoundFrame(images[name]) for name in burst]
    frames += [
        FoundFrame(images[name], colour=colour) for colour in COLOUR_ROLES if (name := f"{stem}-{colour}") in images
    ]
    return tuple(frames)


def _digests(files: object) -> dict[str, str]:
    """Return the SHA-256 of each file that a record of a capture names."""
    entries = files.items() if isinstance(files, dict) else ()
    return {name: str(entry.get("sha256")) for name, entry in entries if isinstance(entry, dict)}


def _exports(source: Path) -> list[Path]:
    """Return the folders of exported visits in a folder, or the folder itself."""
    return [path.parent for path in files_in(source, "visit.json", "*/visit.json")]


def _of_export(visit: Path) -> Iterator[FoundCapture]:
    """Yield the captures of an exported visit: an export has pictures and reports, and no raw frames."""
    for picture in files_in(visit, "*.png"):
        raw = visit / f"{picture.stem}.tiff"
        reason = "an export holds no raw frame; give the store or its backup instead"
        yield FoundCapture(f"{visit.name}/{picture.stem}", raw, before=picture, refused=reason)


def _of_recording(folder: Path) -> Iterator[FoundCapture]:
    """Yield the frames of a folder of a known data set, else of one with raw frames beside psf, dark and flat."""
    images = _images(folder)
    coloured = _colour_psfs(folder)
    psfs = tuple(path for stem, path in images.items() if "psf" in stem.lower() and path not in dict(coloured).values())
    own = {stem: path for stem, path in images.items() if "psf" not in stem.lower() and stem not in COMPANIONS}
    if not (psfs and own) or "raw" in images:  # a published layout, or a scene of `diffuscope simulate`
        try:
            yield from _of_dataset(folder)
        except SettingError as error:
            if own and not psfs and "raw" not in images:
                raise SettingError(f"{folder} has {len(own)} images, but no psf.tiff", RECORDING_REMEDY) from error
            raise
        return
    calibration = FoundCalibration(psfs, coloured, images.get("dark"), images.get("flat"))
    for stem, frames in _grouped(own).items():
        yield FoundCapture(stem, own[stem], calibration, frames=frames)


def _grouped(images: Mapping[str, Path]) -> dict[str, tuple[FoundFrame, ...]]:
    """Return the further frames of each first frame, by its stem; a frame belongs to one capture."""
    groups: dict[str, tuple[FoundFrame, ...]] = {}
    taken: set[Path] = set()
    for stem in sorted(images):
        if images[stem] not in taken:
            groups[stem] = further_frames(stem, images)
            taken |= {frame.path for frame in groups[stem]}
    return groups


def _of_dataset(folder: Path) -> Iterator[FoundCapture]:
    """Yield the pairs of a data set; of scenes and own pairs, several frames of one name are one capture."""
    dataset = open_dataset(folder, split="all")
    own_layout = dataset.layout.name in ("pairs", "simulated")
    images = {folder: _images(folder) for folder in {entry.raw.parent for entry in dataset.entries}}
    groups = {folder: _grouped(found) for folder, found in images.items()} if own_layout else {}
    for entry in dataset.entries:
        place = entry.raw.parent
        stem = entry.raw.stem
        if own_layout and stem not in groups[place]:
            continue  # a further frame of another entry
        found = _of_entry(folder, entry, dataset.layout.aligned or dataset.layout.name == "pairs")
        yield replace(found, frames=groups[place][stem]) if own_layout else found


def _of_entry(folder: Path, entry: Entry, aligned: bool) -> FoundCapture:
    """Return a pair of a data set; `aligned`: its truth is on the pixels of the stored frame."""
    dark, flat = (_beside(folder, name) for name in COMPANIONS)
    before = _beside(folder / "before", entry.raw.stem)
    calibration = FoundCalibration(entry.psfs, _colour_psfs(entry.psfs[0].parent), dark, flat)
    return FoundCapture(entry.name, entry.raw, calibration, truth=entry.truth if aligned else None, before=before)


def _colour_psfs(folder: Path) -> tuple[tuple[OtherColour, Path], ...]:
    """Return the PSFs of other colours in a folder, `psf-red` and so on, by colour."""
    found = ((colour, _beside(folder, role)) for colour, role in COLOUR_ROLES.items())
    return tuple((colour, path) for colour, path in found if path is not None)


def _images(folder: Path) -> dict[str, Path]:
    """Return the image files of a folder by stem."""
    return {path.stem: path for path in files_in(folder) if path.suffix.lower() in SUFFIXES}


def _beside(folder: Path, stem: str) -> Path | None:
    """Return the image with this stem in a folder, None without one."""
    found = [folder / f"{stem}{ending}" for ending in SUFFIXES]
    return next((path for path in found if path.is_file()), None)
