"""A sensor on a Raspberry Pi, through picamera2: one long-lived raw mode, and frames that match their light."""

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.clock import Clock
from device.drivers.raw_counts import RawLayout
from device.errors import CameraMismatch, CameraMissing, CameraStalled, FrameError
from device.ports import Light
from device.spec import CameraSpec
from device.values import Counts, Frame, Shot

log = logging.getLogger(__name__)

BUFFERS = 4
MATCHED_US = 30  # exposures are whole rows, rounded down; a Pi reports up to two rows less than was asked
LATE_FRAMES = BUFFERS + 6  # a control takes effect after the queued buffers and some frames; never more than this
PATIENCE_S = 2.0  # by default, beyond what the exposures take, before a camera counts as stalled
MAIN_PX = (320, 240)  # picamera2 has no raw-only mode: the picture nobody looks at is small


class PiCamera:
    """The camera that `spec` names; every frame says what `light` showed while it was exposed.

    `allocator` is picamera2's seam for buffers: None takes them from the kernel's heap. `simulated` marks frames of a
    sensor that is none. Raises CameraMissing or CameraMismatch.
    """

    def __init__(
        self, spec: CameraSpec, light: Light, clock: Clock, *,
        allocator: Any = None, patience_s: float = PATIENCE_S, simulated: bool = False,
    ) -> None:  # fmt: skip
        try:
            from picamera2 import MappedArray, Picamera2
        except ImportError as error:
            raise CameraMissing(f"picamera2 cannot be used: {error}", "Install python3-picamera2.") from error
        self._make, self._mapped = Picamera2, MappedArray
        self.spec, self._light, self._clock = spec, light, clock
        self._allocator, self._patience_s, self._simulated = allocator, patience_s, simulated
        self._number = 0
        self._camera: Any = None
        self._open()

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of every frame."""
        return self.spec.rows, self.spec.cols

    @property
    def facts(self) -> dict[str, str]:
        """What answered, for a technician."""
        if self._camera is None:
            return {}
        raw = self._camera.camera_configuration()["raw"]
        model = self._camera.camera_properties["Model"]
        return {"sensor": str(model), "format": str(raw["format"]), "stride": f"{raw['stride']} bytes"}

    def expose(self, shot: Shot, into: NDArray[np.uint16] | None = None) -> Frame:
        """Take one frame whose exposure began after this call; `into` (rows, cols) is filled if it is given.

        A camera that stalls is opened anew once. Raises CameraMissing, CameraStalled, or FrameError for a wrong buffer.
        """
        if self._camera is None:
            raise CameraMissing("the camera has been closed")
        if into is not None and (into.shape != self.shape or into.dtype != np.uint16):
            raise FrameError(f"the buffer is {into.dtype} {into.shape}; this sensor fills uint16 {self.shape}")
        out: Counts = np.empty(self.shape, np.uint16) if into is None else into
        try:
            return self._exposed(shot, out)
        except TimeoutError:
            log.warning("the camera stalled: it is opened anew")
            self._shut()
            self._open()
        try:
            return self._exposed(shot, out)
        except TimeoutError as error:
            raise CameraStalled("the camera gives no frame, nor after it was opened anew") from error

    def close(self) -> None:
        """Release the sensor; closing twice is harmless."""
        if self._camera is not None:
            self._shut()

    def _open(self) -> None:
        if not self._make.global_camera_info():
            raise CameraMissing("no camera answers")
        try:
            camera = self._make(allocator=self._allocator)
        except (RuntimeError, IndexError) as error:
            raise CameraMissing(f"no camera answers: {error}") from error
        self._camera = camera
        try:
            self._configure()
            self._check_the_first_frame()
        except TimeoutError as error:
            self._shut()
            raise CameraStalled("the camera answers, but gives no frame") from error
        except BaseException:
            self._shut()
            raise

    def _configure(self) -> None:
        camera, spec = self._camera, self.spec
        model = str(camera.camera_properties.get("Model", "unknown"))
        if spec.sensor is not None and not model.startswith(spec.sensor):
            raise CameraMismatch(f"the sensor is {model}, the head file says {spec.sensor}")
        size = spec.cols, spec.rows
        exposure_us = round(spec.exposure_s * 1e6)
        wished = {"AeEnable": False, "NoiseReductionMode": 0, "AnalogueGain": 1.0} | _timing(exposure_us)
        camera.configure(
            camera.create_still_configuration(
                main={"size": MAIN_PX, "format": "XBGR8888"},
                raw={"size": size, "format": f"R{spec.bit_depth}"},
                sensor={"output_size": size, "bit_depth": spec.bit_depth},
                buffer_count=BUFFERS,
                controls={name: value for name, value in wished.items() if name in camera.camera_controls},
            )
        )
        raw = camera.camera_configuration()["raw"]
        if tuple(raw["size"]) != size:
            raise CameraMismatch(f"the camera gives {raw['size']} pixels, the head file says {size}")
        self._layout = RawLayout.of(str(raw["format"]), self.shape, int(raw["stride"]), spec.bit_depth)
        self._asked_us = exposure_us
        camera.start(show_preview=False)

    def _check_the_first_frame(self) -> None:
        request = self._camera.capture_request(wait=self._asked_us * 1e-6 * BUFFERS + self._patience_s)
        try:
            with self._mapped(request, "raw", write=False) as mapped:
                used = self._layout.used_bits(mapped.array)
        finally:
            request.release()
        self._layout.check(used)

    def _exposed(self, shot: Shot, out: Counts) -> Frame:
        """The first frame that was exposed as asked and began after now."""
        glow, now_s = self._light.glow, self._clock.now_s()
        asked_us = round(shot.exposure_s * 1e6)
        if asked_us != self._asked_us:
            self._camera.set_controls(_timing(asked_us))
            self._asked_us = asked_us
        for _ in range(LATE_FRAMES):
            request = self._camera.capture_request(wait=2 * shot.exposure_s + self._patience_s, flush=int(now_s * 1e9))
            try:
                told = request.get_metadata()
                if abs(told["ExposureTime"] - asked_us) > MATCHED_US:
                    continue
                with self._mapped(request, "raw", write=False) as mapped:
                    self._layout.unpack(mapped.array, out)
            finally:
                request.release()
            self._number += 1
            shown = glow if self._light.glow == glow else None
            return Frame(out, shot.exposure_s, self._number, shown, simulated=self._simulated)
        raise CameraStalled(f"the camera does not take an exposure of {asked_us} us; it says {told['ExposureTime']}")

    def _shut(self) -> None:
        camera, self._camera = self._camera, None
        camera.cancel_all_and_flush()
        camera.stop()
        camera.close()


def _timing(exposure_us: int) -> dict[str, Any]:
    """An exposure, and frames that are just long enough for it."""
    return {"ExposureTime": exposure_us, "FrameDurationLimits": (exposure_us, max(exposure_us, 2 * exposure_us))}
