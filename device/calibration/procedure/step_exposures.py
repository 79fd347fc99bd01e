"""Exposures of one calibration step: frames in one buffer, their moments, and the search for an exposure time."""

from collections.abc import Callable, Iterator

import numpy as np

from device.calibration.procedure.darks import Darks
from device.calibration.procedure.moments import Moments
from device.config.head_file import CameraSpec
from device.errors import CalibrationRefused
from device.ports import Camera
from device.values import Counts, ExposureSettings, Frame

SHORTEST_S = 1e-3


class StepExposures:
    """Exposures of the camera of one head; `record` is called with each frame before it is used."""

    def __init__(self, camera: Camera, spec: CameraSpec, record: Callable[[Frame], None]) -> None:
        self.camera, self.spec, self._record = camera, spec, record
        self._counts: Counts = np.empty(camera.shape, np.uint16)

    def moments(self, exposure_s: float, count: int) -> Moments:
        """Return the moments of `count` frames; CalibrationRefused for a frame that `Moments.add` refuses."""
        return Moments.over(self.frames(exposure_s, count), self.camera.shape, exposure_s)

    def frames(self, exposure_s: float, count: int) -> Iterator[Frame]:
        """Yield `count` frames in one shared buffer; each frame overwrites the frame before it."""
        self.camera.prepare(ExposureSettings(exposure_s))
        for _ in range(count):
            frame = self.camera.expose(ExposureSettings(exposure_s), self._counts)
            self._record(frame)
            yield frame

    def exposure_for(
        self, filled: float, darks: Darks, percentile: float, longest_s: float, least: float = 0.0
    ) -> float:
        """Return the exposure, s, at which the percentile of the good pixels is about the share `filled` of full scale.

        The exposure is at most `longest_s`. Raises CalibrationRefused if even that yields a share below `least`.
        """
        good = ~darks.hot
        top_dn = self.spec.white_dn - darks.black_dn
        exposure_s = min(self.spec.exposure_s, longest_s)
        for _ in range(10):
            seen = self.moments(exposure_s, 1)  # refuses another sensor mode, and a lit lamp
            signal_dn = float(np.percentile((seen.mean_dn - darks.at(exposure_s))[good], percentile))
            share = signal_dn / top_dn
            if 0.9 * filled < share < 1.1 * filled:
                break
            if exposure_s >= longest_s and share < least:  # fail before the minutes of long exposures
                raise CalibrationRefused(
                    f"it is dark: {signal_dn:.0f} DN in {exposure_s:.2g} s (at least {least * top_dn:.0f})",
                    "Take the cap off and switch the light on, then start again.",
                )
            factor = 1 / 8 if share > 0.95 else min(filled / max(share, 1e-6), 8.0)
            wanted_s = float(np.clip(exposure_s * factor, SHORTEST_S / 10, longest_s))
            if wanted_s == exposure_s:
                break
            exposure_s = wanted_s
        return exposure_s
