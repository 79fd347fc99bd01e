"""SPI bus of the lamp, through spidev; an error names its cause, such as SPI that is not switched on."""

import errno
from pathlib import Path
from typing import Any

from device.drivers.blank import SPEED_HZ
from device.errors import LightFault

NOT_ENABLED = "Switch SPI on: add the line dtparam=spi=on to /boot/firmware/config.txt and restart the computer."
NOT_PERMITTED = "Add the user to the group that owns the device: sudo usermod -aG spi $USER, then log in again."
IN_USE = "Another program holds the lamp's bus: stop it (systemctl stop diffuscope), then try again."


def cause(device: str, kind: str, error: OSError) -> str:
    """Return the remedy of a device file that cannot be opened, by the error's number; "" for another cause.

    `kind` is "spi" or "i2c": the name of the dtparam and of the group.
    """
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        others = sorted(str(path) for path in Path("/dev").glob("spidev*.*" if kind == "spi" else "i2c-*"))
        name = "spi" if kind == "spi" else "i2c_arm"
        if others:
            return f"This computer has {', '.join(others)}: correct the device in the head file, not {device}."
        return NOT_ENABLED.replace("SPI", kind.upper()).replace("dtparam=spi=on", f"dtparam={name}=on")
    if error.errno in (errno.EACCES, errno.EPERM):
        return NOT_PERMITTED.replace("-aG spi", f"-aG {kind}")
    return IN_USE if error.errno == errno.EBUSY else ""


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
        except (OSError, ValueError) as error:
            remedy = cause(device, "spi", error) if isinstance(error, OSError) else ""
            raise LightFault(f"{device} cannot be opened: {error}", remedy) from error

    def send(self, frame: bytes) -> None:
        """Send one message; LightFault if the bus does not take all of it."""
        try:
            self._wire.writebytes2(frame)
        except (OSError, SystemError) as error:  # spidev raises SystemError for a short write
            raise LightFault(f"the lamp's bus does not take its message: {error}") from error

    def close(self) -> None:
        """Close the device."""
        self._wire.close()
