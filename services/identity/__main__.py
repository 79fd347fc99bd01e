"""Entry point `python -m services.identity`, run once per boot before the journal is flushed and the network starts."""

import sys

from device.clock import SystemClock
from services.identity.apply_at_boot import Computer
from services.identity.apply_settings import CardBoot
from services.identity.provision import load_or_create_identity

if __name__ == "__main__":
    computer = Computer()
    identity = load_or_create_identity(computer.data / "identity", computer.serial(), SystemClock())
    computer.apply_identity(identity)
    if (problem := CardBoot().run()) is not None:
        sys.stderr.write(f"The settings of the card were not taken: {problem.message}\n{problem.remedy}\n")
    sys.stdout.write(f"This device is {identity.name}, serial {identity.serial}\n")
