"""Camera of a Raspberry Pi through picamera2: unpacked raw counts of frames whose exposure began after the call.

One configuration stays as long as the camera is open; only exposure times change. Every wait has a timeout.
"""

import logging
from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.config.head_file import CameraSpec
from device.drivers.exposure_retry import CABLE_REMEDY, FRAME_TIMEOUT_S, LampState, RetryingCamera
from device.drivers.raw_counts import RawLayout, black_dn, pi_layout
from device.errors import CameraMismatch, CameraMissing, CameraStalled, HardwareError
from device.values import Counts, ExposureSettings

log = logging.getLogger(__name__)

BUFFERS = 3
MAX_SETTLING_FRAMES = 16  # frames until a new exposure time is in effect: queued ones plus four of delay, times two
OPEN_TIMEOUT_S = 10.0
SPARE_US = 1500  # between two exposures, for the blanking of the read-out; the sensor lengthens it as needed
MAIN = (320, 240)  # the processed stream that picamera2 requires; not used
MOSAICS = {0: "SRGGB", 1: "SGRBG", 2: "SGBRG", 3: "SBGGR", 5: "R"}  # libcamera's ColorFilterArrangement
FIXED_CONTROLS = {"AeEnable": False, "AwbEnable": False, "NoiseReductionMode": 0, "Sharpness": 0.0}
LIBRARY_ERRORS = (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError)  # picamera2, libcamera
NO_CAMERA_REMEDY = (
    "Check the camera's ribbon cable and the line dtoverlay of config.txt, then turn the device off and on."
)


