"""A head that plays recordings: real raw frames through the whole path, with no eye and no lamp.

The recording's folder may say what it is in `recording.toml` (a head file whose camera is `replay`); without one the
files are told apart by their names, and what cannot be told apart is refused.
"""

from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from device.clock import Clock
from device.errors import CameraMissing, SpecError
from device.images import SUFFIXES, Raw, as_raw, read_image, read_psf
from device.spec import CameraSpec, InstrumentSpec, LightSpec, ReplaySpec
from device.values import Calibration, Counts, Frame, Glow, Image, Mask, Psf, Sensor, Shot

FLOAT_PEAK_DN = 60000  # a float recording is put on counts up to here: 16 bits, and room above


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
        self.black_dn, self._frames = _on_counts(raws, recording.black_dn)
        if len({frame.shape for frame in self._frames}) > 1:
            raise SpecError("the raws of one recording must all have the same rows and columns")
        self.white_dn = max(min(raw.white_dn, 65535.0) for raw in raws)
        self.bad: Mask = np.logical_or.reduce([raw.bad for raw in raws])
        dark = None if recording.dark is None else as_raw(read_image(recording.dark)).pixels.astype(np.uint16)
        self._dark: Counts = dark if dark is not None else self._constant(self.black_dn)
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
        self._clock.sleep(shot.exposure_s)
        glow = self._light.glow
        counts = self._dark if glow is None else self._frames[self._shown % len(self._frames)]
        self._shown += glow is not None
        self._number += 1
        if into is not None:
            into[...] = counts
            counts = into
        return Frame(counts, shot.exposure_s, self._number, glow, simulated=False)

    def close(self) -> None:
        """Stop playing."""
        self._open = False


def _on_counts(raws: list[Raw], black_dn: float) -> tuple[float, list[Counts]]:
    """Float recordings on 16-bit counts, all by one scale, their zero at 1000 DN; counts stay as they are."""
    if all(raw.pixels.dtype == np.uint16 for raw in raws):
        return black_dn, [raw.pixels.astype(np.uint16) for raw in raws]
    zero_dn = 1000.0
    top = max(float(raw.pixels.max()) for raw in raws)
    scale = (FLOAT_PEAK_DN - zero_dn) / top if top > 0 else 1.0
    counts = [np.clip(np.rint(raw.pixels * scale + zero_dn), 0, 65535).astype(np.uint16) for raw in raws]
    return zero_dn + black_dn * scale, counts


def recorded_calibration(camera: ReplayCamera, spec: InstrumentSpec) -> Calibration:
    """The calibration that belongs to a recording: its PSFs, its pedestal, and its geometry where a head gives one."""
    assert spec.replay is not None
    psfs: tuple[Psf, ...] = tuple(read_psf(path) for path in spec.replay.psfs)
    flat: Image | None = None
    if spec.replay.flat is not None:
        flat = read_image(spec.replay.flat).astype(np.float32)
    geometry = spec.optics.geometry(spec.camera.pitch_um) if spec.optics else None
    return Calibration(
        psfs=psfs, sensor=Sensor(black_dn=camera.black_dn, white_dn=camera.white_dn), geometry=geometry,
        field_deg=spec.optics.field_deg if spec.optics else None, flat=flat, bad=camera.bad,
    )  # fmt: skip
