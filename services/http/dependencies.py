"""Dependencies of endpoints: the control lease of a screen."""

from collections.abc import Awaitable, Callable
from typing import Annotated

from fastapi import Header, Request

from services.http.control_lease import ControlLease
from services.http.security import SAFE_METHODS


def acquire_control_lease(lease: ControlLease) -> Callable[..., None]:
    """Return the dependency that acquires or renews the control lease for the screen of a changing request.

    ControlLeaseHeld if another screen holds the lease. Safe requests (GET, HEAD, OPTIONS) and those to /api/controller
    pass; with the holder's key in `X-Controller` they renew the lease.
    """

    def acquire(request: Request, x_controller: Annotated[str | None, Header(max_length=64)] = None) -> None:
        if request.method in SAFE_METHODS or request.url.path == "/api/controller":
            lease.renew(x_controller or "")
        else:
            lease.acquire_or_refuse(x_controller)

    return acquire


def acquire_lease_for_light(lease: ControlLease) -> Callable[..., Awaitable[None]]:
    """Return the dependency that acquires or renews the control lease for a request that lights the lamp.

    ControlLeaseHeld if another screen holds the lease, for a request without a key if any screen does.
    """

    async def acquire(x_controller: Annotated[str | None, Header(max_length=64)] = None) -> None:
        lease.acquire_for_light(x_controller)

    return acquire
