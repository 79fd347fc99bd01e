"""Assessment of frames for the page: aiming hints, verdicts before and after reconstruction, laterality estimates."""

import numpy as np

from device.config.head_file import InstrumentSpec
from device.errors import FrameError
from device.recon.assessment.aiming import Aim, AimingGuide
from device.recon.assessment.frame_quality import FrameQualityGate, assess, assess_picture
from device.recon.assessment.laterality import Laterality, laterality
from device.recon.model.fft_plans import Planner
from device.recon.model.kernels import Pixels
from device.values import Calibration, Image, Report, Verdict
from services.records.capture import NO_METHOD
from services.records.capture_target import CaptureTarget

MACULA_FIELD = "centre"  # the field of view, in a programme, that is centred on the macula
NO_AIM = Aim("noeye", 0.0)
FAILED_VERDICT = Verdict("again", "make.failed", {})


class FrameAssessor:
    """Assessment of frames: aiming hints, verdicts and laterality. Not thread-safe.

    The head thread calls it, and that of the preparation while the former exposes.
    """

    def __init__(
        self, calibration: Calibration, shape: tuple[int, int], planner: Planner, index: int, spec: InstrumentSpec
    ) -> None:
        camera = spec.camera
        self._frame_assessor = FrameQualityGate(calibration, shape, planner, index)
        self._aimer = AimingGuide(camera.exposure_s, self._frame_assessor.deg_per_sample)
        self._geometry = calibration.geometry
        self._field_deg = calibration.field_deg
        self._upright = camera.upright

    def aim(self, counts: Pixels, exposed_s: float) -> Aim:
        """Return the aiming hint after one more live frame, exposed at `exposed_s` (clock seconds)."""
        return self._aimer(self._frame_assessor(counts), self._frame_assessor.picture, exposed_s)

    def speed_deg_per_s(self, now_s: float) -> float | None:
        """Return the speed of the eye between the last two live frames, deg/s; None if unknown or too old."""
        return self._aimer.speed_deg_per_s(now_s)

    def assess(self, counts: Pixels, dark: Pixels | None, begin_s: float) -> Verdict:
        """Return the verdict on the raw frame of a capture before its reconstruction.

        `dark`: its dark frame; without it (None) that of the calibration is subtracted, and for the brightness the
        black level of the sensor.
        `begin_s`: begin of the exposure (clock seconds).
        FAILED_VERDICT for a frame that cannot be assessed.
        """
        try:
            reading = self._frame_assessor(counts, dark)
        except FrameError:  # another shape than the calibration, or no valid pixel
            return FAILED_VERDICT
        return assess(reading, self._aimer.eye_was_visible(begin_s))

    def reassess(self, first: Verdict, report: Report, target: CaptureTarget) -> Verdict:
        """Return the final verdict after reconstruction.

        A failed reconstruction of a good frame gives FAILED_VERDICT; on the last try each bad verdict is `shot.poor`.
        """
        if report.method == NO_METHOD and first.code is None:
            first = FAILED_VERDICT
        return assess_picture(first, report.residual, report.quality.get("coverage"), target.tries, target.retakes)

    def estimate_laterality(self, picture: Image, verdict: Verdict, target: CaptureTarget) -> Laterality | None:
        """Return the laterality estimate; `picture` is cropped to the illuminated field.

        None unless the verdict is good, the field of view macula-centred, the camera upright and the field size known.
        """
        asked = self._upright and verdict.word == "good" and target.field == MACULA_FIELD
        if not asked or self._geometry is None or self._field_deg is None:
            return None
        plain = picture if picture.ndim == 2 else picture[..., int(np.argmax(picture.mean(axis=(0, 1))))]
        return laterality(plain, self._geometry.px_per_deg, self._field_deg)
