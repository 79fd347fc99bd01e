"""SPI bus of the lamp, through spidev; an error names its cause, such as SPI that is not switched on."""

from typing import Any

from device.config.device_nodes import SPI
from device.drivers.blank import SPEED_HZ
from device.errors import LightFault


class SpiBus:
    """Opened SPI device in mode 0 at the lamp's speed; LightFault with the remedy of its cause."""

    def __init__(self, device: str) -> None:
        try:
            import spidev
        except Exception as error:  # of another numpy's compiled part: ValueError
            raise LightFault(
                f"spidev cannot be used: {error}", "Install it: sudo apt install python3-spidev, then make pi."
            ) from error
        self._wire: Any = spidev.SpiDev()
        try:
            bus, select = device.removeprefix("/dev/spidev").split(".")
            self._wire.open(int(bus), int(select))
            self._wire.mode = 0
            self._wire.max_speed_hz = SPEED_HZ
        except OSError as error:
            raise LightFault(f"{device} cannot be opened: {error}", SPI.remedy(device, error.errno)) from error
        except ValueError as error:
            raise LightFault(f"{device} cannot be opened: {error}") from error

    def send(self, frame: bytes) -> None:
        """Send one message; LightFault if the bus does not take all of it."""
        try:
            self._wire.writebytes2(frame)
        except (OSError, SystemError) as error:  # spidev raises SystemError for a short write
            raise LightFault(f"the lamp's bus does not take its message: {error}") from error

    def close(self) -> None:
        """Close the device."""
        self._wire.close()
