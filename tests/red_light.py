"""Camera of a simulated head that takes no frame in red light, for captures without colour."""

from typing import Any

from device.errors import CameraStalled
from device.ports import Camera
from device.sim.camera import SimCamera
from device.values import ExposureSettings, Frame


class FailsInRed:
    """Camera that takes no long frame in red light while `fails`; `reds` counts these frames.

    A live picture, which is shorter than `shortest_s`, is in red light, too.
    """

    def __init__(self, camera: Camera, shortest_s: float = 0.08) -> None:
        assert isinstance(camera, SimCamera)
        self._camera, self._world, self._shortest_s = camera, camera.world, shortest_s
        self.fails, self.reds = False, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def expose(self, shot: ExposureSettings) -> Frame:
        """Return a frame; CameraStalled in red light."""
        illumination = self._world.illumination
        if illumination is not None and illumination.colour == "red" and shot.exposure_s > self._shortest_s:
            self.reds += 1
            if self.fails:
                raise CameraStalled("no frame came")
        return self._camera.expose(shot)
