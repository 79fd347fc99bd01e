"""Replay of recordings: camera and lamp that return recorded raw frames, with no eye and no hardware.

The folder of a recording may contain `recording.toml` (a head file whose camera is `replay`). Without it, raws and PSFs
are recognised by file names; SpecError if that does not find both.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.clock import Clock
from device.config.bayer import looks_like_mosaic
from device.config.head_file import CameraSpec, InstrumentSpec, LightSpec, ReplaySpec
from device.config.image_files import (
    SUFFIXES,
    Raw,
    as_companion,
    as_raw,
    common_white_dn,
    read_counts,
    read_psf,
    require_same_shape,
)
from device.config.marked_files import is_marked_simulated
from device.errors import CameraMissing, FrameError, SpecError
from device.optics.lit_angle import picture_field_deg, soft_edge_deg
from device.sim.light import LampContext
from device.user_files import files_in
from device.values import Calibration, Counts, ExposureSettings, Frame, Illumination, Image, Mask, Psf, Sensor

FLOAT_ZERO_DN, FLOAT_PEAK_DN = 1000.0, 60000.0  # counts for zero and maximum of a float recording, with margins
MAX_SIDE_PX = 8192


def find_recording(folder: Path) -> ReplaySpec:
    """Return the raws and PSFs of a folder by file names and shapes; SpecError if either is missing.

    An image whose path below the folder contains "psf" is a PSF; raws contain "raw", "diffuser" or "measurement", or
    are the only other image. PSFs of another shape than the first raw (thumbnails) and files that hold no counts
    (figures with transparency) are left out; SpecError if none remains.
    """
    images = [path for path in files_in(folder, "**/*") if path.suffix.lower() in SUFFIXES]
    names = {path: str(path.relative_to(folder)).lower() for path in images}
    psfs = [path for path in images if "psf" in names[path]]
    others = [path for path in images if path not in psfs]
    raws = [path for path in others if any(word in names[path] for word in ("raw", "diffuser", "measurement"))]
    raws = raws or (others if len(others) == 1 else [])
    if not raws or not psfs:
        raise SpecError(
            f"{folder} holds {len(raws)} files that are raws and {len(psfs)} that are PSFs by their names",
            "Add a recording.toml that names them, or give them with --raw and --psf.",
        )
    shape = read_counts(raws[0]).shape[:2]
    fitting = []
    unreadable = []
    for path in psfs:
        try:
            fitting += [path] if read_counts(path).shape[:2] == shape else []
        except FrameError as error:  # a figure, whose pixels are no counts
            unreadable.append(error.message)
    if not fitting:
        none = f"no PSF in {folder} has the {shape[0]} x {shape[1]} pixels of {raws[0].name}"
        raise SpecError("; ".join([none, *unreadable]))
    return ReplaySpec(raws=tuple(raws), psfs=tuple(fitting))


def recorded_head(recording: ReplaySpec, name: str) -> InstrumentSpec:
    """Return the specification of a head for a recording without `recording.toml`; SpecError beyond 8192 px a side."""
    rows, cols = read_counts(recording.raws[0]).shape[:2]
    if max(rows, cols) > MAX_SIDE_PX:
        raise SpecError(f"{recording.raws[0]} has {rows} x {cols} pixels; no more than {MAX_SIDE_PX} fit on a side")
    camera = CameraSpec(
        backend="replay",
        rows=rows,
        cols=cols,
        pitch_um=1.0,
        bit_depth=16,
        black_dn=recording.black_dn,
        full_well_e=65535,
        read_noise_e=0,
        exposure_s=0.02,
        preview_exposure_s=0.02,
    )
    return InstrumentSpec(name=name, camera=camera, light=LightSpec(backend="replay"), replay=recording)


class ReplayLight:
    """Lamp of a recording, which emits no light: while on, the camera returns the raws, while off the dark frame."""

    def __init__(self) -> None:
        self.illumination: Illumination | None = None

    def on(self, illumination: Illumination) -> LampContext:
        """Return a context during which the camera returns the recorded raws."""

        def turn_on() -> None:
            self.illumination = illumination

        return LampContext(turn_on, self.off)

    def off(self) -> None:
        """Select the dark frame."""
        self.illumination = None


class ReplayCamera:
    """Camera that returns the raws of a recording in turn while the lamp is on, else its dark frame."""

    def __init__(self, recording: ReplaySpec, light: ReplayLight, clock: Clock) -> None:
        self._light, self._clock = light, clock
        raws = [as_raw(read_counts(path)) for path in recording.raws]
        if len({raw.pixels.shape for raw in raws}) > 1:
            raise SpecError("the raws of one recording must all have the same rows and columns")
        for path, raw in zip(recording.raws, raws, strict=True):
            if looks_like_mosaic(raw.pixels):
                raise SpecError(
                    f"{path} is a mosaic of colour filters, so its counts are not grey",
                    "Reconstruct it with diffuscope reconstruct and --bayer, such as --bayer rggb.",
                )
        self._simulated = any(is_marked_simulated(path) for path in recording.raws)
        self.bad: Mask = np.logical_or.reduce([raw.bad for raw in raws])
        on_counts = _scale(raws)
        self.white_dn = min(float(np.rint(on_counts(np.array(common_white_dn(raws))))), 65535.0)
        self.black_dn = float(on_counts(np.array(recording.black_dn)))
        self._frames = [_to_counts(on_counts(raw.pixels)) for raw in raws]
        self._dark = self._constant(self.black_dn)
        if recording.dark is not None:
            self._dark = _to_counts(on_counts(_dark_in_raw_units(recording.dark, raws[0])))
        self._number = self._shown = 0
        self._open = True

    def _constant(self, level_dn: float) -> Counts:
        """Return uint16 counts of one level on every pixel, in the shape of the raws."""
        return np.full(self._frames[0].shape, round(level_dn), np.uint16)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of every frame, without the channels of a colour recording."""
        rows, cols = self._frames[0].shape[:2]
        return rows, cols

    @property
    def facts(self) -> dict[str, str]:
        """Empty: a recording has no sensor."""
        return {}

    def expose(self, shot: ExposureSettings, into: NDArray[np.uint16] | None = None) -> Frame:
        """Return the next raw if the lamp is on, else the dark frame; CameraMissing, or FrameError for a bad `into`."""
        if not self._open:
            raise CameraMissing("this recording was closed")
        if into is not None and (into.shape != self._dark.shape or into.dtype != np.uint16):
            raise FrameError(f"the buffer is {into.dtype} {into.shape}; this recording fills uint16 {self._dark.shape}")
        self._clock.sleep(shot.exposure_s)
        illumination = self._light.illumination
        counts = self._dark if illumination is None else self._frames[self._shown % len(self._frames)]
        self._shown += illumination is not None
        self._number += 1
        if into is not None:
            into[...] = counts
            counts = into
        return Frame(counts, shot.exposure_s, self._number, illumination, self._simulated)

    def prepare(self, shot: ExposureSettings) -> None:
        """Do nothing: recorded frames do not depend on the exposure time."""

    def close(self) -> None:
        """Close the recording; further exposures raise CameraMissing."""
        self._open = False


