"""Burst: several frames of one moving retina, joined to one frame of more light before the deconvolution.

The illuminated field and its shading stand still on the sensor while the retina moves. Of each frame a smooth picture,
blurred by the PSF, is therefore subtracted; the residuals are moved back by the registered shift and averaged with
weights in proportion to their light, and the smooth part of the reference is added. NUMERICS.md 9 has the derivation
and the figures: N frames gain nearly what N times the light in one frame does.
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np
from scipy import ndimage

from device.clock import Clock
from device.errors import FrameError
from device.recon.estimation.black_parts import black_parts
from device.recon.estimation.group_registration import register_group
from device.recon.estimation.registration import Registrar
from device.recon.frames import plane
from device.recon.model import kernels
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_radius_px, lit_field
from device.recon.model.grid import Grid
from device.recon.model.kernels import Pixels
from device.recon.model.preprocessing import Preprocessor
from device.recon.model.resampling import add_moved_back, to_sensor
from device.recon.reconstructor import Reconstructor
from device.recon.stage import ROUND_DONE, QuickLook, RoundDone, default_schedule
from device.values import Calibration, FrameUse, Image, Mask

SMOOTH_PX = 14.0  # sigma of the smooth picture: below it the retina, above it field and shading
MIN_WEIGHT = 0.34  # share of the weights that must have seen a pixel; with fewer it is missing
MAX_FRAMES = 64
MIN_COARSE = 200  # samples of a quick look along its shorter side, to be registered


@dataclass(frozen=True)
class JoinedFrame:
    """A burst as one frame.

    Attributes
    ----------
    counts
        Linear DN above dark, float32 (rows, cols), NaN where too few frames saw the pixel.
    light
        Ratio of the sum of the light of the used frames to that of the first used one, the reference.
    frames
        What became of each frame, one entry per frame.
    """

    counts: Image
    light: float
    frames: tuple[FrameUse, ...]


@dataclass(frozen=True)
class SeenFrame:
    """A frame that is ready to be joined: `BurstJoiner.see` makes it, before the other frames are known.

    `light_dn`: image of the light in DN above dark, and `good`: mask of the good pixels, both
    (rows, cols) of the sensor; `picture` on the grid of the registration; `mean_dn`: mean light in DN; `saturated`:
    share of saturated pixels.
    """

    light_dn: Image
    good: Mask
    picture: Image
    mean_dn: float
    saturated: float | None


def require_light(look: QuickLook) -> None:
    """Raise FrameError unless a frame has light."""
    if not look.solved.has_light:
        raise FrameError("the frame holds no signal above the black level")


class BurstJoiner:
    """Joining of bursts of one calibration and sensor shape with PSF `index`; planned at construction.

    With `single`, a reconstructor of this calibration, its quick looks are registered instead of final pictures, where
    they have at least MIN_COARSE samples and the field is calibrated: in half the time, with 0.12 instead of 0.09
    pixels rms (NUMERICS.md 9.1).

    It holds 5 bytes per pixel of each frame, and some arrays of one frame while it joins: 4 frames of 2.07 MP take 115
    MB at the most, 16 frames 260 MB (measured). Not thread-safe.
    """

    def __init__(
        self,
        calibration: Calibration,
        shape: tuple[int, int],
        planner: Planner,
        clock: Clock,
        index: int = 0,
        single: Reconstructor | None = None,
    ) -> None:
        coarse, fine = default_schedule(calibration, shape, index)
        if min(shape) // coarse.bin < MIN_COARSE or not isfinite(field_radius_px(calibration)):
            single = None
        self._calibration, self._shape = calibration, shape
        self.registers_quick_looks = single is not None
        self._single = single or Reconstructor(
            calibration, shape, planner, clock, (fine,), psf_index=index, refract=False, timed=False
        )
        self._stage = self._single.stages[0]
        self._whole = replace(self._stage.grid, radius_samples=float("inf"))  # light falls beyond the field, too

    def __call__(
        self, frames: Sequence[Pixels], unusable: Mapping[int, str] | None = None, dark: Pixels | None = None
    ) -> JoinedFrame:
        """Return the joined frame: the last one of `steps`."""
        (joined,) = deque(self.steps(frames, unusable, dark), maxlen=1)
        assert isinstance(joined, JoinedFrame)
        return joined

    def steps(
        self,
        frames: Sequence[Pixels],
        unusable: Mapping[int, str] | None = None,
        dark: Pixels | None = None,
        ready: Mapping[int, SeenFrame] | None = None,
    ) -> Iterator[RoundDone | JoinedFrame]:
        """Join frames (rows, cols) in counts; `dark` is their dark frame (None: the calibration's).

        Yields ROUND_DONE after the picture of each frame that is not `ready` (by index, with the same dark frame), then
        the joined frame. `unusable` holds the reason of each frame that is known to be unusable, by index. A frame that
        does not show what most of the others show, that has a black part, that is blurred by motion, that has no light
        or too many missing pixels is left out, with its reason. With one frame left the result is that frame.
        FrameError if none can be used.
        """
        reasons = dict(unusable or {})
        seen = {k: seen_frame for k, seen_frame in (ready or {}).items() if k not in reasons}
        for k, frame in enumerate(frames):
            if k in reasons or k in seen:
                continue
            try:
                seen[k] = self.see(frame, dark)
            except FrameError as error:
                reasons[k] = error.message
            yield ROUND_DONE
        reasons |= black_parts({k: (seen_frame.light_dn, seen_frame.good) for k, seen_frame in seen.items()})
        seen = {k: seen[k] for k in sorted(seen) if k not in reasons}
        if not seen:
            raise FrameError(f"no frame of the burst can be used; the first: {reasons[0]}", "Take the burst again.")
        grid = self._stage.grid
        field = self._field([seen_frame.picture for seen_frame in seen.values()])
        registrar = Registrar(field[grid.shown], grid.n)
        flats = {k: registrar.flat(seen_frame.picture[grid.shown]) for k, seen_frame in seen.items()}
        shifts, left_out = register_group(registrar, flats, {k: seen_frame.mean_dn for k, seen_frame in seen.items()})
        reasons |= left_out
        uses = [FrameUse(k, k not in reasons, shifts.get(k), 0.0, reasons.get(k)) for k in range(len(frames))]
        yield self._join(seen, field, uses)

    def see(self, frame: Pixels, dark: Pixels | None, look: QuickLook | None = None) -> SeenFrame:
        """Return a frame (rows, cols) in counts, ready to be joined; `dark` as for `steps`.

        `look`: its quick look, if there is one and quick looks are registered. FrameError without light or with too
        many missing pixels.
        """
        if look is None or not self.registers_quick_looks:
            look = self._single.quick_look(plane(frame, 0), dark)
        require_light(look)
        # A preprocessor of its own: its light is the result, and that of all frames is needed at once.
        full = Preprocessor(self._calibration, Grid.periodic(self._shape, 1, float("inf")))
        linear = full(look.even.counts, dark, look.defects[0])
        return SeenFrame(linear.y, linear.good > 0, look.planes[0], linear.mean_dn, look.solved.frame.saturated)

    def _field(self, pictures: Sequence[Image]) -> Image:
        """Return the lit field on the grid of the pictures, 0 to 1; found in their mean if it is not calibrated."""
        if isfinite(self._stage.grid.radius_samples):
            return self._stage.model.mask
        return lit_field(np.mean(pictures, axis=0, dtype=np.float32), self._stage.grid)

    def _smooth(self, seen: SeenFrame, good: Image, field: Image, near: Image) -> tuple[Image, float]:
        """Return the smooth part of a frame on the sensor, its picture without detail, blurred by the PSF, and its
        scale in DN; `good` is 1 for its good pixels, `near` is the blurred field.
        """
        stage = self._stage
        sigma = SMOOTH_PX / self._stage.grid.n
        picture = ndimage.gaussian_filter(seen.picture * field, sigma) / near * field
        blurred = to_sensor(stage.model.blur(picture.astype(np.float32)), self._whole)
        along, _, energy, _, _ = kernels.flat_fit_sums(seen.light_dn, blurred, good)  # least squares
        return blurred, along / energy if energy > 0 else 0.0

    def _join(self, seen: dict[int, SeenFrame], field: Image, uses: Sequence[FrameUse]) -> JoinedFrame:
        used = [use.index for use in uses if use.used]
        total_dn = sum(seen[k].mean_dn for k in used)
        shares = {k: seen[k].mean_dn / total_dn for k in used}
        reference = seen[used[0]]
        near = np.maximum(ndimage.gaussian_filter(field, SMOOTH_PX / self._stage.grid.n), 0.05)
        good = reference.good.astype(np.float32)
        base, base_scale = self._smooth(reference, good, field, near)
        joined = np.zeros(self._shape, np.float32)
        weights = np.zeros(self._shape, np.float32)
        for k in used:
            shift = uses[k].shift_px
            frame = seen[k]
            assert shift is not None
            good[:] = frame.good
            smooth, scale = (base, base_scale) if frame is reference else self._smooth(frame, good, field, near)
            detail = np.empty_like(base) if frame is reference else smooth  # in its place: `base` is needed at the end
            kernels.subtract_scaled(frame.light_dn, smooth, scale, good, detail)
            add_moved_back(detail, good, shift, shares[k], reference.mean_dn / frame.mean_dn, joined, weights)
        kernels.finish_mean(joined, weights, MIN_WEIGHT, base, base_scale)
        light = total_dn / reference.mean_dn
        frames = tuple(replace(use, weight=shares.get(use.index, 0.0)) for use in uses)
        return JoinedFrame(joined, light, frames)
