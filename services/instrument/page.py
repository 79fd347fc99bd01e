"""The page's files as a browser asks for them: from memory, joined, compressed, at addresses that change with them."""

import gzip
import hashlib
from pathlib import Path

from fastapi import FastAPI, Request
from fastapi.responses import Response
from starlette.exceptions import HTTPException

from services import resources
from services.instrument.joined import joined, joined_sheet

MEDIA = {
    ".css": "text/css", ".html": "text/html", ".js": "text/javascript", ".mjs": "text/javascript",
    ".svg": "image/svg+xml",
}  # fmt: skip
PAGES = {"index.html": ("app.js", "app.css"), "technician.html": ("technician.js", "place.css")}
FOR_EVER = "public, max-age=31536000, immutable"  # other files have another address


class Files:
    """What each page is made of, by address, plain and compressed; the addresses change when any file does."""

    def __init__(self, folder: Path = resources.WEB) -> None:
        paths = sorted(path for path in folder.rglob("*") if path.suffix in MEDIA)
        texts = {path.relative_to(folder).as_posix(): path.read_text() for path in paths}
        mark = hashlib.sha256(repr(texts).encode()).hexdigest()[:12]
        self._plain: dict[str, bytes] = {}
        for shell, (module, sheet) in PAGES.items():
            at = f"web/{mark}/{Path(module).stem}/"
            own = texts | joined(module, texts.__getitem__) | {sheet: joined_sheet(sheet, texts.__getitem__)}
            self._plain |= {at + name: text.encode() for name, text in own.items() if not name.endswith(".html")}
            self._plain[shell] = texts[shell].replace('"/web/', f'"/{at}').encode()
        self._pressed = {name: gzip.compress(content, mtime=0) for name, content in self._plain.items()}

    def answer(self, request: Request, name: str, keep: str) -> Response:
        """One file, compressed for whoever understands that; `keep` says for how long it may be kept."""
        if name not in self._plain:
            raise HTTPException(404)
        headers = {"Cache-Control": keep, "Vary": "Accept-Encoding"}
        if "gzip" in request.headers.get("accept-encoding", ""):
            headers["Content-Encoding"] = "gzip"
        content = (self._pressed if "Content-Encoding" in headers else self._plain)[name]
        return Response(content, media_type=MEDIA[Path(name).suffix], headers=headers)


def page(app: FastAPI) -> None:
    """The two pages, and what they are made of; from memory, so that no thread and no disk has to be waited for."""
    files = Files()

    @app.get("/", include_in_schema=False)
    async def index(request: Request) -> Response:
        return files.answer(request, "index.html", "no-cache")

    @app.get("/technician", include_in_schema=False)
    async def technician(request: Request) -> Response:
        return files.answer(request, "technician.html", "no-cache")

    @app.get("/web/{name:path}", include_in_schema=False)
    async def part(request: Request, name: str) -> Response:
        return files.answer(request, f"web/{name}", FOR_EVER)