def _scale(raws: list[Raw]) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return the function from pixels to counts: identity if all raws are uint16, else one linear scale to 16 bits."""
    if all(raw.pixels.dtype == np.uint16 for raw in raws):
        return lambda pixels: pixels
    top = max(float(raw.pixels.max()) for raw in raws)
    scale = (FLOAT_PEAK_DN - FLOAT_ZERO_DN) / top if top > 0 else 1.0
    return lambda pixels: pixels * scale + FLOAT_ZERO_DN


def _to_counts(pixels: NDArray[Any]) -> Counts:
    """Round and clip to uint16 counts."""
    return np.asarray(np.clip(np.rint(pixels), 0, 65535), np.uint16)


def _dark_in_raw_units(path: Path, raw: Raw) -> NDArray[Any]:
    """Return the dark frame of a file in the units of its raw; SpecError if the shapes differ.

    It is shifted by the raw's bits, because dark counts do not reveal whether they are left-justified. NaN becomes 0.
    """
    pixels = read_counts(path) / 2**raw.shift
    if pixels.ndim < raw.pixels.ndim:
        pixels = np.repeat(pixels[..., np.newaxis], 3, axis=2)
    if pixels.shape != raw.pixels.shape:
        raise SpecError(
            f"{path} has the shape {pixels.shape}, the raw {raw.pixels.shape}",
            "Use files of one and the same camera mode.",
        )
    return np.where(np.isfinite(pixels), pixels, 0)


def recorded_calibration(camera: ReplayCamera, spec: InstrumentSpec) -> Calibration:
    """Return a recording's calibration: PSFs, levels, flat frame, bad pixels, geometry; PsfError for another shape."""
    assert spec.replay is not None
    psfs: tuple[Psf, ...] = tuple(read_psf(path) for path in spec.replay.psfs)
    require_same_shape(psfs, camera.shape)
    flat: Image | None = None
    if spec.replay.flat is not None:
        flat = as_companion(read_counts(spec.replay.flat), spec.replay.flat.name)
        flat = flat.mean(axis=2) if flat.ndim == 3 else flat
    geometry = spec.optics.geometry(spec.camera.pitch_um) if spec.optics else None
    return Calibration(
        psfs=psfs,
        sensor=Sensor(black_dn=camera.black_dn, white_dn=camera.white_dn),
        geometry=geometry,
        field_deg=picture_field_deg(spec),
        soft_edge_deg=soft_edge_deg(spec),
        flat=flat,
        bad=camera.bad,
    )
