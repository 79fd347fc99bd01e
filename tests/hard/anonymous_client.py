"""Client without a login, run on another host: every request of a list in several forms, then what blocks a server.

`python -m tests.hard.anonymous_client` reads a `Target` as JSON from the standard input and writes a `Report`. It
trusts the authority of the device, as a paired tablet does.
"""

import socket
import ssl
import sys
import time
from collections import Counter
from contextlib import ExitStack, closing, suppress
from typing import Any

import httpx
from pydantic import BaseModel

GUESSED = "a" * 43
FORMS: dict[str, dict[str, str]] = {  # headers by form of a request
    "no login": {},
    "screen of the page": {"X-Controller": "0" * 16, "Sec-Fetch-Site": "same-origin"},
    "guessed login": {"Cookie": f"__Host-login={GUESSED}; login={GUESSED}", "X-Controller": "0" * 16},
    "as if from the device": {"X-Forwarded-For": "127.0.0.1", "Forwarded": "for=127.0.0.1", "X-Real-IP": "127.0.0.1"},
    "another method": {"X-HTTP-Method-Override": "GET", "X-Controller": "0" * 16},
}
BODY_BYTES = 200  # of an answer, which are reported
CONNECTIONS, STREAMS, PREVIEWS, GUESSES, VISITS = 300, 40, 40, 100, 100


class Asked(BaseModel):
    """One request: method, path with its query, JSON body if any."""

    method: str
    path: str
    body: Any = None


class Target(BaseModel):
    """A device: its address, ports of the page and of pairing, port of its own screen, and the authority (PEM).

    `requests` are sent in every form. `secret_hex`: texts, bytes of pictures and names, that no answer may contain.
    """

    address: str
    tls_port: int
    pairing_port: int
    own_port: int
    authority: str
    requests: list[Asked]
    secret_hex: list[str]


class Report(BaseModel):
    """Numbers of answers by status for each form and attempt; the requests that succeeded, and those with a secret."""

    answers: dict[str, dict[str, int]]
    succeeded: list[str]
    disclosed: list[str]


class AnonymousClient:
    """The client and its counts."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self.trusted = ssl.create_default_context(cadata=target.authority)
        self.answers: dict[str, Counter[str]] = {}
        self.succeeded, self.disclosed = set[str](), set[str]()
        self._secrets = [bytes.fromhex(one) for one in target.secret_hex]

    def send(self, client: httpx.Client, form: str, asked: Asked, **headers: str) -> None:
        """Send one request and note its answer."""
        content = {} if asked.body is None else {"json": asked.body}
        try:
            with client.stream(asked.method, asked.path, headers=headers, **content) as answer:
                body = b"" if "event-stream" in answer.headers.get("content-type", "") else answer.read()
                self.note(form, asked, str(answer.status_code), body)
        except httpx.HTTPError as error:
            self.note(form, asked, type(error).__name__, b"")

    def note(self, form: str, asked: Asked, status: str, body: bytes) -> None:
        """Count an answer; keep the request if it succeeded, or if the body has something secret."""
        self.answers.setdefault(form, Counter())[status] += 1
        if status.startswith("2"):
            self.succeeded.add(f"{form}: {asked.method} {asked.path}")
        if any(secret in body for secret in self._secrets):
            self.disclosed.add(f"{form}: {asked.method} {asked.path}: {body[:BODY_BYTES]!r}")

    def walk(self) -> None:
        """Send all requests by TLS in every form, then by plain HTTP to each port."""
        target = self.target
        with httpx.Client(base_url=f"https://{target.address}:{target.tls_port}", verify=self.trusted) as client:
            for form, headers in FORMS.items():
                for asked in target.requests:
                    self.send(client, form, asked, **headers)
        for form, port in (
            ("plain HTTP, pairing", target.pairing_port),
            ("plain HTTP, page", target.tls_port),
            ("plain HTTP, port of the own screen", target.own_port),
        ):
            with httpx.Client(base_url=f"http://{target.address}:{port}") as client:
                for asked in target.requests:
                    self.send(client, form, asked)

    def block(self) -> None:
        """Guess a PIN, ask for visits, live pictures and streams, then hold connections for some seconds."""
        target = self.target
        with httpx.Client(base_url=f"https://{target.address}:{target.tls_port}", verify=self.trusted) as client:
            for number in range(GUESSES):
                guess = Asked(method="POST", path="/api/login", body={"name": "Asha", "secret": f"{number:06}"})
                self.send(client, "guesses", guess)
            for number in range(VISITS):
                self.send(client, "visits", Asked(method="POST", path="/api/visits", body={"key": f"{number:016x}"}))
        with ExitStack() as undo:
            opened = [self._connection(undo) for _ in range(CONNECTIONS)]
            self.answers["connections"] = Counter("open" if one is not None else "refused" for one in opened)
            for path, times in (("/api/events", STREAMS), ("/api/preview?after=999999", PREVIEWS)):
                for connection in [one for one in opened if one is not None][:times]:
                    with suppress(OSError):
                        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: {target.address}\r\n\r\n".encode())
            sys.stdout.write("blocking\n")
            sys.stdout.flush()
            sys.stdin.readline()

    def _connection(self, undo: ExitStack) -> socket.socket | None:
        """Return a connection, every second one with its TLS handshake; None if it is refused."""
        try:
            found = socket.create_connection((self.target.address, self.target.tls_port), timeout=2)
            if undo.enter_context(closing(found)).fileno() % 2:
                found = undo.enter_context(
                    closing(self.trusted.wrap_socket(found, server_hostname=self.target.address))
                )
        except OSError:
            return None
        return found


def main() -> None:
    """Walk, block until a further line comes, and report."""
    anonymous = AnonymousClient(Target.model_validate_json(sys.stdin.readline()))
    anonymous.walk()
    time.sleep(1.0)
    anonymous.block()
    succeeded, disclosed = sorted(anonymous.succeeded), sorted(anonymous.disclosed)
    counted = {form: dict(counts) for form, counts in anonymous.answers.items()}
    report = Report(answers=counted, succeeded=succeeded, disclosed=disclosed)
    sys.stdout.write(report.model_dump_json() + "\n")


if __name__ == "__main__":
    main()
