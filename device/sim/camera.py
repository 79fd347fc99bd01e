"""The simulated sensor: it reads what arrives in the shared world, with the noise of a real one."""

import numpy as np
from numpy.typing import NDArray

from device.errors import CameraMissing, CameraStalled, FrameError
from device.sim.world import World
from device.values import Frame, Shot

STALL_S = 1.0  # how long past its exposure a frame is waited for


class SimCamera:
    """A camera in a World: frames are numbered, fresh, and marked as simulated."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._open = True
        self._check()

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of every frame."""
        return self._world.shape

    def expose(self, shot: Shot, into: NDArray[np.uint16] | None = None) -> Frame:
        """Take one frame whose exposure began after this call; `into` (rows, cols) is filled if it is given.

        Raises CameraMissing, CameraStalled, or FrameError if `into` does not fit.
        """
        self._check()
        if into is not None and (into.shape != self.shape or into.dtype != np.uint16):
            raise FrameError(f"the buffer is {into.dtype} {into.shape}; this sensor fills uint16 {self.shape}")
        world = self._world
        world.clock.sleep(shot.exposure_s)
        if world.broken("camera.stalled"):
            world.clock.sleep(STALL_S)
            raise CameraStalled(f"the simulated camera gave no frame within {shot.exposure_s + STALL_S:.2g} s")
        world.frames += 1
        seed = (world.seed, world.frames)
        counts = world.sensor.read(world.electrons(shot.exposure_s), seed, into)
        if world.broken("camera.mode"):
            counts = counts[::2, ::2].copy()
        return Frame(counts, shot.exposure_s, world.frames, world.glow, simulated=True)

    def prepare(self, shot: Shot) -> None:
        """Nothing to do: every exposure has its own time."""

    def close(self) -> None:
        """Release the sensor; closing twice is harmless."""
        self._open = False

    def _check(self) -> None:
        if not self._open:
            raise CameraMissing("the simulated camera has been closed")
        if self._world.broken("camera.missing"):
            raise CameraMissing("the simulated camera does not answer")
