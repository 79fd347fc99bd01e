"""Transcript of HTTP exchanges as plain values: normalised requests and responses, binary bodies described."""

import io
import json
import zipfile
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import httpx
import tifffile
from PIL import Image

from services.http.security import SECURITY_HEADERS
from tests.golden.instrument import Instrument, until
from tests.golden.normalise import Normaliser

PAGE_RULES = {name.lower(): text for name, text in SECURITY_HEADERS.items()}
VOLATILE = {"content-length", "x-age-ms", "x-frame", "x-exposure-ms", "x-brightest", "x-mean", "x-full"}


class Transcript:
    """Exchanges with one instrument in order; the idempotency keys of requests are counted up."""

    def __init__(self, instrument: Instrument) -> None:
        self.instrument = instrument
        self.exchanges: list[dict[str, Any]] = []
        self._normaliser = Normaliser(instrument.folder)
        self._key = 0

    def ask(
        self, operation: str, path: str | None = None, note: str = "", racing: Iterable[str] = (), **options: Any
    ) -> Any:
        """Send `METHOD /api/template` (to `path` if it has parameters), record it, and return its JSON, if any.

        `racing` are keys of the answer that depend on the progress of another thread; their values are not recorded.
        """
        method, template = operation.split(" ")
        answer = self.instrument.send(method, path or template, **options)
        request: dict[str, Any] = {"to": self._normaliser.text(f"{method} {path or template}")}
        if "json" in options:
            request["json"] = self._normaliser.json(options["json"])
        if "content" in options:
            request["content"] = described_content(options["content"])
        if "headers" in options:
            request["headers"] = dict(options["headers"])
        recorded = self._answer(answer)
        for key in racing:
            assert key in recorded["body"], key
            recorded["body"][key] = "<racing>"
        self._add(operation, note, request, recorded)
        return answer.json() if "json" in answer.headers.get("content-type", "") else None

    def ask_for_live(self, operation: str, path: str | None = None) -> None:
        """Record a request for a live picture once one exists: on a busy computer that may take more than 2 s."""
        method, template = operation.split(" ")
        until(lambda: self.instrument.send(method, path or template).status_code == 200)
        self.ask(operation, path)

    def events(self, is_last: Callable[[dict[str, Any]], bool], after: int | None, note: str = "") -> None:
        """Record the server-sent events up to the first that `is_last`, without heartbeats after the first."""
        heard = self.instrument.follow(lambda events: any(map(is_last, events)), after)
        last = next(number for number, event in enumerate(heard) if is_last(event))
        kept = [event for number, event in enumerate(heard[: last + 1]) if number == 0 or event["event"] != "beat"]
        body = [{key: self._event(key, event) for key in event} for event in kept]
        request = {"to": "GET /api/events", "headers": {} if after is None else {"Last-Event-ID": str(after)}}
        self._add("GET /api/events", note, request, {"status": 200, "events": body})

    def key(self, **more: Any) -> dict[str, Any]:
        """Return a request body with a new idempotency key."""
        self._key += 1
        return {"key": f"{self._key:016x}"} | more

    def _event(self, key: str, event: Mapping[str, Any]) -> Any:
        value = event[key]
        if key != "data":
            return value
        if event["event"] == "accuracy":
            return {"progress": "<progress>"}
        return self._normaliser.json(value, "verdict" if event["event"] in ("verdict", "stage", "aim") else "")

    def _add(self, operation: str, note: str, request: dict[str, Any], response: dict[str, Any]) -> None:
        exchange: dict[str, Any] = {"operation": operation} | ({"note": note} if note else {})
        self.exchanges.append(exchange | {"request": request, "response": response})

    def _answer(self, answer: httpx.Response) -> dict[str, Any]:
        rules = {name: answer.headers.get(name) for name in PAGE_RULES}
        headers = {name: self._header(name, text) for name, text in answer.headers.items() if name not in PAGE_RULES}
        recorded: dict[str, Any] = {"status": answer.status_code, "headers": dict(sorted(headers.items()))}
        if rules != PAGE_RULES:
            recorded["page rules"] = rules
        body = self._body(answer)
        return recorded if body is None else recorded | {"body": body}

    def _header(self, name: str, text: str) -> Any:
        if name in VOLATILE:
            return "<number>"
        return self._normaliser.json(json.loads(text), name) if name == "x-aim" else self._normaliser.text(text)

    def _body(self, answer: httpx.Response) -> Any:
        kind = answer.headers.get("content-type", "").partition(";")[0]
        if not answer.content:
            return None
        if kind == "application/json":
            return self._normaliser.json(answer.json(), "report" if answer.url.path.endswith("report.json") else "")
        if kind == "image/tiff":
            return described_tiff(answer.content)
        if kind.startswith("image/") and kind != "image/svg+xml":
            return self._normaliser.json(described_image(answer.content), "report")
        if kind == "application/zip":
            return self._zip(answer.content)
        if kind == "text/plain":
            return [self._normaliser.text(line) for line in answer.text.splitlines()]
        return {"of type": kind, "begins": self._normaliser.text(answer.text[:60])}

    def _zip(self, content: bytes) -> Any:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            held = {name: archive.read(name) for name in archive.namelist()}
        read = {name: json.loads(content) if name.endswith(".json") else None for name, content in held.items()}
        sums = [
            line
            for name, content in held.items()
            if name.endswith("SHA256SUMS")
            for line in content.decode().split("\n")
        ]
        return {
            "files": {
                self._normaliser.text(name): self._normaliser.json(
                    read[name], "report" if "visit.json" not in name else ""
                )
                for name in held
            },
            "sums": [self._normaliser.text(line) for line in sums],
        }


def described_content(content: bytes) -> str:
    """Return a short text for a request body that is not sent as JSON."""
    return content.decode() if len(content) < 100 else f"{len(content)} bytes"


def described_tiff(content: bytes) -> dict[str, Any]:
    """Return shape and type of every page of a TIFF file."""
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        return {"pages": [{"shape": list(page.shape), "dtype": str(page.dtype)} for page in file.pages]}


def described_image(content: bytes) -> dict[str, Any]:
    """Return format, mode, size and notes of a PNG or JPEG file."""
    with Image.open(io.BytesIO(content)) as image:
        notes = dict(getattr(image, "text", {}))
        return {"format": image.format, "mode": image.mode, "size": list(image.size), "notes": notes}
