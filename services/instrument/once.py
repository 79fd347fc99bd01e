"""One raw file to one picture file: the same solver as the instrument's, without head, page or shelf."""

import errno
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from device.calibration.archive import Archive
from device.clock import Deadline, SystemClock
from device.errors import FrameError, SettingError, SpecError, StoreError, StoreFull
from device.images import Raw, as_raw, read_image, read_psf, refuse_other_sizes, says_simulated, write_linear
from device.recon.evenness import even_out
from device.recon.focus import sharpest
from device.recon.geometry import disc
from device.recon.methods import method_named
from device.recon.model import field_radius_px
from device.recon.plan import Planner
from device.recon.psf_consistency import PsfConsistency
from device.recon.reconstructor import Recipe, Reconstructor, ladder
from device.spec import CameraSpec, InstrumentSpec, load_head
from device.values import Calibration, Geometry, Image, Reconstruction, Sensor
from services.instrument import sweep_plot
from services.records.picture import to_png


@dataclass(frozen=True)
class Order:
    """What was asked for on the command line."""

    raw: Path
    psfs: tuple[Path, ...]
    output: Path
    method: str | None
    budget_s: float | None
    dark: Path | None
    flat: Path | None
    head: Path | None
    field_deg: float | None
    even: bool
    plans: Path
    report: Path | None = None
    sweep: Path | None = None
    calibration: str | None = None


def reconstruct_file(order: Order) -> Reconstruction:
    """Read, reconstruct, write; everything that can be refused is refused before anything is computed."""
    _refuse_places(order)
    if order.method is not None:
        method_named(order.method)
    clock = SystemClock()
    if order.budget_s is not None:
        Deadline.after(clock, order.budget_s)  # refuses what is not a time
    raw = as_raw(read_image(order.raw))
    calibration = calibrated(order, raw)
    planner = Planner(order.plans)
    index, scores = sharpest(calibration, raw.pixels, planner)
    if order.sweep is not None:
        _draw_sweep(order.sweep, order, scores)
    shape = (raw.pixels.shape[0], raw.pixels.shape[1])
    reconstructor = planned(order, calibration, shape, planner, index)
    deadline = None if order.budget_s is None else Deadline.after(clock, order.budget_s)
    made = reconstructor(raw.pixels, simulated=calibration.simulated, deadline=deadline)
    picture = made.picture
    if order.even:
        picture = even_out(picture, field_mask(calibration, shape), evenness_px(calibration, shape))
    written(order.output, lambda: _write(order.output, picture, made.simulated))
    return made


def planned(
    order: Order, calibration: Calibration, shape: tuple[int, int], planner: Planner, index: int
) -> Reconstructor:
    """The solver that an order asks for, planned for its calibration and frames of a shape; `index` is the PSF's."""
    consistency = PsfConsistency(calibration, shape, index)
    recipes = _recipes(order, calibration, shape, index)
    timed = order.budget_s is not None
    return Reconstructor(
        calibration, shape, planner, SystemClock(), recipes, index, consistency=consistency, timed=timed
    )


def _refuse_places(order: Order) -> None:
    """Refuse an ending or a folder that nothing can be written to."""
    if order.output.suffix.lower() not in (".npy", ".tif", ".tiff", ".png"):
        raise SettingError(f"{order.output}: a picture is written as .npy, .tiff or .png", "Choose one of these.")
    if (order.calibration is None) == (not order.psfs):
        raise SettingError("a picture needs either PSFs or a calibration", "Give --psf FILE or --calibration DIR[:ID].")
    if order.sweep is not None and len(order.psfs) < 2:
        raise SettingError("a sweep compares several PSFs", "Give --psf more than once, or leave --sweep out.")
    for place in (order.output, order.report, order.sweep):
        if place is not None:
            refuse_place(place)


def _draw_sweep(place: Path, order: Order, scores: list[float]) -> None:
    drawn = sweep_plot.drawn(order.raw.name, [path.stem for path in order.psfs], scores)
    written(place, lambda: place.write_text(drawn, encoding="utf-8"))


def refuse_place(place: Path) -> None:
    """Refuse to write where there is a folder, or where there is none."""
    if place.is_dir() or not place.parent.is_dir():
        what = "is a folder" if place.is_dir() else "is in a folder that does not exist"
        raise SettingError(f"{place} {what}", "Give the name of a file in a folder that exists.")


def written(path: Path, write: Callable[[], object]) -> None:
    """Write a file, or say as an error of ours why that is not possible."""
    try:
        write()
    except OSError as error:
        full = StoreFull if error.errno in (errno.ENOSPC, errno.EDQUOT) else StoreError
        raise full(f"{path} cannot be written: {error.strerror or error}", "Choose another folder.") from error


def _recipes(order: Order, calibration: Calibration, shape: tuple[int, int], index: int) -> tuple[Recipe, ...]:
    """The wanted method at the resolution that the optics gives; before it, where time is short, a quick look."""
    quick, full = ladder(calibration, shape, index)
    name = order.method or full.method
    wanted = Recipe(name, 1 if name == "tikhonov" else full.bin)
    return (wanted,) if order.budget_s is None else (quick, wanted)


