"""Inputs of a reconstruction, as files or arrays: the raw frame, its PSFs, and the calibration of each channel."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.calibration.archive import Archive
from device.calibration.import_psf import MAX_SATURATED_SHARE
from device.config import bayer
from device.config.bayer import Bayer, BayerOption
from device.config.ceiling import CHANCE_PIXELS
from device.config.head_file import CameraSpec, InstrumentSpec, load_head
from device.config.image_files import (
    ImageFile,
    Raw,
    as_companion,
    as_raw,
    clean_channels,
    frames_of,
    only_frame,
    psf_counts,
    read_counts_file,
    require_raw_shape,
    require_same_shape,
    saturated_share,
    with_levels,
)
from device.config.marked_files import is_marked_simulated
from device.errors import FrameError, PsfError, SettingError, SpecError
from device.optics.lit_angle import picture_field_deg, soft_edge_deg
from device.recon.estimation.defective_pixels import without_hot_pixels
from device.recon.method_settings import Settings
from device.recon.model.kernels import Pixels
from device.recon.model.preprocessing import MAX_BAD
from device.values import Calibration, Colour, Geometry, Image, Psf, Sensor, SimulatedCounts
from services.imaging.picture_files import read_raw_tiff
from services.imaging.raw_metadata import RawMetadata
from services.research.psf_notes import STENCIL, background_notes, damage_notes
from services.research.raw_notes import bits_note, raw_notes

Source = Path | NDArray[Any]  # a file, or an array in one of the layouts of device/config/image_files.py
RawSource = Source | Raw  # or counts that are read
Shape = tuple[int, int]
MAX_EQUAL = 0.9  # share of a raw's pixels that may have its maximum: with more, the others are too few to show noise
SWAPPED = 1.1  # ratio of `concentration`, raw over PSF: recordings have 0.56 to 0.85, swapped 1.18 to 1.80


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """Options of a reconstruction of any raws; `plans` is the folder of cached FFT plans (None: not cached).

    Images are paths or arrays, `head` a file or what it holds. `even`: flat-field correction of the picture. `sweep`:
    file of the sweep plot. `calibration`: DIR[:ID] of an archived one, instead of `psfs`. `bin`, `rounds` and
    `settings` (of the method, see device/recon/method_settings.py) replace what is chosen from PSF and frame. `bayer`:
    the raw is a mosaic of this pattern, or "none". `field_fixed`: the field is known exactly, and the refraction does
    not estimate its edge. `refraction` False leaves the refraction out. `gamma`: exponent that makes the counts of raw,
    dark and flat frame linear in the light.
    """

    psfs: tuple[Source, ...] = ()
    method: str | None = None
    budget_s: float | None = None
    dark: Source | None = None
    flat: Source | None = None
    head: Path | InstrumentSpec | None = None
    field_deg: float | None = None
    even: bool = False
    plans: Path | None = None
    sweep: Path | None = None
    calibration: str | None = None
    bin: int | None = None
    rounds: int | None = None
    settings: Settings = field(default_factory=dict)
    bayer: BayerOption | None = None
    field_fixed: bool = False
    refraction: bool = True
    gamma: float | None = None


@dataclass(frozen=True)
class LoadedRaw:
    """A raw frame as it is solved: of a mosaic, the colour planes of half the rows and columns.

    `shape` is (rows, cols) of the file, `bayer` the pattern of a mosaic, `black_dn` the black level that the file
    states, `light` the colour for which the PSFs of an archived calibration are chosen (None: all are used). `notes`
    are sentences for the user. `gamma` is the exponent by which its counts were made linear; `is_encoded` True for
    counts that show a gamma or the blocks of a JPEG.
    """

    raw: Raw
    name: str
    shape: Shape
    bayer: Bayer | None = None
    black_dn: float | None = None
    simulated: bool = False
    notes: tuple[str, ...] = ()
    light: Colour | None = None
    gamma: float | None = None
    is_encoded: bool = False

    @property
    def label(self) -> str:
        """Name for sentences of a report: that of the file without its folders, which others may read."""
        return Path(self.name).name

    @property
    def solved_shape(self) -> Shape:
        """(rows, cols) of `raw`."""
        rows, cols = self.raw.pixels.shape[:2]
        return rows, cols

    @property
    def channels(self) -> int:
        """Number of channels of `raw`: 1 or 3."""
        return 1 if self.raw.pixels.ndim == 2 else 3


@dataclass(frozen=True)
class LoadedPsfs:
    """The PSFs of a frame: one stack for all channels, or one for each of three; all stacks have the same length.

    `damage` are sentences about PSFs with which neither the refraction nor figures of the spectrum can be measured,
    `notes` other sentences.
    """

    stacks: tuple[tuple[Psf, ...], ...]
    notes: tuple[str, ...]
    damage: tuple[str, ...] = ()


def name_of(source: RawSource, name: str) -> str:
    """Return the path of a file, or `name` for an array."""
    return str(source) if isinstance(source, Path) else name


def is_simulated(source: RawSource) -> bool:
    """Return True for counts of the simulator: a file with its mark, or an array of its type."""
    if isinstance(source, Path):
        return is_marked_simulated(source)
    return isinstance(source.pixels if isinstance(source, Raw) else source, SimulatedCounts)


def stated_by(raw: RawSource) -> RawMetadata | None:
    """Return what a raw frame of the instrument states about itself; None for another file, or an array."""
    if not isinstance(raw, Path) or raw.suffix.lower() not in (".tif", ".tiff"):
        return None
    try:
        return read_raw_tiff(raw.read_bytes())[1]
    except (FrameError, OSError):
        return None


def stated_light(raw: RawSource) -> Colour | None:
    """Return the colour of light in which a raw frame states to have been taken; None if it states none."""
    stated = stated_by(raw)
    return None if stated is None or stated.illumination is None else stated.illumination.colour


def load_raw(
    source: RawSource, pattern: BayerOption | None = None, checked: bool = True, gamma: float | None = None
) -> LoadedRaw:
    """Return the raw frame of a file or array; FrameError for one that cannot be read or, if `checked`, be solved.

    `pattern` None: the pattern that a DNG states, if its pixels are those of a mosaic; else no mosaic. `gamma`: the
    exponent that makes its counts linear in the light.
    """
    name = name_of(source, "the raw")
    file = _read(source, name)
    read = source if isinstance(source, Raw) else as_raw(only_frame(file.frames, name), name)
    raw, black_dn = with_levels(read, file.levels)
    if checked:
        refuse_without_signal(raw, name)
    encoded = raw_notes(raw, Path(name).name, is_linear=gamma is not None)
    if gamma is not None:
        raw = replace(raw, pixels=linear(raw.pixels, _full_dn(raw), gamma))
    rows, cols = raw.pixels.shape[:2]
    pattern, notes = bayer.pattern_of(raw.pixels, pattern, file.levels.bayer, black_dn or 0.0, Path(name).name)
    if pattern is not None:
        planes = bayer.split(raw.pixels, pattern, raw.white_dn)
        raw = replace(raw, pixels=planes, bad=bayer.any_site(raw.bad))
    simulated = is_simulated(source)
    notes = (*encoded, *notes)
    return LoadedRaw(
        raw, name, (rows, cols), pattern, black_dn, simulated, notes, gamma=gamma, is_encoded=bool(encoded)
    )


def linear(counts: NDArray[Any], full_dn: float, gamma: float) -> Image:
    """Return counts y as full_dn (y / full_dn)^gamma, float32 of the same shape: linear in the light, the same end."""
    return np.asarray(full_dn * (np.maximum(counts, 0) / full_dn) ** gamma, np.float32)


def _full_dn(raw: Raw) -> float:
    return raw.white_dn if np.isfinite(raw.white_dn) else float(raw.pixels.max())


def _read(source: RawSource, name: str) -> ImageFile:
    if isinstance(source, Path):
        return read_counts_file(source)
    return ImageFile(frames_of(np.asarray(source.pixels if isinstance(source, Raw) else source), name))


def refuse_without_signal(raw: Raw, name: str) -> None:
    """Raise FrameError for a frame without usable values, with too many saturated pixels, or with equal values only."""
    unusable = float(raw.bad.mean())
    if unusable > MAX_BAD:
        raise FrameError(
            f"{name}: {unusable:.0%} of the frame cannot be used, because its values are not numbers",
            "Save the frame again without NaN or infinite values.",
        )
    pixels = raw.pixels if raw.pixels.ndim == 2 else raw.pixels.max(axis=2)
    saturated = float((pixels >= raw.white_dn).mean())
    equal = float((pixels == pixels.max()).mean())
    if saturated > MAX_BAD or MAX_EQUAL < equal < 1:
        raise FrameError(
            f"{name} is saturated: {max(saturated, equal):.0%} of its pixels have the highest value, {pixels.max():g}",
            "Take the frame with a shorter exposure.",
        )
    seen = raw.pixels[~raw.bad]
    if seen.min() == seen.max():
        raise FrameError(
            f"{name} holds no signal: every pixel has the value {seen.min():g}",
            "Take the frame with light, or give the file that holds it.",
        )


def load_psfs(options: ReconstructOptions, loaded: LoadedRaw, per_channel: bool = True) -> LoadedPsfs:
    """Return the PSFs of the options for a raw: a stack per channel if the raw and a PSF have three channels.

    A colour PSF of a grey raw, or without `per_channel`, is averaged, with a note. PsfError for a file that is no PSF,
    or for another shape than the raw.
    """
    counts: list[tuple[Raw, str]] = []
    for number, source in enumerate(options.psfs):
        counts += _psf_frames(source, f"PSF {number}" if len(options.psfs) > 1 else "the PSF")
    if loaded.bayer is not None:
        counts = [(_split_psf(raw, name, loaded, loaded.bayer), name) for raw, name in counts]
    for raw, name in counts:
        require_raw_shape(name, (raw.pixels.shape[0], raw.pixels.shape[1]), loaded.solved_shape)
    cleaned = [tuple(map(without_hot_pixels, clean_channels(raw, name))) for raw, name in counts]
    damage = _saturation_notes(counts, cleaned)
    notes: tuple[str, ...] = ()
    for (raw, name), psfs in zip(counts, cleaned, strict=True):
        notes += background_notes(raw, name)
        damage += damage_notes(raw, _averaged(psfs))
    colour = any(len(psfs) == 3 for psfs in cleaned)
    if colour and not (per_channel and loaded.channels == 3):
        names = ", ".join(name for (_, name), psfs in zip(counts, cleaned, strict=True) if len(psfs) == 3)
        notes += (
            f"{names}: the three channels of the PSF were averaged, because the raw is solved as one channel. "
            "Give a PSF of one channel if only that one fits.",
        )
        averaged = tuple(_averaged(psfs) for psfs in cleaned)
        return LoadedPsfs((averaged,), notes, damage)
    if not colour:
        return LoadedPsfs((tuple(psf for psfs in cleaned for psf in psfs),), notes, damage)
    return LoadedPsfs(tuple(tuple(psfs[c % len(psfs)] for psfs in cleaned) for c in range(3)), notes, damage)


def swap_notes(loaded: LoadedRaw, psfs: LoadedPsfs) -> tuple[str, ...]:
    """Return a note if raw and PSF seem to be swapped: the light of the raw is more concentrated than the PSF's.

    A raw is the PSF blurred by the object. Without pedestal and noise its rms over its mean cannot exceed that of the
    PSF (Young's inequality for convolutions); SWAPPED leaves a margin for a cropped frame.
    """
    pixels = loaded.raw.pixels if loaded.channels == 1 else loaded.raw.pixels.mean(axis=2)
    psf = psfs.stacks[0][0].pixels
    if concentration(pixels) <= SWAPPED * max(concentration(psf), _concentration_in_noise(psf)):
        return ()
    return (
        f"{loaded.label} looks like a PSF and {psfs.stacks[0][0].name} like a raw frame: they seem to be swapped. "
        "Give the raw first and the PSF with --psf.",
    )


def concentration(image: NDArray[Any]) -> float:
    """Return the rms over the mean of the light in blocks of n x n pixels above its first percentile; 1 if even.

    n is 4, or 1 for an image with less than 64 rows or columns; the blocks average the noise.
    """
    blocks, _ = _block_means(image)
    light = np.maximum(blocks - np.quantile(blocks, 0.01), 0)
    return float(np.sqrt((light**2).mean()) / max(light.mean(), 1e-30))


def _concentration_in_noise(psf: NDArray[Any]) -> float:
    """Return the `concentration` of a PSF without pedestal, of whose rms the noise is taken."""
    blocks, pixels = _block_means(psf)
    noise = float((ndimage.convolve(psf, STENCIL) ** 2).mean()) / pixels
    return float(np.sqrt(max((blocks**2).mean() - noise, 0.0)) / max(blocks.mean(), 1e-30))


def _block_means(image: NDArray[Any]) -> tuple[NDArray[np.float64], int]:
    """Return the means of the blocks of `concentration`, and the pixels of a block."""
    n = 4 if min(image.shape) >= 64 else 1
    rows, cols = (size // n for size in image.shape)
    return image[: rows * n, : cols * n].reshape(rows, n, cols, n).mean(axis=(1, 3), dtype=np.float64), n**2


def _psf_frames(source: Source, name: str) -> list[tuple[Raw, str]]:
    """Return counts and name of each PSF of a file or array; PsfError for one that is no PSF."""
    label = source.name if isinstance(source, Path) else name
    try:
        file = _read(source, name)
    except FrameError as error:
        raise PsfError(error.message, error.remedy) from error
    count = len(file.frames)
    names = [label] if count == 1 else [f"{label}[{index}]" for index in range(count)]
    counts = (psf_counts(frame, psf_name) for frame, psf_name in zip(file.frames, names, strict=True))
    return [(with_levels(raw, file.levels)[0], psf_name) for raw, psf_name in zip(counts, names, strict=True)]


def _split_psf(psf: Raw, name: str, loaded: LoadedRaw, pattern: Bayer) -> Raw:
    """Return the colour planes of a PSF of the mosaic's shape; one of half the shape is returned as it is."""
    rows, cols = psf.pixels.shape[:2]
    if (rows, cols) == loaded.solved_shape:
        return psf
    if (rows, cols) != loaded.shape:
        raise PsfError(
            f"{name} has {rows} x {cols} pixels, the mosaic {loaded.shape[0]} x {loaded.shape[1]}",
            "Give the PSF that was measured in the same camera mode as the raw.",
        )
    pixels = psf.pixels if psf.pixels.ndim == 2 else bayer.mosaic_of(psf.pixels, pattern)
    return replace(psf, pixels=bayer.split(pixels, pattern, psf.white_dn), bad=bayer.any_site(psf.bad))


def _averaged(psfs: tuple[Psf, ...]) -> Psf:
    if len(psfs) == 1:
        return psfs[0]
    return Psf(np.mean([psf.pixels for psf in psfs], axis=0, dtype=np.float32), psfs[0].name)


def _saturation_notes(counts: list[tuple[Raw, str]], cleaned: list[tuple[Psf, ...]]) -> tuple[str, ...]:
    notes = []
    for (raw, name), psfs in zip(counts, cleaned, strict=True):
        share = saturated_share(_averaged(psfs), raw)
        if share > MAX_SATURATED_SHARE:
            notes.append(
                f"{name} is saturated: {share:.0%} of its light is in pixels at their highest value. "
                "Measure it again with a shorter exposure."
            )
    return tuple(notes)


def load_calibration(options: ReconstructOptions, loaded: LoadedRaw) -> Calibration:
    """Return one calibration for all channels of a raw: the archived one, or one from the files of the options.

    The channels of a colour PSF are averaged. Values that are not given stay unknown. SettingError for an invalid
    field, SpecError for a head without optics.
    """
    psfs = None if options.calibration is not None else load_psfs(options, loaded, per_channel=False)
    return load_calibrations(options, loaded, psfs)[0]


def load_calibrations(
    options: ReconstructOptions, loaded: LoadedRaw, psfs: LoadedPsfs | None
) -> tuple[Calibration, ...]:
    """Return the calibration of each channel, or one for all channels; `psfs` None: the archived calibration.

    The calibrations of a mosaic are those of its planes: twice the pitch, and for the mean of two greens twice the
    gain. SettingError for an invalid field, SpecError for a head without optics.
    """
    if psfs is None:
        return (_archived(options.calibration or "", options, loaded),)
    raw = loaded.raw
    spec = load_head(options.head) if isinstance(options.head, Path) else options.head
    geometry, field_deg = _geometry(options, spec, loaded.bayer is not None)
    black_dn = loaded.black_dn or 0.0
    sensor = Sensor(black_dn, white_dn=raw.white_dn) if spec is None else _sensor(spec.camera, raw)
    dark = None if options.dark is None else companion(options.dark, "the dark frame", loaded)
    flat = None if options.flat is None else companion(options.flat, "the flat frame", loaded, above_black=True)
    simulated = loaded.simulated or (spec is not None and spec.camera.backend == "sim")
    return tuple(
        Calibration(
            psfs=stack,
            sensor=_of_mean_green(sensor) if loaded.bayer is not None and c == 1 else sensor,
            geometry=geometry,
            field_deg=field_deg,
            dark_dn=_plane(dark, c),
            flat=_plane(flat, c),
            bad=raw.bad,
            simulated=simulated,
            soft_edge_deg=None if spec is None or options.field_deg is not None else soft_edge_deg(spec),
        )
        for c, stack in enumerate(psfs.stacks if loaded.bayer is None else _for_three(psfs.stacks))
    )


def _for_three(stacks: tuple[tuple[Psf, ...], ...]) -> tuple[tuple[Psf, ...], ...]:
    """Return a stack for each of three channels."""
    return stacks if len(stacks) == 3 else stacks * 3


def _of_mean_green(sensor: Sensor) -> Sensor:
    """Return the sensor whose counts are the mean of two pixels: twice the electrons per count."""
    gain = sensor.gain_e_per_dn
    noise = sensor.read_noise_e
    return replace(
        sensor, gain_e_per_dn=None if gain is None else 2 * gain, read_noise_e=None if noise is None else noise * 2**0.5
    )


def _geometry(
    options: ReconstructOptions, spec: InstrumentSpec | None, is_mosaic: bool
) -> tuple[Geometry | None, float | None]:
    """Return geometry and field of the options; a plane of a mosaic has twice the pitch."""
    field_deg = options.field_deg
    geometry: Geometry | None = None
    if spec is not None:
        if spec.optics is None:
            raise SpecError(f"{spec.name} has no [optics], so it gives no geometry")
        geometry = spec.optics.geometry(spec.camera.pitch_um * (2 if is_mosaic else 1))
        field_deg = field_deg if field_deg is not None else picture_field_deg(spec)
    elif field_deg is not None:
        raise SettingError(
            "a field in degrees needs a head to become pixels", "Give --head HEAD.toml with --field-deg."
        )
    if field_deg is not None and not 0 < field_deg < 180:
        raise SettingError(f"a field of {field_deg:g} degrees cannot be lit", "Give --field-deg between 0 and 180.")
    return geometry, field_deg


def _sensor(camera: CameraSpec, raw: Raw) -> Sensor:
    """Return the head's sensor in the counts of a raw file; an 8-bit file holds the upper 8 bits of the converter."""
    dropped = 2 ** (camera.bit_depth - 8) if raw.stored_bits == 8 and camera.bit_depth > 8 else 1
    return Sensor(
        camera.black_dn / dropped,
        camera.gain_e_per_dn * dropped,
        camera.read_noise_e,
        min(camera.white_dn / dropped, raw.white_dn),
    )


def _archived(place: str, options: ReconstructOptions, loaded: LoadedRaw) -> Calibration:
    """Return an archived calibration, `DIR` (the active one) or `DIR:ID`; SettingError if a head or field is given.

    Dark and flat frame of the options replace those of the calibration.
    """
    if options.head is not None or options.field_deg is not None:
        raise SettingError("a calibration says itself what it knows", "Leave --head and --field-deg out.")
    if loaded.bayer is not None:
        raise SettingError("a kept calibration has no PSFs of a colour mosaic", "Give the PSF of the mosaic: --psf.")
    folder, colon, id = ("", "", "") if Path(place).is_dir() else place.rpartition(":")
    archive = Archive(Path(folder if colon else place))
    kept = archive.load(id if colon else None)
    found = kept.calibration
    raw = loaded.raw
    found = in_light(found, loaded.light, loaded.name)
    require_same_shape(found.psfs, loaded.solved_shape)
    known = "white_dn" not in kept.provenance.unknown
    white_dn = min(found.sensor.white_dn, raw.white_dn) if known else raw.white_dn
    dark = None if options.dark is None else companion(options.dark, "the dark frame", loaded)
    flat = None if options.flat is None else companion(options.flat, "the flat frame", loaded, above_black=True)
    return replace(
        found,
        sensor=replace(found.sensor, white_dn=white_dn),
        dark_dn=found.dark_dn if dark is None else dark,
        flat=found.flat if flat is None else flat,
        bad=raw.bad if found.bad is None else found.bad | raw.bad,
        simulated=found.simulated or loaded.simulated,
    )


def in_light(calibration: Calibration, light: Colour | None, name: str) -> Calibration:
    """Return the calibration with the PSFs for a raw in this light, all of them for None; SettingError without any."""
    if light is None:
        return calibration
    if {light, None}.isdisjoint(psf.colour for psf in calibration.psfs):
        raise SettingError(
            f"{name} was taken in {light} light, and the calibration has no PSF for it",
            "Choose a calibration with a PSF in this light, or give its PSF: --psf FILE.",
        )
    return calibration.for_colour(light)


def companion(source: Source, what: str, loaded: LoadedRaw, above_black: bool = False) -> Image:
    """Return a dark or flat frame in the counts of its raw frame, divided by `2**raw.shift`; NaN where it is saturated.

    (rows, cols), with colours averaged; of a mosaic the planes, (rows, cols, 3). `above_black`: the black level that
    its file states is subtracted. FrameError for one that is saturated in more than MAX_BAD of its pixels, or has
    another shape.
    """
    name = name_of(source, what)
    file = _read(source, name)
    pixels = as_companion(only_frame(file.frames, name), name)
    if above_black:
        pixels = pixels - np.float32(file.levels.black_dn or 0)
    pixels = pixels / np.float32(2**loaded.raw.shift)
    if loaded.gamma is not None:
        pixels = linear(pixels, _full_dn(loaded.raw), loaded.gamma)
    pixels = pixels.mean(axis=2) if pixels.ndim == 3 else pixels
    if pixels.shape != loaded.shape:
        raise FrameError(
            f"{name} has {pixels.shape[0]} x {pixels.shape[1]} pixels, the raw {loaded.shape[0]} x {loaded.shape[1]}",
            "Use files of one and the same camera mode.",
        )
    saturated = float(np.isnan(pixels).mean())
    if saturated > MAX_BAD:
        raise FrameError(
            f"{name} is saturated: {saturated:.0%} of its pixels have the highest value",
            "Take it with a shorter exposure.",
        )
    return bayer.split(pixels, loaded.bayer) if loaded.bayer is not None else np.asarray(pixels, np.float32)


def companion_notes(options: ReconstructOptions, calibration: Calibration) -> tuple[str, ...]:
    """Return a note for a dark or flat frame of the options that is saturated in more than CHANCE_PIXELS pixels."""
    given = ("dark", options.dark, calibration.dark_dn), ("flat", options.flat, calibration.flat)
    return tuple(
        f"the {name} frame is saturated in {np.isnan(image).mean():.1%} of its pixels; these were left out. "
        "Take it with a shorter exposure."
        for name, source, image in given
        if source is not None and image is not None and np.count_nonzero(np.isnan(image)) > CHANCE_PIXELS
    )


def head_notes(options: ReconstructOptions, loaded: LoadedRaw) -> tuple[str, ...]:
    """Return a note on a raw that has fewer bits than the converter of its head."""
    if options.head is None or loaded.gamma is not None:
        return ()
    spec = load_head(options.head) if isinstance(options.head, Path) else options.head
    return bits_note(loaded.raw, loaded.label, spec.camera.bit_depth)


def without_unknown(pixels: Pixels, dark: Image | None) -> tuple[Pixels, Image | None]:
    """Return a frame with NaN where its dark frame is unknown (NaN), and that dark frame without NaN.

    A dark frame (rows, cols) holds for all channels of the frame.
    """
    if dark is None or not np.isnan(dark).any():
        return pixels, dark
    unknown = np.isnan(dark if dark.ndim == pixels.ndim else dark[..., None])
    return np.where(unknown, np.float32(np.nan), pixels.astype(np.float32)), np.nan_to_num(dark)


def _plane(image: Image | None, c: int) -> Image | None:
    return image if image is None or image.ndim == 2 else np.ascontiguousarray(image[..., c])
