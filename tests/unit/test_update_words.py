"""What an operator reads about the last update, in each state that it can be in."""

import json
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread

import pytest

from services.records.update_notes import Entry, Trouble
from services.update.gate import unsent
from services.update.journal import in_words


@pytest.mark.parametrize(
    ("entry", "under_way", "words"),
    [
        (Entry(), False, "Version 1.0 runs."),
        (Entry(state="fetching", share=0.42), True, "Version 1.0 runs. Another version: fetching, 42%."),
        (Entry(state="fetching", share=0.42), False, "Version 1.0 runs. Another version was interrupted: start anew."),
        (Entry(state="installing", version="2.0", share=0.9), True, "Version 1.0 runs. Version 2.0: installing, 90%."),
        (
            Entry(state="installing", version="2.0", share=0.9),
            False,
            "Version 1.0 runs. Version 2.0 was interrupted: start anew.",
        ),
        (
            Entry(state="installed", version="2.0"),
            False,
            "Version 1.0 runs. Version 2.0 is installed and waits for `diffuscope update restart`.",
        ),
        (
            Entry(state="trying", version="2.0"),
            False,
            "Version 1.0 runs. Version 2.0 did not finish starting, or lost power: 1.0 is back.",
        ),
        (Entry(state="trying", version="1.0"), False, "Updated to 1.0. It was tried, found well, and stays."),
        (Entry(state="committed", version="1.0"), False, "Updated to 1.0. It was tried, found well, and stays."),
        (
            Entry(
                state="refused",
                trouble=Trouble(code="update.battery", message="The battery is low.", remedy="Charge it."),
            ),
            False,
            "Version 1.0 runs. The last update was not installed: The battery is low. Charge it.",
        ),
        (
            Entry(offered="2.0"),
            False,
            "Version 1.0 runs. Version 2.0 is offered: `diffuscope update install`.",
        ),
    ],
)
def test_each_state_has_its_words(entry: Entry, under_way: bool, words: str) -> None:
    assert in_words(entry, "1.0", is_trying=False, under_way=under_way) == words


def test_a_try_says_what_comes_back() -> None:
    said = in_words(Entry(state="trying", version="2.0", before="1.0"), "2.0", is_trying=True, under_way=False)
    assert said == "Version 2.0 is being tried; 1.0 is back if it does not do."


@pytest.mark.parametrize(
    ("said", "waiting"),
    [({"sending": {"sent": 2, "waiting": 3}}, 3), ({"sending": None}, 0), ({}, 0), (None, 0)],
)
def test_who_waits_to_be_sent_is_told_and_refuses_nothing(said: dict[str, object] | None, waiting: int) -> None:
    """The status of this release, of one without a receiver, of one that sends nothing; and nobody who answers."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if said is not None else 500)
            self.end_headers()
            self.wfile.write(json.dumps(said).encode())

        def log_message(self, format: str, *args: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = Thread(target=server.handle_request)
        thread.start()
        assert unsent(f"http://127.0.0.1:{server.server_port}") == waiting
        thread.join(10)