def calibrated(order: Order, raw: Raw) -> Calibration:
    """What an order says about the optics and the sensor; what nobody says stays unknown."""
    if order.calibration is not None:
        return _archived(order.calibration, order, raw)
    spec: InstrumentSpec | None = None if order.head is None else load_head(order.head)
    geometry: Geometry | None = None
    sensor = Sensor(white_dn=raw.white_dn)
    field_deg = order.field_deg
    if spec is not None:
        if spec.optics is None:
            raise SpecError(f"{order.head} has no [optics], so it gives no geometry")
        geometry = spec.optics.geometry(spec.camera.pitch_um)
        sensor = _sensor(spec.camera, raw)
        field_deg = field_deg if field_deg is not None else spec.optics.field_deg
    elif field_deg is not None:
        raise SettingError(
            "a field in degrees needs a head to become pixels", "Give --head HEAD.toml with --field-deg."
        )
    if field_deg is not None and not 0 < field_deg < 180:
        raise SettingError(f"a field of {field_deg:g} degrees cannot be lit", "Give --field-deg between 0 and 180.")
    dark = None if order.dark is None else _companion(order.dark, raw)
    flat = None if order.flat is None else _companion(order.flat, raw)
    psfs = tuple(read_psf(path) for path in order.psfs)
    refuse_other_sizes(psfs, (raw.pixels.shape[0], raw.pixels.shape[1]))
    simulated = says_simulated(order.raw) or (spec is not None and spec.camera.backend == "sim")
    return Calibration(
        psfs=psfs, sensor=sensor, geometry=geometry, field_deg=field_deg,
        dark_dn=dark, flat=flat, bad=raw.bad, simulated=simulated,
    )  # fmt: skip


def _sensor(camera: CameraSpec, raw: Raw) -> Sensor:
    """The head's sensor in the counts of a raw file: one of 8 bits holds the upper 8 bits of the converter."""
    dropped = 2 ** (camera.bit_depth - 8) if raw.stored_bits == 8 and camera.bit_depth > 8 else 1
    return Sensor(
        camera.black_dn / dropped, camera.gain_e_per_dn * dropped, camera.read_noise_e,
        min(camera.white_dn / dropped, raw.white_dn),
    )  # fmt: skip


def _archived(place: str, order: Order, raw: Raw) -> Calibration:
    """A kept calibration, `DIR` (the one in force) or `DIR:ID`; a dark or flat frame of the order replaces its own."""
    if order.head is not None or order.field_deg is not None:
        raise SettingError("a calibration says itself what it knows", "Leave --head and --field-deg out.")
    folder, colon, id = ("", "", "") if Path(place).is_dir() else place.rpartition(":")
    archive = Archive(Path(folder if colon else place))
    kept = archive.load(id if colon else None)
    found = kept.calibration
    refuse_other_sizes(found.psfs, (raw.pixels.shape[0], raw.pixels.shape[1]))
    known = "white_dn" not in kept.provenance.unknown
    white_dn = min(found.sensor.white_dn, raw.white_dn) if known else raw.white_dn
    return replace(
        found,
        sensor=replace(found.sensor, white_dn=white_dn),
        dark_dn=found.dark_dn if order.dark is None else _companion(order.dark, raw),
        flat=found.flat if order.flat is None else _companion(order.flat, raw),
        bad=raw.bad if found.bad is None else found.bad | raw.bad,
        simulated=found.simulated or says_simulated(order.raw),
    )


def _companion(path: Path, raw: Raw) -> Image:
    """A dark or flat frame in the counts of its raw: moved right by the same bits, colour averaged."""
    array = read_image(path)
    pixels = array.astype(np.float32) / np.float32(2**raw.shift)
    pixels = pixels.mean(axis=2) if pixels.ndim == 3 else pixels
    if pixels.shape != raw.pixels.shape[:2]:
        raise FrameError(
            f"{path} has {_size(pixels.shape)} pixels, the raw {_size(raw.pixels.shape)}",
            "Use files of one and the same camera mode.",
        )
    return np.asarray(pixels, np.float32)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[0]} x {shape[1]}"


def field_mask(calibration: Calibration, shape: tuple[int, int]) -> Image:
    """The illuminated disc on the sensor; everything where it is not known."""
    return disc(shape, ((shape[0] - 1) / 2, (shape[1] - 1) / 2), field_radius_px(calibration))


def evenness_px(calibration: Calibration, shape: tuple[int, int]) -> float:
    """How wide illumination changes: 4 degrees where the geometry is known, else an eighth of the frame."""
    return 4 * calibration.geometry.px_per_deg if calibration.geometry else min(shape) / 8


def _write(path: Path, picture: Image, simulated: bool) -> None:
    if path.suffix.lower() == ".png":
        path.write_bytes(to_png(picture, simulated))
    else:
        write_linear(path, picture)
