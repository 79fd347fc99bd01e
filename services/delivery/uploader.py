"""Upload of a visit archive over HTTPS (HEAD, PUT, HEAD); success means that the server's SHA-256 or length matches.

    HEAD name    404 unless an earlier attempt, whose answer was lost, has stored the archive; 401 for a wrong token
    PUT name     with If-None-Match: *, so that no file is overwritten
    HEAD name    SHA-256 of the stored file (Repr-Digest, RFC 9530), or its length

Archives are content-addressed: the name contains a part of the SHA-256 of the content, so a repeat is idempotent.
Redirects are not followed: the token goes to the configured address only.
"""

import base64
import hashlib
import ipaddress
import socket
import ssl
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from http.client import HTTPConnection, HTTPException, HTTPResponse
from pathlib import Path
from threading import Event, Timer
from typing import Protocol
from urllib.parse import SplitResult, quote, urlsplit

from pydantic import Field, field_validator

from device.config.toml_file import Table, load_toml
from device.errors import SpecError
from device.user_files import read_text
from services.errors import ReceiverUnreachable, ReceiverUntrusted, UploadMismatch, UploadRejected, UploadUnauthorised
from services.records.upload_queue import UploadReceipt

CHUNK_BYTES = 1 << 16
MAX_BODY_BYTES = 1 << 16
SUCCESS = (200, 201, 204)
PRECONDITION_FAILED = 412
RETRYABLE = (408, 425, 429)


class UploadSettings(Table):
    """Contents of the settings file of `diffuscope run --send`."""

    address: str  # URL of the receiver's folder: https://, or http:// to this computer only
    token: Path  # file with the bearer token of this device
    authority: Path | None = None  # CA file; None: the system's CAs
    through: Path | None = None  # Unix socket of a proxy, where the instrument has no network access
    answer_s: float = Field(default=30.0, gt=0, le=600)  # timeout of one answer
    most_s: float = Field(default=900.0, gt=0, le=86_400)  # timeout of one archive

    @field_validator("address")
    @classmethod
    def _is_folder_url(cls, address: str) -> str:
        url = urlsplit(address)
        if url.scheme not in ("https", "http") or not url.hostname or url.query or url.fragment or "@" in address:
            raise ValueError("give the folder of a web server, such as https://reader.example.org/inbox")
        if url.scheme == "http" and not _is_local(url.hostname):
            raise ValueError("pictures of people go over https:// only")
        if url.port == 0:
            raise ValueError("there is no port 0")
        return address.rstrip("/")

    @property
    def split_address(self) -> SplitResult:
        """Return the parsed address."""
        return urlsplit(self.address)


