"""Origin of the captures of one head on this device."""

from importlib.metadata import version
from pathlib import Path

from device.head import Head
from services.health.clock_source import clock_state
from services.records.capture import RecordOrigin
from services.records.device_identity import read_device


class CaptureOrigin:
    """Origin of each capture of a head; the source of the date may change from one to the next.

    `data`: data folder with the identity of the device; `root`: root of the file system.
    """

    def __init__(self, head: Head, data: Path, root: Path = Path("/")) -> None:
        self._device = read_device(data)
        self._root = root
        self._head = head.spec.name
        self._calibration_id = head.calibration.id
        self._calibrated_at = None if head.provenance is None else head.provenance.made_at.isoformat()

    def __call__(self) -> RecordOrigin | None:
        """Return the origin of a capture that is made now; None if the device has no identity."""
        if self._device is None:
            return None
        return RecordOrigin(
            self._device.uuid,
            self._device.serial,
            version("diffuscope"),
            self._head,
            self._calibration_id,
            self._calibrated_at,
            clock_state(self._root),
        )
