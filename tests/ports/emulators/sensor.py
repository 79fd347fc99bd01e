"""Emulated sensor behind the emulated libcamera: exposes a simulated world in real time, with latency and padding."""

import mmap
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from device.sim.world import World
from device.values import Illumination

DELAY = 2  # frames until a requested control takes effect
ROW_US = 14.8  # exposures are whole rows, rounded down
SHARE_16 = 16
Lamp = Callable[[float, float], list[tuple[Illumination | None, float]]]


class Sensor:
    """Monochrome sensor in a World whose own lamp stays off; `lamp` returns the illumination between two moments.

    Faults are switched by `faults`: "stall" (no frame comes), "packed" (no unpacked format), "compressed" (a lossy
    format is granted), "justified" (values on the other side of their words), "stale" (controls never take effect).
    """

    def __init__(self, world: World, lamp: Lamp, *, model: str = "imx296", bits: int = 12, wide: bool = False) -> None:
        self.world, self.lamp, self.model, self.bits, self.wide = world, lamp, model, bits, wide
        self.faults: set[str] = set()
        self.arrangement = 5  # libcamera's ColorFilterArrangement: 5 is monochrome, 0 a mosaic RGGB
        self.held = False
        self.frames = 0
        self.shortest_frame_us = 2000
        self.lowest_gain = 1.0
        self._coming: deque[dict[str, float]] = deque()
        self._now: dict[str, float] = {}

    @property
    def size(self):
        import libcamera

        return libcamera.Size(self.world.shape[1], self.world.shape[0])

    @property
    def formats(self) -> list[str]:
        plain = f"{'R' if self.arrangement == 5 else 'SRGGB'}{self.bits}"
        return [f"{plain}_CSI2P"] if "packed" in self.faults else [plain, f"{plain}_CSI2P"]

    @property
    def known(self) -> set[str]:
        return {"SRGGB12", "R8", "R10", "R12", "R16", "R10_CSI2P", "R12_CSI2P", "MONO_PISP_COMP1"}

    def granted(self, asked: str) -> str:
        """Return the granted format: a Pi 5 replaces every request by 16-bit words or by its lossy compression."""
        unpacked = asked in self.formats and not asked.endswith("_CSI2P")
        if "compressed" in self.faults or (self.wide and not unpacked):
            return "MONO_PISP_COMP1"
        if self.wide:
            return "R16"
        return asked if asked in self.formats else self.formats[0]

    def stride(self, pixel_format: str) -> int:
        """Return the bytes of a row, padded to 32."""
        wide = self.world.shape[1] * (1 if "COMP" in pixel_format else 2)
        return -(-wide // 32) * 32 + 32

    def refuse_if_held(self) -> None:
        if self.held:
            raise RuntimeError("Pipeline handler in use by another process")
        self.held = True

    def begin(self, first: dict[str, float]) -> None:
        """Start: the first controls are in effect from the first frame."""
        self._now, self._coming = dict(first), deque([{}] * DELAY)
        self._free_s = time.monotonic()

    def expose(self, asked: dict[str, float], fd: int, stream) -> dict[str, object] | None:
        """Fill a buffer with the next frame and return its metadata; None: the frame never arrives."""
        if "stall" in self.faults:
            return None
        self._coming.append({} if "stale" in self.faults else asked)
        self._now |= self._coming.popleft()
        exposure_us = int(int(self._now["ExposureTime"] / ROW_US) * ROW_US)
        begin_s = max(self._free_s, time.monotonic())
        end_s = begin_s + exposure_us * 1e-6
        self._free_s = max(end_s, begin_s + self.shortest_frame_us * 1e-6)
        time.sleep(max(0.0, self._free_s - time.monotonic()))
        self.frames += 1
        counts = self.world.sensor.read(self._electrons(begin_s, end_s), (self.world.scene.seed, self.frames), None)
        self._write(counts, fd, stream)
        return {
            "SensorTimestamp": int(end_s * 1e9),
            "ExposureTime": exposure_us,
            "AnalogueGain": self.lowest_gain,
            "DigitalGain": 1.0,
            "FrameDuration": int((self._free_s - begin_s) * 1e6),
            "SensorBlackLevels": (int(self.world.spec.camera.black_dn) << (SHARE_16 - self.bits),) * 4,
        }

    def _electrons(self, begin_s: float, end_s: float) -> np.ndarray:
        world = self.world
        total = np.array(world.electrons(end_s - begin_s))
        for illumination, lit_s in self.lamp(begin_s, end_s):
            if illumination is not None:
                total += world.electrons_per_s(illumination.colour) * np.float32(illumination.level * lit_s)
        return total

    def _write(self, counts: np.ndarray, fd: int, stream) -> None:
        rows, cols = counts.shape
        if (str(stream.pixel_format) == "R16") != ("justified" in self.faults):
            counts = counts << (SHARE_16 - self.bits)
        with mmap.mmap(fd, stream.frame_size) as memory:
            words = np.frombuffer(memory, np.uint16).reshape(rows, stream.stride // 2)
            words[:, :cols] = counts
            words[:, cols:] = 0xA5A5  # padding, which must not be read
            del words
