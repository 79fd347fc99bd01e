"""An eye hangs on this: the owner of the light is killed, stopped or hangs for real, and the wire is dark in time.

`make bench-kills` does the same two hundred times and prints a table.
"""

import os
import time

import numpy as np
import pytest

from device.drivers.wire import encoded
from tests.ports.emulators.bus.client import Seen, the_bus
from tests.ports.emulators.bus.rig import real_ring
from tests.ports.emulators.kills import DEADLY, LINGERING, death, shone_s


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("way", DEADLY)
def test_all_leds_are_dark_a_tenth_of_a_second_after_the_owner_died(way, seed):
    died = death(the_bus(), way, seed)
    assert died.shone_s <= 0.1, died


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("way", LINGERING)
def test_all_leds_are_dark_when_the_lease_of_an_owner_that_lingers_is_over(way, seed):
    died = death(the_bus(), way, seed)
    assert died.shone_s <= died.allowed_s, died


def test_an_owner_that_lights_up_after_its_lease_is_darkened_again():
    """Stopped between the promise and the light, and continued much later."""
    bus, ring = the_bus(), real_ring()
    ring.guardian.lit(0.05)
    time.sleep(0.15)
    wire = os.open("/dev/spidev0.0", os.O_RDWR)
    os.write(wire, encoded(np.full((64, 3), 9, np.uint8)))
    time.sleep(0.15)
    os.close(wire)
    assert not bus.lit()
    ring.close()


def test_the_judge_knows_light_from_darkness():
    def seen(*lit):
        return [Seen(float(at), leds, 4_000_000, 268) for at, leds in enumerate(lit)]

    assert shone_s(seen(0, 0, 8), 2.5) == float("inf")
    assert shone_s(seen(0, 8, 8, 0, 0), 0.0) == 2.0
    assert shone_s(seen(0, 8, 8, 0, 0), 2.5) == 0.5
    assert shone_s(seen(0, 8, 0, 0), 2.5) == 0.0
