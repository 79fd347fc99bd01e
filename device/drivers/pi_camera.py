"""The camera of a Raspberry Pi, over picamera2: plain raw counts, exposed after the call, or a named error.

One configuration lives as long as the camera; only exposure times change. Nothing waits without an end.
"""

import logging
from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.drivers.exposing import STUCK, Exposing, Shining
from device.drivers.raw_counts import RawLayout, black_dn, pi_layout
from device.errors import CameraMissing, CameraStalled, CameraWrong, HardwareError
from device.spec import CameraSpec
from device.values import Counts, Shot

log = logging.getLogger(__name__)

BUFFERS = 3
SETTLING = 16  # frames that may pass until a new exposure time arrives: those queued, and four of delay, twice over
PATIENCE_S = 2.0
OPENING_S = 10.0
SPARE_US = 1500  # between two exposures, for the read-out's blanking; the sensor lengthens it to what it needs
MAIN = (320, 240)  # the processed picture that picamera2 insists on; nobody looks at it
MOSAICS = {0: "SRGGB", 1: "SGRBG", 2: "SGBRG", 3: "SBGGR", 5: "R"}  # libcamera's ColorFilterArrangement
WANTED = {"AeEnable": False, "AwbEnable": False, "AnalogueGain": 1.0, "NoiseReductionMode": 0, "Sharpness": 0.0}
NO_CAMERA = "Check the camera's ribbon cable and the line dtoverlay of config.txt, then turn the device off and on."


