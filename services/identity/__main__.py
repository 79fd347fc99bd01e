"""`python -m services.identity`: run once by every boot, before the journal is kept and before there is a network."""

import sys

from device.clock import SystemClock
from services.identity.birth import born
from services.identity.boot import Computer

if __name__ == "__main__":
    computer, clock = Computer(), SystemClock()
    identity = born(computer.data / "identity", computer.serial(), clock)
    computer.becomes(identity, clock)
    sys.stdout.write(f"This device is {identity.name}, serial {identity.serial}\n")
