"""Limits by client: addresses, counts, and which connection is dropped for a new one."""

from dataclasses import dataclass

import pytest

from device.clock import VirtualClock
from services.errors import ServerFull
from services.http.client_limits import Client, ClientCounts, ClientLimits
from services.http.connection_limits import ConnectionLimits, ConnectionTable

SCREEN = Client.at("127.0.0.1")
TABLET, PHONE = Client.at("10.42.0.7"), Client.at("10.42.0.8")


@dataclass(eq=False)
class FakeConnection:
    """Connection of a client; `is_late`: a time-out is over."""

    remote_client: Client
    has_unsent_bytes: bool = False
    is_late: bool = False
    is_dropped: bool = False

    def is_sending(self) -> bool:
        return self.has_unsent_bytes

    def is_overdue(self, now_s: float) -> bool:
        return self.is_late

    def drop(self) -> None:
        self.is_dropped = True


def table_of(*connections: FakeConnection, local: int = 3, remote: int = 3, per_address: int = 2) -> ConnectionTable:
    table = ConnectionTable(ConnectionLimits(ClientLimits(local, remote, per_address)), VirtualClock())
    for connection in connections:
        table.add(connection)
    return table


@pytest.mark.parametrize(
    ("left", "right", "is_same", "is_local"),
    [
        ("127.0.0.1", "127.0.0.1", True, True),
        ("::1", "::1", True, True),
        ("127.0.0.1", "127.0.0.2", False, True),
        ("::ffff:127.0.0.1", "127.0.0.1", True, True),
        ("::ffff:10.42.0.7", "10.42.0.7", True, False),
        ("fd00::1", "fd00::ffff:2", True, False),
        ("fd00::1", "fd00:0:0:1::1", False, False),
        ("10.42.0.7", "10.42.0.8", False, False),
        ("testclient", "testclient", True, False),
    ],
)
def test_a_client_is_an_ipv4_address_or_an_ipv6_network_of_64_bits(
    left: str, right: str, is_same: bool, is_local: bool
) -> None:
    assert (Client.at(left) == Client.at(right), Client.at(left).is_local) == (is_same, is_local)


def test_remote_clients_and_one_address_have_limits_of_their_own() -> None:
    counts = ClientCounts(ClientLimits(local=2, remote=3, per_address=2))
    with counts.admitted(TABLET), counts.admitted(TABLET):
        with pytest.raises(ServerFull) as refused:
            counts.admitted(TABLET).__enter__()
        assert refused.value.wait_s == 5
        with counts.admitted(PHONE):
            with pytest.raises(ServerFull):
                counts.admitted(Client.at("10.42.0.9")).__enter__()
            with counts.admitted(SCREEN), counts.admitted(SCREEN), pytest.raises(ServerFull):
                counts.admitted(SCREEN).__enter__()
        with counts.admitted(PHONE):
            pass
    with counts.admitted(TABLET), counts.admitted(TABLET):
        pass


def test_the_connection_that_waited_longest_is_dropped_for_a_new_one() -> None:
    first, second, third, new = (FakeConnection(SCREEN) for _ in range(4))
    table = table_of(first, second, third)
    table.set_waiting(first, False)  # a request, which is answered
    table.set_waiting(first, True)
    table.add(new)
    assert [connection.is_dropped for connection in (first, second, third, new)] == [False, True, False, False]
    assert len(table) == 3


def test_a_connection_that_is_answered_is_never_dropped_for_a_new_one() -> None:
    sending, asking, other = FakeConnection(SCREEN, has_unsent_bytes=True), *(FakeConnection(SCREEN) for _ in range(2))
    table = table_of(sending, asking, other)
    for connection in (asking, other):
        table.set_waiting(connection, False)
    new, later = FakeConnection(SCREEN), FakeConnection(SCREEN)
    table.add(new)
    assert [connection.is_dropped for connection in (sending, asking, other, new)] == [False, False, False, True]
    table.remove(asking)
    table.add(later)
    assert not later.is_dropped


def test_an_address_at_its_limit_gets_no_place_of_another_one() -> None:
    screen, tablet = FakeConnection(SCREEN), FakeConnection(TABLET)
    phone = [FakeConnection(PHONE) for _ in range(4)]
    table = table_of(screen, tablet, *phone)
    assert [connection.is_dropped for connection in (screen, tablet, *phone)] == [
        False,
        False,
        False,
        False,
        True,
        True,
    ]
    assert [table.is_refused(client) for client in (SCREEN, TABLET, PHONE)] == [False, False, True]


def test_remote_connections_never_take_the_place_of_a_local_one() -> None:
    screen = [FakeConnection(SCREEN) for _ in range(3)]
    strangers = [FakeConnection(Client.at(f"10.42.0.{k}")) for k in range(9)]
    table = table_of(*screen, *strangers)
    assert not any(connection.is_dropped for connection in screen)
    assert sum(connection.is_dropped for connection in strangers) == 6
    assert len(table) == 6


def test_overdue_connections_are_dropped_once() -> None:
    late, patient = FakeConnection(SCREEN), FakeConnection(SCREEN)
    table = table_of(late, patient)
    table.drop_overdue()
    assert len(table) == 2
    late.is_late = True
    table.drop_overdue()
    assert (late.is_dropped, patient.is_dropped, len(table)) == (True, False, 1)
    table.remove(late)
    assert len(table) == 1