class PiCamera(Exposing):
    """A sensor of libcamera: one long-lived raw configuration, opened anew once if it falls silent.

    `simulated` marks its frames, where the driver runs over an emulated sensor; `patience_s` is how long past its
    exposure a frame is waited for. Raises CameraMissing, CameraWrong, CameraPacked or CameraStalled.
    """

    def __init__(
        self,
        spec: CameraSpec,
        light: Shining,
        *,
        simulated: bool = False,
        patience_s: float = PATIENCE_S,
        allocator: Any = None,
    ) -> None:
        try:
            from picamera2 import MappedArray, Picamera2
        except ImportError as error:
            raise CameraMissing(
                f"picamera2 cannot be imported: {error}",
                "Install the packages python3-picamera2 and python3-libcamera, and let .venv see them.",
            ) from error
        self._library, self._mapped = Picamera2, MappedArray
        super().__init__(spec, light, simulated)
        self._patience_s, self._allocator = patience_s, allocator
        self._device: Any = None
        self._layout: RawLayout
        self.open(Shot(spec.exposure_s))

    @property
    def facts(self) -> dict[str, str]:
        """What answered, for a technician: the sensor, and the raw format that libcamera granted."""
        return {"sensor": str(self._spec.sensor), "format": self._layout.name}

    # Opening

    def _open(self, shot: Shot) -> None:
        """Open the sensor that the head names, in its mode."""
        try:
            within(OPENING_S, lambda: self._start(shot.exposure_s))
        except (HardwareError, TimeoutError):
            raise
        except (RuntimeError, ValueError, OSError) as error:  # what picamera2 and libcamera raise
            raise CameraMissing(f"the {self._name} cannot be opened: {error}", NO_CAMERA) from error

    def _start(self, exposure_s: float) -> None:
        device = self._device = self._library(self._which(), allocator=self._allocator)
        spec, size = self._spec, (self._spec.cols, self._spec.rows)
        mosaic = MOSAICS.get(int(device.camera_properties.get("ColorFilterArrangement", 5)), "R")
        asked = device.create_video_configuration(
            main={"size": (min(MAIN[0], size[0] & ~1), min(MAIN[1], size[1] & ~1))},
            raw={"format": f"{mosaic}{spec.bit_depth}", "size": size},
            sensor={"output_size": size, "bit_depth": spec.bit_depth},
            controls=self._controls(device, exposure_s),
            buffer_count=BUFFERS, queue=False, display=None, encode=None,
        )  # fmt: skip
        device.configure(asked)
        self._layout = self._granted(device.camera_configuration())
        device.start()
        log.info("%s: raw %s", spec.sensor, device.camera_configuration()["raw"])

    def _which(self) -> int:
        """The number of the first camera of the sensor that the head names."""
        found = [str(one["Model"]) for one in self._library.global_camera_info()]
        if not found:
            raise CameraMissing(f"libcamera finds no camera; this head needs the {self._spec.sensor}", NO_CAMERA)
        for number, model in enumerate(found):
            if model.lower().split("_")[0] == self._spec.sensor:
                return number
        raise CameraWrong(f"the camera is the {', '.join(found)}; this head needs the {self._spec.sensor}")

    def _controls(self, device: Any, exposure_s: float) -> dict[str, Any]:
        """What to ask of the sensor, as far as it knows of it; CameraWrong if exposures cannot be chosen at all."""
        known = device.camera_controls
        if missing := {"ExposureTime", "AnalogueGain", "FrameDurationLimits"} - known.keys():
            raise CameraWrong(f"the {self._spec.sensor} does not let {', '.join(sorted(missing))} be chosen")
        return {name: value for name, value in (WANTED | timing(exposure_s)).items() if name in known}

    def _granted(self, configuration: dict[str, Any]) -> RawLayout:
        """Read back what libcamera made of the request: it may adjust every word of it."""
        raw, sensor, spec = configuration["raw"], configuration.get("sensor") or {}, self._spec
        layout = pi_layout(raw["format"], spec.rows, spec.cols, spec.bit_depth)
        if tuple(raw["size"]) != (spec.cols, spec.rows):
            raise CameraWrong(
                f"the {spec.sensor} has no mode of {spec.rows} x {spec.cols}: it grants {raw['size'][::-1]}"
            )
        if sensor.get("bit_depth", spec.bit_depth) != spec.bit_depth:
            raise CameraWrong(f"the {spec.sensor} grants {sensor['bit_depth']} bits; this head needs {spec.bit_depth}")
        return layout

    # Frames

    def _take(self, shot: Shot, counts: Counts | None) -> None:
        """The next frame whose metadata say what was asked, into `counts`; None looks at it only: the first one.

        Raises TimeoutError when no frame comes, CameraStalled when frames come, and never the right one.
        """
        self._device.set_controls(timing(shot.exposure_s))
        flush: bool | None = True  # a frame that began before this call shows another light
        wait_s = shot.exposure_s + self._patience_s
        for _ in range(SETTLING):
            request = self._device.capture_request(wait=wait_s, flush=flush)
            try:
                said = request.get_metadata()
                right = self._is_as_asked(said, shot)
                if right:
                    with self._mapped(request, "raw", write=False) as raw:
                        first = self._read(raw.array, counts)
            finally:
                request.release()
            if right:
                if first is not None:
                    self._check(first, said)
                return
            flush = None  # those that follow are later still
        raise CameraStalled(
            f"{SETTLING} frames passed, and none was exposed for {shot.exposure_s * 1e6:.0f} us at gain 1 "
            f"(the last: {said.get('ExposureTime')} us, gain {said.get('AnalogueGain')})"
        )

    def _is_as_asked(self, said: dict[str, Any], shot: Shot) -> bool:
        """Whether a frame's own metadata fit: exposures are whole rows, rounded down."""
        off_us = abs(float(said["ExposureTime"]) - shot.exposure_s * 1e6)
        return off_us <= 1.5 * self._spec.row_us and abs(float(said.get("AnalogueGain", 1.0)) - 1) < 0.1

    def _read(self, raw: NDArray[np.uint8], counts: Counts | None) -> NDArray[np.uint8] | None:
        """Take the counts out of a buffer that is lent; or, with nowhere to put them, a copy of it."""
        if counts is None:
            return raw.copy()
        self._layout.counts(raw, counts)
        return None

    def _check(self, raw: NDArray[np.uint8], said: dict[str, Any]) -> None:
        """Refuse a first frame that is not as the head's file and the granted format say."""
        self._layout.check(raw)
        levels = said.get("SensorBlackLevels")
        if not levels:
            return
        nominal_dn, ours_dn = black_dn(levels[0], self._spec.bit_depth), self._spec.black_dn
        if abs(nominal_dn - ours_dn) > max(nominal_dn, ours_dn) / 2:
            raise CameraWrong(
                f"the {self._spec.sensor} says its black level is {nominal_dn:g} DN at {self._spec.bit_depth} bits; "
                f"the head's file says {ours_dn:g}",
                "Correct bit_depth or black_dn in the head's file.",
            )

    def _let_go(self) -> None:
        """Stop and close, as far as that can be done in time: a driver may hang, and so may libcamera."""
        device, self._device = self._device, None
        if device is None:
            return
        device.cancel_all_and_flush()
        try:
            within(OPENING_S, device.close)
        except TimeoutError as error:
            raise CameraStalled(f"the {self._spec.sensor} cannot be closed: its driver hangs", STUCK) from error


def timing(exposure_s: float) -> dict[str, Any]:
    """The controls of an exposure time: the frames follow each other as fast as it lets them."""
    exposure_us = round(exposure_s * 1e6)
    return {"ExposureTime": exposure_us, "FrameDurationLimits": (exposure_us + SPARE_US, exposure_us + SPARE_US)}


def within(limit_s: float, act: Callable[[], None]) -> None:
    """Do something that may hang, in a thread of its own; TimeoutError after `limit_s`, the thread is left behind."""
    done: Future[None] = Future()

    def run() -> None:
        try:
            act()
            done.set_result(None)
        except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError) as error:
            done.set_exception(error)

    Thread(target=run, name="camera", daemon=True).start()
    done.result(limit_s)
