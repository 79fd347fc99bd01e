"""Limits of event streams and of waits for a live picture: by client, with 503 beyond, without worker threads."""

import asyncio
import http.client
from contextlib import ExitStack, closing
from typing import Any

import httpx
from fastapi import Request

from services.errors import ServerFull
from services.http.app import create_app
from services.http.authentication import OWN_SCREEN
from services.http.client_limits import STREAM_LIMITS, ClientLimits, limit_clients
from services.http.connection_limits import ConnectionLimits
from tests.journey.conftest import Rig, until
from tests.journey.serving import served

TWO_LOCAL = ClientLimits(local=2, remote=2, per_address=1)
MORE_THAN_WORKERS = 60  # AnyIO has 40 worker threads for endpoints that block
OWN_PAGE = {"Sec-Fetch-Site": "same-origin"}


def client_of(app: Any, host: str) -> httpx.AsyncClient:
    """Return a client of an application in this process, at the given address."""
    transport = httpx.ASGITransport(app=app, client=(host, 50000))
    return httpx.AsyncClient(transport=transport, base_url="http://diffuscope.local", timeout=30, headers=OWN_PAGE)


def test_more_event_streams_than_permitted_are_refused_until_one_ends(rig: Rig) -> None:
    app = create_app(rig.arbiter, rig.authenticator, stream_limits=TWO_LOCAL).http
    with served(app, ConnectionLimits()) as (port,), ExitStack() as undo:

        def open_stream() -> tuple[http.client.HTTPConnection, http.client.HTTPResponse]:
            connection = undo.enter_context(closing(http.client.HTTPConnection("127.0.0.1", port, timeout=10)))
            connection.request("GET", "/api/events")
            return connection, connection.getresponse()

        (first, events), (_, more_events) = open_stream(), open_stream()
        assert [events.readline(), more_events.readline()] == [b"event: beat\n"] * 2
        _, third = open_stream()
        assert (third.status, third.headers["Retry-After"]) == (503, "5")
        assert b'"code":"link.full"' in third.read()
        events.close()
        first.close()
        until(lambda: open_stream()[1].status == 200)
        rig.event_bus.close()


def test_the_streams_of_remote_users_leave_the_own_screen_its_own() -> None:
    admitted, streams = limit_clients(STREAM_LIMITS), []

    async def is_opened(host: str) -> bool:
        streams.append(admitted(Request({"type": "http", "client": (host, 50000)})))
        try:
            await anext(streams[-1])
        except ServerFull:
            return False
        return True

    async def opened(hosts: list[str]) -> int:
        return sum([await is_opened(host) for host in hosts])

    async def both() -> tuple[int, int]:
        return await opened([f"10.42.0.{number}" for number in range(40)]), await opened(["127.0.0.1"] * 40)

    assert asyncio.run(both()) == (16, 16)


def test_remote_clients_do_not_take_the_live_picture_from_a_local_one(rig: Rig) -> None:
    """One wait for each remote address and two for all of them; the waits of the device's own screen are its own."""
    rig.block_exposures()
    rig.authenticator.users.add("Asha", "274913", ["administrator", "technician"])
    own = {"Cookie": f"login={rig.authenticator.sign_in('Asha', '274913', OWN_SCREEN)}"}
    app = create_app(rig.arbiter, rig.authenticator, preview_limits=TWO_LOCAL).http

    async def preview_statuses(*hosts: str) -> list[int]:
        clients = [client_of(app, host) for host in hosts]
        waits = [asyncio.create_task(client.get("/api/preview?after=0", headers=own)) for client in clients]
        answers = await asyncio.gather(*waits)
        return [answer.status_code for answer in answers]

    remote = ("10.42.0.7", "10.42.0.7", "10.42.0.8", "10.42.0.9")
    statuses = asyncio.run(preview_statuses(*remote, "127.0.0.1", "127.0.0.1", "127.0.0.1"))
    assert statuses == [204, 503, 204, 503, 204, 204, 503]
    assert asyncio.run(preview_statuses("10.42.0.7")) == [204], "a limit counts present waits only"
    rig.clock.gate.set()


def test_waits_for_a_live_picture_hold_no_worker_thread(rig: Rig) -> None:
    rig.block_exposures()
    many = ClientLimits(*[MORE_THAN_WORKERS] * 3)
    app = create_app(rig.arbiter, rig.authenticator, preview_limits=many).http

    async def status_among_waits() -> tuple[int, int]:
        async with client_of(app, "127.0.0.1") as client:
            waits = [asyncio.create_task(client.get("/api/preview?after=0")) for _ in range(MORE_THAN_WORKERS)]
            await asyncio.sleep(0.5)
            status = (await client.get("/api/status")).status_code
            ended = sum(wait.done() for wait in waits)
            await asyncio.gather(*waits)
        return status, ended

    assert asyncio.run(status_among_waits()) == (200, 0)
    rig.clock.gate.set()
