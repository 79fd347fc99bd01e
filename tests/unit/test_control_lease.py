"""Control lease: every request of a live picture renews it; it expires after the holder's last request."""

import asyncio

from device.clock import VirtualClock
from services.http.control_lease import LEASE_S, ControlLease
from services.http.dependencies import acquire_lease_for_light


def test_a_live_picture_renews_the_lease() -> None:
    clock = VirtualClock()
    lease = ControlLease(clock)
    request_light = acquire_lease_for_light(lease)
    for _ in range(3):  # longer than one request keeps the lease
        asyncio.run(request_light("mine"))
        clock.sleep(LEASE_S - 1)
        assert not lease.acquire("other").mine
    clock.sleep(1)
    assert lease.acquire("other").mine
