"""Sentences for the operator about the last update, for each state; and the number of waiting uploads."""

import json
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread

import pytest

from services.update.ipc import StoredError, UpdateState
from services.update.preconditions import waiting_uploads
from services.update.state import describe_state


@pytest.mark.parametrize(
    ("entry", "under_way", "words"),
    [
        (UpdateState(), False, "Version 1.0 runs."),
        (UpdateState(state="fetching", share=0.42), True, "Version 1.0 runs. Another version: fetching, 42%."),
        (
            UpdateState(state="fetching", share=0.42),
            False,
            "Version 1.0 runs. Another version was interrupted: start anew.",
        ),
        (
            UpdateState(state="installing", version="2.0", share=0.9),
            True,
            "Version 1.0 runs. Version 2.0: installing, 90%.",
        ),
        (
            UpdateState(state="installing", version="2.0", share=0.9),
            False,
            "Version 1.0 runs. Version 2.0 was interrupted: start anew.",
        ),
        (
            UpdateState(state="installed", version="2.0"),
            False,
            "Version 1.0 runs. Version 2.0 is installed and waits for `diffuscope update restart`.",
        ),
        (
            UpdateState(state="trying", version="2.0"),
            False,
            "Version 1.0 runs. Version 2.0 did not finish starting, or lost power: 1.0 is back.",
        ),
        (UpdateState(state="trying", version="1.0"), False, "Updated to 1.0. It was tried, found well, and stays."),
        (UpdateState(state="committed", version="1.0"), False, "Updated to 1.0. It was tried, found well, and stays."),
        (
            UpdateState(
                state="refused",
                trouble=StoredError(code="update.battery", message="The battery is low.", remedy="Charge it."),
            ),
            False,
            "Version 1.0 runs. The last update was not installed: The battery is low. Charge it.",
        ),
        (
            UpdateState(offered="2.0"),
            False,
            "Version 1.0 runs. Version 2.0 is offered: `diffuscope update install`.",
        ),
    ],
)
def test_each_state_has_its_sentence(entry: UpdateState, under_way: bool, words: str) -> None:
    assert describe_state(entry, "1.0", is_trying=False, under_way=under_way) == words


def test_sentence_of_a_try_names_the_version_before() -> None:
    sentence = describe_state(
        UpdateState(state="trying", version="2.0", before="1.0"), "2.0", is_trying=True, under_way=False
    )
    assert sentence == "Version 2.0 is being tried; 1.0 is back if it does not do."


@pytest.mark.parametrize(
    ("status", "waiting"),
    [({"sending": {"sent": 2, "waiting": 3}}, 3), ({"sending": None}, 0), ({}, 0), (None, 0)],
)
def test_number_of_waiting_uploads_is_read_from_the_status(status: dict[str, object] | None, waiting: int) -> None:
    """Status of this release, of one without receiver, of one without uploads, and of no instrument at all."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if status is not None else 500)
            self.end_headers()
            self.wfile.write(json.dumps(status).encode())

        def log_message(self, format: str, *args: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = Thread(target=server.handle_request)
        thread.start()
        assert waiting_uploads(f"http://127.0.0.1:{server.server_port}") == waiting
        thread.join(10)
