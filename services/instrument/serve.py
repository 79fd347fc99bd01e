"""Bring the parts together and serve them: socket first, so that a port in use is said before anything is opened."""

import os
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import uvicorn

from device.clock import SystemClock
from device.errors import InputError
from device.head import open_head
from device.spec import InstrumentSpec
from services.instrument.api import create_app
from services.instrument.bulletin import Bulletin
from services.instrument.exam import Exam
from services.records.store import Store


def bound(host: str, port: int) -> socket.socket:
    """A listening address of our own; InputError if somebody else has it."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listener = socket.socket(family, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
    except OSError as error:
        raise InputError(
            f"http://{host}:{port} cannot be served: {error.strerror or error}",
            f"Another program uses it, perhaps this one. Stop that, or choose another with --port {port + 1}.",
        ) from error
    return listener


def serve(spec: InstrumentSpec, host: str, port: int, data: Path, ready: Callable[[], None]) -> None:
    """Open the head and the shelf, say `ready`, and serve the page until it is told to stop."""
    clock = SystemClock()
    with bound(host, port) as listener, Store(data) as store:
        head = open_head(spec, clock)
        try:
            exam = Exam(head, store, Bulletin(), clock, data / "plans", _stop_the_process)
        except BaseException:
            head.close()
            raise
        config = uvicorn.Config(create_app(exam), log_level="warning", timeout_graceful_shutdown=1)
        try:
            ready()
            uvicorn.Server(config).run(sockets=[listener])
        finally:
            exam.close()


def _stop_the_process() -> None:
    os.kill(os.getpid(), signal.SIGTERM)  # the server closes its connections and what it holds; systemd starts it anew