class PiCamera(RetryingCamera):
    """libcamera driver that implements `ports.Camera`: one raw configuration, reopened once after a timeout.

    `light` is the source of each frame's illumination; `simulated` marks its frames if the driver runs over an emulated
    sensor; `patience_s` is the timeout for a frame after its exposure; `allocator` is passed on to picamera2. Raises
    CameraMissing, CameraMismatch, CameraPacked or CameraStalled.
    """

    def __init__(
        self,
        spec: CameraSpec,
        light: LampState,
        *,
        simulated: bool = False,
        patience_s: float = FRAME_TIMEOUT_S,
        allocator: Any = None,
    ) -> None:
        try:
            from picamera2 import MappedArray, Picamera2
        except Exception as error:  # of another numpy's compiled part: ValueError
            raise CameraMissing(
                f"picamera2 cannot be imported: {error}",
                "Install the packages python3-picamera2 and python3-libcamera, and let .venv see them: make pi.",
            ) from error
        self._library, self._mapped = Picamera2, MappedArray
        super().__init__(spec, light, simulated, patience_s)
        self._allocator = allocator
        self._device: Any = None
        self._layout: RawLayout
        self._gain = 1.0  # lowest of the sensor, at least 1: an IMX708 begins at 1.123
        self._mosaic = "R"
        self.open(ExposureSettings(spec.exposure_s))

    @property
    def facts(self) -> dict[str, str]:
        """Return `sensor` and the granted raw `format`, for a technician; and `mosaic` of a sensor with filters."""
        facts = {"sensor": str(self._spec.sensor), "format": self._layout.name}
        return facts if self._mosaic == "R" else {**facts, "mosaic": self._mosaic.removeprefix("S")}

    # Opening

    def _open(self, shot: ExposureSettings) -> None:
        """Open and start the sensor that the head file names, in its mode; TimeoutError after 10 s, CameraMissing."""
        try:
            run_with_timeout(OPEN_TIMEOUT_S, lambda: self._start(shot.exposure_s))
        except (HardwareError, TimeoutError):
            raise
        except LIBRARY_ERRORS as error:
            raise CameraMissing(f"the {self._name} cannot be opened: {error}", NO_CAMERA_REMEDY) from error

    def _start(self, exposure_s: float) -> None:
        device = self._device = self._library(self._camera_index(), allocator=self._allocator)
        spec = self._spec
        size = (self._spec.cols, self._spec.rows)
        mosaic = self._mosaic = self._reported_mosaic(int(device.camera_properties.get("ColorFilterArrangement", 5)))
        self._refuse_unexpected_mosaic(mosaic)
        asked = device.create_video_configuration(
            main={"size": (min(MAIN[0], size[0] & ~1), min(MAIN[1], size[1] & ~1))},
            raw={"format": f"{mosaic}{spec.bit_depth}", "size": size},
            sensor={"output_size": size, "bit_depth": spec.bit_depth},
            controls=self._controls(device, exposure_s),
            buffer_count=BUFFERS,
            queue=False,
            display=None,
            encode=None,
        )
        device.configure(asked)
        self._layout = self._granted_layout(device.camera_configuration())
        device.start()
        log.info("%s: raw %s", spec.sensor, device.camera_configuration()["raw"])

    def _reported_mosaic(self, arrangement: int) -> str:
        """Return the letters of libcamera's raw format; CameraMismatch for filters of an unknown arrangement."""
        if arrangement not in MOSAICS:
            raise CameraMismatch(
                f"the {self._spec.sensor} has colour filters of an unknown arrangement ({arrangement})",
                "Fit the monochrome version.",
            )
        return MOSAICS[arrangement]

    def _refuse_unexpected_mosaic(self, mosaic: str) -> None:
        """Raise CameraMismatch for colour filters that the head file does not expect: counts would not be grey."""
        if mosaic != "R" and not self._spec.bayer:
            raise CameraMismatch(
                f"the {self._spec.sensor} has colour filters ({mosaic.removeprefix('S')}); this head needs the "
                "monochrome version",
                "Fit the monochrome version. For a bench write bayer = true under [camera], and reconstruct with "
                "--bayer.",
            )

    def _camera_index(self) -> int:
        """Return the index of the first camera with the sensor of the head file; CameraMissing or CameraMismatch."""
        found = [str(camera["Model"]) for camera in self._library.global_camera_info()]
        if not found:
            raise CameraMissing(f"libcamera finds no camera; this head needs the {self._spec.sensor}", NO_CAMERA_REMEDY)
        for number, model in enumerate(found):
            if model.lower().split("_")[0] == self._spec.sensor:
                return number
        raise CameraMismatch(f"the camera is the {', '.join(found)}; this head needs the {self._spec.sensor}")

    def _controls(self, device: Any, exposure_s: float) -> dict[str, Any]:
        """Return the controls of an exposure that the sensor has; CameraMismatch if exposure or gain cannot be set."""
        known = device.camera_controls
        if missing := {"ExposureTime", "AnalogueGain", "FrameDurationLimits"} - known.keys():
            raise CameraMismatch(f"the {self._spec.sensor} does not let {', '.join(sorted(missing))} be chosen")
        self._gain = max(1.0, float(known["AnalogueGain"][0]))
        wanted = FIXED_CONTROLS | {"AnalogueGain": self._gain} | exposure_controls(exposure_s)
        return {name: value for name, value in wanted.items() if name in known}

    def _granted_layout(self, configuration: dict[str, Any]) -> RawLayout:
        """Return the granted layout, read back as libcamera may adjust a request; CameraMismatch, CameraPacked."""
        raw = configuration["raw"]
        sensor = configuration.get("sensor") or {}
        spec = self._spec
        layout = pi_layout(raw["format"], spec.rows, spec.cols, spec.bit_depth)
        if tuple(raw["size"]) != (spec.cols, spec.rows):
            raise CameraMismatch(
                f"the {spec.sensor} has no mode of {spec.rows} x {spec.cols}: it grants {raw['size'][::-1]}"
            )
        if sensor.get("bit_depth", spec.bit_depth) != spec.bit_depth:
            raise CameraMismatch(
                f"the {spec.sensor} grants {sensor['bit_depth']} bits; this head needs {spec.bit_depth}"
            )
        return layout

    # Frames

    def _take(self, shot: ExposureSettings, counts: Counts | None) -> None:
        """Write the next frame whose metadata match the request into `counts`; None: only check its raw bytes.

        Raises TimeoutError when no frame arrives, CameraStalled when none of 16 frames matches, CameraMismatch by the
        check.
        """
        self._device.set_controls(exposure_controls(shot.exposure_s))
        flush: bool | None = True  # a frame that began before this call may show another illumination
        wait_s = self._timeout_s(shot, counts)
        for _ in range(MAX_SETTLING_FRAMES):
            request = self._device.capture_request(wait=wait_s, flush=flush)
            try:
                metadata = request.get_metadata()
                right = self._matches_request(metadata, shot)
                if right:
                    with self._mapped(request, "raw", write=False) as raw:
                        first = self._read(raw.array, counts)
            finally:
                request.release()
            if right:
                if first is not None:
                    self._check_first_frame(first, metadata)
                return
            flush = None  # the following frames began later
        raise CameraStalled(
            f"{MAX_SETTLING_FRAMES} frames passed, and none was exposed for {shot.exposure_s * 1e6:.0f} us at gain "
            f"{self._gain:g} (the last: {metadata.get('ExposureTime')} us, gain {metadata.get('AnalogueGain')})"
        )

    def _matches_request(self, metadata: dict[str, Any], shot: ExposureSettings) -> bool:
        """Return whether a frame has this exposure (within 1.5 rows: the sensor rounds down to rows) and gain."""
        off_us = abs(float(metadata["ExposureTime"]) - shot.exposure_s * 1e6)
        return (
            off_us <= 1.5 * self._spec.row_us
            and abs(float(metadata.get("AnalogueGain", self._gain)) - self._gain) < 0.1
        )

    def _read(self, raw: NDArray[np.uint8], counts: Counts | None) -> NDArray[np.uint8] | None:
        """Copy the counts of a borrowed buffer into `counts`, return None; if None, return a copy of the raw bytes."""
        if counts is None:
            return raw.copy()
        self._layout.counts(raw, counts)
        return None

    def _check_first_frame(self, raw: NDArray[np.uint8], metadata: dict[str, Any]) -> None:
        """Raise CameraMismatch if a first frame contradicts the granted layout or the head file's black level."""
        self._layout.check(raw)
        levels = metadata.get("SensorBlackLevels")
        if not levels:
            return
        nominal_dn = black_dn(levels[0], self._spec.bit_depth)
        ours_dn = self._spec.black_dn
        if abs(nominal_dn - ours_dn) > max(nominal_dn, ours_dn) / 2:
            raise CameraMismatch(
                f"the {self._spec.sensor} says its black level is {nominal_dn:g} DN at {self._spec.bit_depth} bits; "
                f"the head's file says {ours_dn:g}",
                "Correct bit_depth or black_dn in the head's file.",
            )

    def _close_device(self) -> None:
        """Stop and close the device; CameraStalled after 10 s, because the driver or libcamera may hang."""
        device = self._device
        self._device = None
        if device is None:
            return
        device.cancel_all_and_flush()
        try:
            run_with_timeout(OPEN_TIMEOUT_S, device.close)
        except TimeoutError as error:
            raise CameraStalled(f"the {self._spec.sensor} cannot be closed: its driver hangs", CABLE_REMEDY) from error


def exposure_controls(exposure_s: float) -> dict[str, Any]:
    """Return the libcamera controls of an exposure time; the frame duration is 1.5 ms longer than the exposure."""
    exposure_us = round(exposure_s * 1e6)
    return {"ExposureTime": exposure_us, "FrameDurationLimits": (exposure_us + SPARE_US, exposure_us + SPARE_US)}


def run_with_timeout(limit_s: float, call: Callable[[], None]) -> None:
    """Run a call that may hang in a thread and raise its error; TimeoutError after `limit_s`: the thread runs on."""
    done: Future[None] = Future()

    def run() -> None:
        try:
            call()
            done.set_result(None)
        except LIBRARY_ERRORS as error:
            done.set_exception(error)

    Thread(target=run, name="camera", daemon=True).start()
    done.result(limit_s)
