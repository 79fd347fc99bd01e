"""A head that plays recordings: real raw frames through the whole path, with no eye and no lamp.

The recording's folder may say what it is in `recording.toml` (a head file whose camera is `replay`); without one the
files are told apart by their names, and what cannot be told apart is refused.
"""

from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.clock import Clock
from device.errors import CameraMissing, FrameError, SpecError
from device.images import SUFFIXES, Raw, as_raw, read_image, read_psf, refuse_other_sizes, says_simulated
from device.spec import CameraSpec, InstrumentSpec, LightSpec, ReplaySpec
from device.values import Calibration, Counts, Frame, Glow, Image, Mask, Psf, Sensor, Shot

FLOAT_ZERO_DN, FLOAT_PEAK_DN = 1000.0, 60000.0  # a float recording is put on counts between these, with room outside
LONGEST_SIDE = 8192


def find_recording(folder: Path) -> ReplaySpec:
    """Which files of a folder are raws and which the PSFs, by their names and shapes.

    A path with "psf" in it is a PSF; raws have "raw", "diffuser" or "measurement" in theirs, or are the only other
    image. PSFs of another shape than the raws (thumbnails, figures) are left out.
    """
    images = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
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
    shape = read_image(raws[0]).shape[:2]
    fitting = [path for path in psfs if read_image(path).shape[:2] == shape]
    if not fitting:
        raise SpecError(f"no PSF in {folder} has the {shape[0]} x {shape[1]} pixels of {raws[0].name}")
    return ReplaySpec(raws=tuple(raws), psfs=tuple(fitting))


def recorded_head(recording: ReplaySpec, name: str) -> InstrumentSpec:
    """A head for recordings about which nothing is known but their files."""
    rows, cols = read_image(recording.raws[0]).shape[:2]
    if max(rows, cols) > LONGEST_SIDE:
        raise SpecError(f"{recording.raws[0]} has {rows} x {cols} pixels; no more than {LONGEST_SIDE} fit on a side")
    camera = CameraSpec(
        backend="replay", rows=rows, cols=cols, pitch_um=1.0, bit_depth=16, black_dn=recording.black_dn,
        full_well_e=65535, read_noise_e=0, exposure_s=0.02, preview_exposure_s=0.02,
    )  # fmt: skip
    return InstrumentSpec(name=name, camera=camera, light=LightSpec(backend="replay"), replay=recording)


class ReplayLight:
    """A lamp that exists only as a promise: recordings were lit when they were made."""

    def __init__(self) -> None:
        self.glow: Glow | None = None

    def on(self, glow: Glow) -> "ReplayLit":
        """Show the recording from the entry of the returned context to its end."""
        return ReplayLit(self, glow)

    def off(self) -> None:
        """Show its dark level."""
        self.glow = None


class ReplayLit:
    """The time in which the recorded lamp shines."""

    def __init__(self, light: ReplayLight, glow: Glow) -> None:
        self._light, self._glow = light, glow

    def __enter__(self) -> "ReplayLit":
        self._light.glow = self._glow
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._light.off()


class ReplayCamera:
    """Plays the raws of a recording in turn while the lamp is on, and its dark level while it is off."""

    def __init__(self, recording: ReplaySpec, light: ReplayLight, clock: Clock) -> None:
        self._light, self._clock = light, clock
        raws = [as_raw(read_image(path)) for path in recording.raws]
        if len({raw.pixels.shape for raw in raws}) > 1:
            raise SpecError("the raws of one recording must all have the same rows and columns")
        self._simulated = any(says_simulated(path) for path in recording.raws)
        self.white_dn = max(min(raw.white_dn, 65535.0) for raw in raws)
        self.bad: Mask = np.logical_or.reduce([raw.bad for raw in raws])
        on_counts = _scale(raws)
        self.black_dn = float(on_counts(np.array(recording.black_dn)))
        self._frames = [_counted(on_counts(raw.pixels)) for raw in raws]
        self._dark = self._constant(self.black_dn)
        if recording.dark is not None:
            self._dark = _counted(on_counts(_companion(recording.dark, raws[0])))
        self._number = self._shown = 0
        self._open = True

    def _constant(self, level_dn: float) -> Counts:
        return np.full(self._frames[0].shape, round(level_dn), np.uint16)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of every frame."""
        rows, cols = self._frames[0].shape[:2]
        return rows, cols

    def expose(self, shot: Shot, into: NDArray[np.uint16] | None = None) -> Frame:
        """The next raw of the recording if the lamp is on, else its dark frame."""
        if not self._open:
            raise CameraMissing("this recording was closed")
        if into is not None and (into.shape != self._dark.shape or into.dtype != np.uint16):
            raise FrameError(f"the buffer is {into.dtype} {into.shape}; this recording fills uint16 {self._dark.shape}")
        self._clock.sleep(shot.exposure_s)
        glow = self._light.glow
        counts = self._dark if glow is None else self._frames[self._shown % len(self._frames)]
        self._shown += glow is not None
        self._number += 1
        if into is not None:
            into[...] = counts
            counts = into
        return Frame(counts, shot.exposure_s, self._number, glow, self._simulated)

    def prepare(self, shot: Shot) -> None:
        """Nothing to do: every exposure has its own time."""

    def close(self) -> None:
        """Stop playing."""
        self._open = False


def _scale(raws: list[Raw]) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Float recordings on 16-bit counts, all by one scale, their zero at FLOAT_ZERO_DN; counts stay as they are."""
    if all(raw.pixels.dtype == np.uint16 for raw in raws):
        return lambda pixels: pixels
    top = max(float(raw.pixels.max()) for raw in raws)
    scale = (FLOAT_PEAK_DN - FLOAT_ZERO_DN) / top if top > 0 else 1.0
    return lambda pixels: pixels * scale + FLOAT_ZERO_DN


def _counted(pixels: NDArray[Any]) -> Counts:
    return np.asarray(np.clip(np.rint(pixels), 0, 65535), np.uint16)


def _companion(path: Path, raw: Raw) -> NDArray[Any]:
    """A dark frame in the units of its raw, moved by the raw's bits: a dark one alone cannot tell its justification."""
    pixels = read_image(path) / 2**raw.shift
    if pixels.ndim < raw.pixels.ndim:
        pixels = np.repeat(pixels[..., np.newaxis], 3, axis=2)
    if pixels.shape != raw.pixels.shape:
        raise SpecError(
            f"{path} has the shape {pixels.shape}, the raw {raw.pixels.shape}",
            "Use files of one and the same camera mode.",
        )
    return np.where(np.isfinite(pixels), pixels, 0)


def recorded_calibration(camera: ReplayCamera, spec: InstrumentSpec) -> Calibration:
    """The calibration that belongs to a recording: its PSFs, its pedestal, and its geometry where a head gives one."""
    assert spec.replay is not None
    psfs: tuple[Psf, ...] = tuple(read_psf(path) for path in spec.replay.psfs)
    refuse_other_sizes(psfs, camera.shape)
    flat: Image | None = None
    if spec.replay.flat is not None:
        flat = read_image(spec.replay.flat).astype(np.float32)
        flat = flat.mean(axis=2) if flat.ndim == 3 else flat
    geometry = spec.optics.geometry(spec.camera.pitch_um) if spec.optics else None
    return Calibration(
        psfs=psfs, sensor=Sensor(black_dn=camera.black_dn, white_dn=camera.white_dn), geometry=geometry,
        field_deg=spec.optics.field_deg if spec.optics else None, flat=flat, bad=camera.bad,
    )  # fmt: skip
