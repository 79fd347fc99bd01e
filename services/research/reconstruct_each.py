"""`diffuscope reconstruct --each`: one picture for each raw of a recording, in one process with one planned solver."""

from collections.abc import Callable, Sequence
from pathlib import Path

from device.clock import SystemClock
from device.errors import DiffuscopeError, SettingError, SpecError, StoreFull
from services.research.reconstruct_file import (
    ENDINGS,
    FileReconstruction,
    FileReconstructor,
    write_or_raise,
    write_picture,
)
from services.research.reconstruct_inputs import ReconstructOptions

ENDING = ".tiff"  # linear float32, which image viewers open too


def reconstruct_each(
    raws: Sequence[Path],
    options: ReconstructOptions,
    folder: Path,
    reports: Path | None,
    done: Callable[[str], None],
    progress: Callable[[str], None],
) -> int:
    """Write FOLDER/<name of the raw>.tiff for each raw, and a report to `reports`; return the number of failed raws.

    `done` gets a line for each picture; `progress`
    gets the number of raws that are done, the seconds left, each error, and each note once. The folders are created.
    SettingError or SpecError for options that are wrong for every raw, StoreFull for a full disk.
    """
    if options.sweep is not None:
        raise SettingError("a sweep is drawn for one raw", "Leave --sweep or --each out.")
    places = _places(raws, folder)
    reconstruct = FileReconstructor(options)
    for path in (folder, *([] if reports is None else [reports])):
        _make_folder(path)
    clock = SystemClock()
    failed = 0
    noted = set[str]()
    begin_s = first_s = clock.now_s()
    for number, (raw, place) in enumerate(zip(raws, places, strict=True), 1):
        try:
            made = _reconstruct_one(reconstruct, raw, place, reports)
        except (SettingError, SpecError, StoreFull):
            raise  # the same for every raw
        except DiffuscopeError as error:
            failed += 1
            progress(f"error: {raw.name}: {error.message}\n{error.remedy}")
        else:
            done(f"{place}: {made.summary}")
            for note in made.report.warnings:
                if note not in noted:
                    progress(f"note: {raw.name}: {note}")
            noted.update(made.report.warnings)
        now_s = clock.now_s()
        first_s = now_s if number == 1 else first_s
        each_s = (now_s - first_s) / (number - 1) if number > 1 else now_s - begin_s  # the first raw is planned for
        progress(f"{number}/{len(raws)} done, {each_s * (len(raws) - number):.0f} s left")
    return failed


def _reconstruct_one(
    reconstruct: FileReconstructor, raw: Path, place: Path, reports: Path | None
) -> FileReconstruction:
    """Reconstruct one raw; write the picture, and the report to the folder `reports` if there is one."""
    made = reconstruct(raw)
    write_picture(place, reconstruct.evened(made.picture), made.simulated)
    if reports is not None:
        report = reports / f"{place.stem}.json"
        write_or_raise(report, lambda: report.write_text(made.report_json(), encoding="utf-8"))
    return made


def _places(raws: Sequence[Path], folder: Path) -> list[Path]:
    """Return the path of each picture; SettingError for a folder that is a file, two equal paths, or a raw's path."""
    if folder.is_file() or (folder.suffix.lower() in ENDINGS and not folder.is_dir()):
        raise SettingError(f"{folder} is no folder, and --each writes one picture for each raw", "Give -o FOLDER/.")
    places = [folder / f"{raw.stem}{ENDING}" for raw in raws]
    inputs = {raw.resolve() for raw in raws}
    for place in places:
        if places.count(place) > 1:
            raise SettingError(f"{place} would be written for two raws", "Give raws with different names.")
        if place.resolve() in inputs:
            raise SettingError(f"{place} is a raw and would be overwritten", "Choose another folder with -o FOLDER/.")
    return places


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingError(
            f"the folder {folder} cannot be made: {error.strerror}", "Choose a folder that can be written."
        ) from error
