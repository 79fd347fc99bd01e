"""Progress of every command: what takes more than a second says what it does, or asks, serves or prints its steps."""

import socket
import time
from collections.abc import Iterator
from threading import Thread

import pytest

from services.cli import main
from services.running_time import FIRST_S
from tests.parsed_commands import parsed_commands

ASKING = "asks a person between its steps, and prints each"
STEPS = "prints each step of a computation"
WITHIN = "says it with the scene or with compiled kernels"
NOT_ANNOUNCED = {
    "run": "serves, and prints its address and its log",
    "reconstruct": WITHIN,
    "simulate": WITHIN,
    "calibrate": ASKING,
    "trial-lenses": ASKING,
    "white-card": ASKING,
    "meter": ASKING,
    "store rebuild": ASKING,
    "store backup": ASKING,
    "store restore": ASKING,
    "snapshots restore": ASKING,
    "erase patient": ASKING,
    "users add": ASKING,
    "users reset": ASKING,
    "frontier": STEPS,
    "bench": STEPS,
    "paper": STEPS,
    "hard": STEPS,
    "calibrations new-key": "writes two small files",
    "update check": STEPS,
    "update install": STEPS,
    "update restart": STEPS,
    "update settle": STEPS,
    "update answer": STEPS,
    "update tidy": STEPS,
    "update status": STEPS,
}


def test_every_command_says_what_it_does_or_is_listed_with_a_reason() -> None:
    silent = {name for name, function in parsed_commands().items() if not hasattr(function, "announced")}
    assert silent == set(NOT_ANNOUNCED)


@pytest.fixture
def slow_server() -> Iterator[str]:
    """The address of a server that answers no request before a command says that it waits."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def refuse_late() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                time.sleep(1.5 * FIRST_S)
                connection.close()

        Thread(target=refuse_late, daemon=True).start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}"


def test_a_check_that_waits_says_so(slow_server: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["health", "--at", slow_server])
    assert ended.value.code == 1
    assert "asking the instrument: 1 s\n" in capsys.readouterr().err
