"""How a parcel gets to the receiver: one PUT over HTTPS, and sent is only what the receiver was then seen to have.

    HEAD name    is it there already, from a try whose answer was lost? May we come in at all?
    PUT name     If-None-Match: *, so that nothing is ever written over
    HEAD name    its SHA-256 if the receiver tells it (Repr-Digest, RFC 9530), else its length

A name holds the digest of its content, so whatever is repeated is the same. No redirect is followed: the key goes to
the address that was set up, and nowhere else.
"""

import base64
import hashlib
import ipaddress
import socket
import ssl
import tomllib
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from http.client import HTTPConnection, HTTPException, HTTPResponse
from pathlib import Path
from threading import Timer
from typing import Protocol
from urllib.parse import SplitResult, quote, urlsplit

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from device.errors import SendLocked, SendRejected, SendUnlike, SendUnreachable, SendUntrusted, SpecError
from services.records.outbox import Receipt

PIECE_BYTES = 1 << 16
MOST_SAID_BYTES = 1 << 16
TAKEN, THERE_ALREADY = (200, 201, 204), 412
LATER = (408, 425, 429)


class SendSettings(BaseModel):
    """What the file of `diffuscope run --send` may say."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    address: str  # of the receiver's folder: https://, or http:// to this very computer
    token: Path  # a file with the key by which the receiver knows this device
    authority: Path | None = None  # who vouches for the receiver, if not the usual ones
    through: Path | None = None  # a Unix socket that leads there, where the instrument has no network of its own
    answer_s: float = Field(default=30.0, gt=0, le=600)  # so long may it be silent
    most_s: float = Field(default=900.0, gt=0, le=86_400)  # so long may one parcel take

    @field_validator("address")
    @classmethod
    def _leads_to_a_folder(cls, address: str) -> str:
        there = urlsplit(address)
        if (
            there.scheme not in ("https", "http")
            or not there.hostname
            or there.query
            or there.fragment
            or "@" in address
        ):
            raise ValueError("give the folder of a web server, such as https://reader.example.org/inbox")
        if there.scheme == "http" and not _is_here(there.hostname):
            raise ValueError("pictures of people go over https:// only")
        if there.port == 0:
            raise ValueError("there is no port 0")
        return address.rstrip("/")

    @property
    def there(self) -> SplitResult:
        """The address in its parts."""
        return urlsplit(self.address)


def _is_here(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def load_settings(path: Path) -> SendSettings:
    """The settings in a file; SpecError if it is not there or says what cannot be."""
    try:
        return SendSettings(**tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, ValidationError) as error:
        raise SpecError(f"{path}: {error}", "Correct the file that is given with --send, or leave it out.") from error


@dataclass(frozen=True)
class Parcel:
    """A visit as one file; its name is fixed by the visit and by what is in it."""

    stem: str
    content: bytes

    @cached_property
    def sha256(self) -> str:
        """Of the content, in hexadecimal digits."""
        return hashlib.sha256(self.content).hexdigest()

    @property
    def name(self) -> str:
        """Under which the receiver keeps it."""
        return f"{self.stem}-{self.sha256[:16]}.zip"


class Carrier(Protocol):
    """A way to the receiver."""

    def deliver(self, parcel: Parcel, pause: Callable[[], None]) -> Receipt:
        """Bring it there, and say how that was seen; calls `pause` between pieces. Raises a SendError."""

    def abort(self) -> None:
        """Let a delivery under way fail, from another thread."""


class Https:
    """A folder on a web server, over HTTPS."""

    def __init__(self, settings: SendSettings) -> None:
        self._said = settings
        self._line: _Line | None = None

    def deliver(self, parcel: Parcel, pause: Callable[[], None]) -> Receipt:
        """Bring it there, and say how that was seen; calls `pause` between pieces. Raises a SendError."""
        late = Timer(self._said.most_s, self.abort)
        late.daemon = True
        late.start()
        try:
            if (there := self._seen(parcel)) is not None:
                return there
            self._put(parcel, pause)
            if (there := self._seen(parcel)) is None:
                raise SendUnreachable(f"the receiver took {parcel.name}, and does not show it")
            return there
        finally:
            late.cancel()

    def abort(self) -> None:
        """Let a delivery under way fail, from another thread."""
        if (line := self._line) is not None and (sock := line.sock) is not None:
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def _seen(self, parcel: Parcel) -> Receipt | None:
        """What the receiver has under that name; None if nothing, SendUnlike if something else."""
        with self._open() as line:
            line.request("HEAD", self._path(parcel), headers=self._own() | {"Want-Repr-Digest": "sha-256=10"})
            answer = line.getresponse()
        if answer.status in (404, 410):
            return None
        if answer.status not in TAKEN:
            raise _refused(answer)
        if (told := _digest(answer)) is not None:
            if told != parcel.sha256:
                raise SendUnlike(f"the receiver's {parcel.name} has another SHA-256")
            return Receipt(parcel.sha256, "sha256")
        if (length := answer.headers.get("Content-Length", "unknown")) != str(len(parcel.content)):
            raise SendUnlike(
                f"the receiver's {parcel.name} has a length of {length}, not of {len(parcel.content)} bytes"
            )
        return Receipt(parcel.sha256, "length")

    def _put(self, parcel: Parcel, pause: Callable[[], None]) -> None:
        digest = base64.b64encode(bytes.fromhex(parcel.sha256)).decode()
        own = self._own() | {
            "If-None-Match": "*", "Content-Type": "application/zip", "Content-Length": str(len(parcel.content)),
            "Repr-Digest": f"sha-256=:{digest}:",
        }  # fmt: skip
        with self._open() as line:
            line.putrequest("PUT", self._path(parcel))
            for name, value in own.items():
                line.putheader(name, value)
            line.endheaders()
            with suppress(BrokenPipeError, ConnectionResetError):  # who refuses it may say so before its end
                for begin in range(0, len(parcel.content), PIECE_BYTES):
                    pause()
                    line.send(parcel.content[begin : begin + PIECE_BYTES])
            answer = line.getresponse()
            answer.read(MOST_SAID_BYTES)
        if answer.status not in (*TAKEN, THERE_ALREADY):
            raise _refused(answer)

    def _path(self, parcel: Parcel) -> str:
        return f"{self._said.there.path}/{quote(parcel.name)}"

    def _own(self) -> dict[str, str]:
        """By what the receiver knows this device; asked of the file each time, for a technician may renew it."""
        try:
            token = self._said.token.read_text(encoding="ascii").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise SendLocked(f"{self._said.token} cannot be read: {error}") from error
        if not token or not token.isprintable():
            raise SendLocked(f"{self._said.token} holds no key")
        return {"Authorization": f"Bearer {token}", "Connection": "close"}

    @contextmanager
    def _open(self) -> Iterator["_Line"]:
        """One connection for one question; whatever fails on the way is a link that failed, or a wrong certificate."""
        try:
            with closing(_Line(self._said, self._trust())) as line:
                self._line = line
                line.connect()
                yield line
        except ssl.SSLCertVerificationError as error:
            raise SendUntrusted(f"{self._said.there.hostname}: {error.verify_message}") from error
        except (OSError, HTTPException) as error:
            raise SendUnreachable(f"{self._said.there.hostname}: {error or type(error).__name__}") from error
        finally:
            self._line = None

    def _trust(self) -> ssl.SSLContext | None:
        if self._said.there.scheme == "http":
            return None
        given = self._said.authority
        try:
            return ssl.create_default_context(cafile=str(given) if given else None)
        except (OSError, ssl.SSLError) as error:
            raise SendUntrusted(f"{given} cannot be read: {error}") from error


class _Line(HTTPConnection):
    """A connection to the receiver: straight, or through a socket of this computer; encrypted to its very end."""

    def __init__(self, said: SendSettings, trust: ssl.SSLContext | None) -> None:
        host = said.there.hostname or ""
        self.default_port = 443 if trust else 80
        super().__init__(host, said.there.port or self.default_port, timeout=said.answer_s)
        self._trust, self._through, self._answer_s = trust, said.through, said.answer_s

    def connect(self) -> None:
        if self._through is not None:
            self.sock = plain = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            plain.settimeout(self._answer_s)
            plain.connect(str(self._through))
        else:
            plain = socket.create_connection((self.host, self.port), self._answer_s)
        self.sock = plain  # so that it can be ended while it shakes hands
        if self._trust is not None:
            self.sock = self._trust.wrap_socket(plain, server_hostname=self.host)


def _digest(answer: HTTPResponse) -> str | None:
    """The SHA-256 that an answer tells of what it speaks of."""
    for one in answer.headers.get("Repr-Digest", "").split(","):
        name, _, value = one.strip().partition("=")
        if name == "sha-256" and len(value) > 2 and value[0] == value[-1] == ":":
            with suppress(ValueError):
                return base64.b64decode(value[1:-1], validate=True).hex()
    return None


def _refused(answer: HTTPResponse) -> SendUnreachable | SendLocked | SendRejected:
    """What a status means to who sends."""
    said = f"the receiver answers {answer.status} {answer.reason}"[:200]
    if answer.status in (401, 403):
        return SendLocked(said)
    if answer.status in LATER or answer.status >= 500:
        return SendUnreachable(said)
    return SendRejected(said)
