"""Simulated camera, a noisy sensor model that reads the electrons of a `World`."""

import numpy as np
from numpy.typing import NDArray

from device.errors import CameraMissing, CameraStalled, FrameError
from device.sim.plan import simulated_effects
from device.sim.world import World
from device.values import ExposureSettings, Frame

STALL_S = 1.0  # timeout of a frame after its exposure


class SimCamera:
    """Simulated camera of `world`: frames are numbered from 1 and marked as simulated."""

    def __init__(self, world: World) -> None:
        self.world = world
        self._open = True
        self._check()

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of every frame."""
        return self.world.shape

    @property
    def facts(self) -> dict[str, str]:
        """Empty: a simulated sensor has no driver to report."""
        return {}

    def expose(self, shot: ExposureSettings, into: NDArray[np.uint16] | None = None) -> Frame:
        """Return one frame whose exposure began after this call; `into` (rows, cols) is filled if given.

        Returns when the exposure time is over: what the simulation computes falls within it, as a sensor takes none of
        the processor's time. A lamp that changed meanwhile counts as it is at the end. Raises CameraMissing,
        CameraStalled, or FrameError if `into` does not fit. With the fault "camera.mode" the counts are a new array of
        every other row and column.
        """
        self._check()
        if into is not None and (into.shape != self.shape or into.dtype != np.uint16):
            raise FrameError(f"the buffer is {into.dtype} {into.shape}; this sensor fills uint16 {self.shape}")
        world = self.world
        begin_s = world.clock.now_s()
        lamp = world.illumination
        counts = self._read(shot, begin_s, into)
        world.clock.sleep(begin_s + shot.exposure_s - world.clock.now_s())
        if world.has_fault("camera.stalled"):
            world.clock.sleep(STALL_S)
            raise CameraStalled(f"the simulated camera gave no frame within {shot.exposure_s + STALL_S:.2g} s")
        if world.illumination != lamp:
            counts = self._read(shot, begin_s, into)
        world.frames += 1
        world.lit_frames += world.illumination is not None
        if world.has_fault("camera.mode"):
            counts = counts[::2, ::2].copy()
        return Frame(counts, shot.exposure_s, world.frames, world.illumination, True, simulated_effects(world.plan))

    def prepare(self, shot: ExposureSettings) -> None:
        """Compute the light of the eye for frames of this length, not later while the lamp is lit."""
        if self.world.target is None:
            self.world.eyes.render_burst(self.world.eye, shot.exposure_s)

    def _read(self, shot: ExposureSettings, begin_s: float, into: NDArray[np.uint16] | None) -> NDArray[np.uint16]:
        """Return the counts of the next frame, whose exposure began at `begin_s` of the clock."""
        world = self.world
        return world.sensor.read(world.electrons(shot.exposure_s, begin_s), (world.scene.seed, world.frames + 1), into)

    def close(self) -> None:
        """Close the camera, so that later exposures raise CameraMissing; idempotent."""
        self._open = False

    def _check(self) -> None:
        """Raise CameraMissing if the camera is closed or has the fault "camera.missing"."""
        if not self._open:
            raise CameraMissing("the simulated camera has been closed")
        if self.world.has_fault("camera.missing"):
            raise CameraMissing("the simulated camera does not answer")