def _is_local(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def load_settings(path: Path) -> UploadSettings:
    """Return the upload settings in a TOML file; SpecError if the file is missing or invalid."""
    return load_toml(path, UploadSettings)


@dataclass(frozen=True)
class VisitArchive:
    """A visit as one ZIP file; `stem` is the start of its name, which ends in 16 digits of the content's SHA-256."""

    stem: str
    content: bytes

    @cached_property
    def sha256(self) -> str:
        """Return the SHA-256 of the content in hexadecimal digits."""
        return hashlib.sha256(self.content).hexdigest()

    @property
    def name(self) -> str:
        """Return the file name at the receiver: `stem`, the first 16 digits of the SHA-256, `.zip`."""
        return f"{self.stem}-{self.sha256[:16]}.zip"


class Uploader(Protocol):
    """Interface of an uploader of visit archives."""

    def upload(self, archive: VisitArchive, pause: Callable[[], None]) -> UploadReceipt:
        """Upload an archive and return the receiver's confirmation; call `pause` first and before each chunk.

        UploadError if the upload fails; an exception of `pause` cancels the upload and is passed on.
        """

    def abort(self) -> None:
        """Abort an upload in progress, from another thread."""


class HttpsUploader:
    """Uploader to a folder of a web server, over HTTPS (HTTP only to this computer)."""

    def __init__(self, settings: UploadSettings) -> None:
        self._settings = settings
        self._connection: _ReceiverConnection | None = None
        self._aborted = Event()

    def upload(self, archive: VisitArchive, pause: Callable[[], None]) -> UploadReceipt:
        """Upload an archive if it is absent; return the receiver's confirmation.

        `pause` is called first and before each chunk.
        UploadError if the upload fails or takes longer than `most_s`; an exception of `pause` is passed on.
        """
        self._aborted.clear()
        pause()  # after the clear: an `abort` of a closing worker before it is seen here, a later one by `_connected`
        timeout = Timer(self._settings.most_s, self.abort)
        timeout.daemon = True
        timeout.start()
        try:
            if (receipt := self._head(archive)) is not None:
                return receipt
            self._put(archive, pause)
            if (receipt := self._head(archive)) is None:
                raise ReceiverUnreachable(f"the receiver took {archive.name}, and does not show it")
            return receipt
        finally:
            timeout.cancel()

    def abort(self) -> None:
        """Abort an upload in progress, from another thread."""
        self._aborted.set()
        if (connection := self._connection) is not None and (sock := connection.sock) is not None:
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def _head(self, archive: VisitArchive) -> UploadReceipt | None:
        """Request the receiver's file of that name (HEAD); return its confirmation, None if there is no such file.

        UploadMismatch if its SHA-256, or without one its length, differs; another UploadError for other answers.
        """
        with self._connected() as connection:
            connection.request(
                "HEAD", self._path(archive), headers=self._auth_headers() | {"Want-Repr-Digest": "sha-256=10"}
            )
            answer = connection.getresponse()
        if answer.status in (404, 410):
            return None
        if answer.status not in SUCCESS:
            raise _status_error(answer)
        if (digest := _digest(answer)) is not None:
            if digest != archive.sha256:
                raise UploadMismatch(f"the receiver's {archive.name} has another SHA-256")
            return UploadReceipt(archive.sha256, "sha256")
        if (length := answer.headers.get("Content-Length", "unknown")) != str(len(archive.content)):
            raise UploadMismatch(
                f"the receiver's {archive.name} has a length of {length}, not of {len(archive.content)} bytes"
            )
        return UploadReceipt(archive.sha256, "length")

    def _put(self, archive: VisitArchive, pause: Callable[[], None]) -> None:
        digest = base64.b64encode(bytes.fromhex(archive.sha256)).decode()
        headers = self._auth_headers() | {
            "If-None-Match": "*",
            "Content-Type": "application/zip",
            "Content-Length": str(len(archive.content)),
            "Repr-Digest": f"sha-256=:{digest}:",
        }
        with self._connected() as connection:
            connection.putrequest("PUT", self._path(archive))
            for name, value in headers.items():
                connection.putheader(name, value)
            connection.endheaders()
            with suppress(BrokenPipeError, ConnectionResetError):  # the receiver may refuse before the end of the body
                for begin in range(0, len(archive.content), CHUNK_BYTES):
                    pause()
                    connection.send(archive.content[begin : begin + CHUNK_BYTES])
            answer = connection.getresponse()
            answer.read(MAX_BODY_BYTES)
        if answer.status not in (*SUCCESS, PRECONDITION_FAILED):
            raise _status_error(answer)

    def _path(self, archive: VisitArchive) -> str:
        return f"{self._settings.split_address.path}/{quote(archive.name)}"

    def _auth_headers(self) -> dict[str, str]:
        """Return the headers with the bearer token; UploadUnauthorised if its file is unreadable or empty.

        The token file is read at each request, because a technician may replace it.
        """
        try:
            token = read_text(self._settings.token).strip()
        except SpecError as error:
            raise UploadUnauthorised(error.message) from error
        if not token or not token.isprintable() or not token.isascii():
            raise UploadUnauthorised(f"{self._settings.token} holds no key")
        return {"Authorization": f"Bearer {token}", "Connection": "close"}

    @contextmanager
    def _connected(self) -> Iterator["_ReceiverConnection"]:
        """Open a connection for one request, which `abort` can shut down; a context manager.

        ReceiverUntrusted for an invalid certificate; ReceiverUnreachable for other network and HTTP errors.
        """
        try:
            with closing(_ReceiverConnection(self._settings, self._tls_context())) as connection:
                self._connection = connection
                connection.connect()
                if self._aborted.is_set():  # set while there was no socket to shut down
                    raise ConnectionAbortedError("the upload was aborted")
                yield connection
        except ssl.SSLCertVerificationError as error:
            raise ReceiverUntrusted(f"{self._settings.split_address.hostname}: {error.verify_message}") from error
        except (OSError, HTTPException) as error:
            raise ReceiverUnreachable(
                f"{self._settings.split_address.hostname}: {error or type(error).__name__}"
            ) from error
        finally:
            self._connection = None

    def _tls_context(self) -> ssl.SSLContext | None:
        if self._settings.split_address.scheme == "http":
            return None
        ca_file = self._settings.authority
        try:
            return ssl.create_default_context(cafile=str(ca_file) if ca_file else None)
        except (OSError, ssl.SSLError) as error:
            raise ReceiverUntrusted(f"{ca_file} cannot be read: {error}") from error


class _ReceiverConnection(HTTPConnection):
    """HTTP connection to the receiver, over TCP or the Unix socket of a proxy; with a `tls_context`, end-to-end TLS."""

    def __init__(self, settings: UploadSettings, tls_context: ssl.SSLContext | None) -> None:
        host = settings.split_address.hostname or ""
        self.default_port = 443 if tls_context else 80
        super().__init__(host, settings.split_address.port or self.default_port, timeout=settings.answer_s)
        self._tls_context = tls_context
        self._through = settings.through
        self._answer_s = settings.answer_s

    def connect(self) -> None:
        if self._through is not None:
            self.sock = plain = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            plain.settimeout(self._answer_s)
            plain.connect(str(self._through))
        else:
            plain = socket.create_connection((self.host, self.port), self._answer_s)
        self.sock = plain  # `abort` can close the socket during the TLS handshake
        if self._tls_context is not None:
            self.sock = self._tls_context.wrap_socket(plain, server_hostname=self.host)


def _digest(answer: HTTPResponse) -> str | None:
    """Return the SHA-256 (hexadecimal) in the Repr-Digest header of an answer; None without a valid one."""
    for entry in answer.headers.get("Repr-Digest", "").split(","):
        name, _, value = entry.strip().partition("=")
        if name == "sha-256" and len(value) > 2 and value[0] == value[-1] == ":":
            with suppress(ValueError):
                return base64.b64decode(value[1:-1], validate=True).hex()
    return None


def _status_error(answer: HTTPResponse) -> ReceiverUnreachable | UploadUnauthorised | UploadRejected:
    """Return the error for the HTTP status of an answer.

    UploadUnauthorised for 401 and 403; ReceiverUnreachable, which is retried, for RETRYABLE and from 500 on; else
    UploadRejected, which is permanent.
    """
    message = f"the receiver answers {answer.status} {answer.reason}"[:200]
    if answer.status in (401, 403):
        return UploadUnauthorised(message)
    if answer.status in RETRYABLE or answer.status >= 500:
        return ReceiverUnreachable(message)
    return UploadRejected(message)
