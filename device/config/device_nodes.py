"""Device files of the header's buses, and the remedy of one that cannot be opened, by its cause."""

import errno
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class NodeKind:
    """Kind of a device file: name, line of config.txt that makes it appear, group that may open it, file pattern.

    `switch` is None where no line is needed.
    """

    name: str
    switch: str | None
    group: str
    pattern: str

    def others(self, root: Path = Path("/")) -> list[str]:
        """Return the device files of this kind that the computer has, sorted."""
        return sorted(f"/{path.relative_to(root)}" for path in (root / "dev").glob(self.pattern))

    def remedy(self, device: str, number: int | None, root: Path = Path("/")) -> str | None:
        """Return the remedy of an error number of opening `device`; None for a cause that is not known.

        A missing file: another one is there, or the bus is not switched on. Else the group, or another program.
        """
        if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
            if others := self.others(root):
                return f"This computer has {', '.join(others)}: name one of them in the head file, not {device}."
            if self.switch is None:
                return f"A Raspberry Pi has {device} without any setting: run the program on the Raspberry Pi."
            return (
                f"Switch {self.name} on: add the line {self.switch} to /boot/firmware/config.txt, and restart the "
                "computer. `make pi` does it."
            )
        if number in (errno.EACCES, errno.EPERM):
            return f"Permit it: sudo usermod -aG {self.group} $USER, then log in again."
        if number == errno.EBUSY:
            return "Another program uses it. Stop that program, such as by systemctl stop diffuscope."
        return None


SPI = NodeKind("SPI", "dtparam=spi=on", "spi", "spidev*.*")
I2C = NodeKind("I2C", "dtparam=i2c_arm=on", "i2c", "i2c-*")
GPIO = NodeKind("GPIO", None, "gpio", "gpiochip*")
STRICT_GPIO = "dtparam=strict_gpiod"  # a line returns to input when the process that drove it has died
