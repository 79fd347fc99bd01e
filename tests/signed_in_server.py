"""The program in a process of its own on `filled_store`, with a client that is signed in at its own screen."""

import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import httpx

from tests.project_files import ROOT
from tests.store_damage import PIN

START_S = 300.0  # limit of a start, on a busy computer


@contextmanager
def signed_in_server(command: Sequence[str], log: Path, port: int) -> Iterator[httpx.Client]:
    """Start the program, wait until it can aim, yield a client, and stop it; it must end without an error."""
    with (
        log.open("wb") as output,
        subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output) as process,
        closing(httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30)) as client,
    ):
        try:
            end_s = time.monotonic() + START_S
            while not aims(client):
                assert process.poll() is None, log.read_text()
                assert time.monotonic() < end_s
                time.sleep(0.1)
            assert client.post("/api/login", json={"name": "Asha", "secret": PIN}).status_code == 200
            yield client
            process.terminate()
            assert process.wait(30) == 0, log.read_text()
        finally:
            process.kill()


def aims(client: httpx.Client) -> bool:
    try:
        return bool(client.get("/api/status").json()["state"] == "aim")
    except httpx.HTTPError:
        return False
