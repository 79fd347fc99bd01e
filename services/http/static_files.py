"""Static files of the pages (exam, technician, pairing): served from memory, bundled, gzip-compressed.

Each URL under /web/ contains a hash of all files (cache-busting), so browsers may cache the answer for a year.
"""

import gzip
import hashlib
from functools import cache
from pathlib import Path

from fastapi import FastAPI, Request
from fastapi.responses import Response
from starlette.exceptions import HTTPException

from device.user_files import files_in
from services import resources
from services.http.bundler import bundle_module, bundle_style_sheet

MEDIA_TYPES = {
    ".css": "text/css",
    ".html": "text/html",
    ".js": "text/javascript",
    ".json": "application/json",
    ".mjs": "text/javascript",
    ".svg": "image/svg+xml",
}
PAGES = {
    "index.html": ("app.js", "styles/app.css"),
    "technician.html": ("technician/technician.js", "styles/technician_app.css"),
    "pairing.html": ("pairing.js", "styles/pairing.css"),
}
IMMUTABLE = "public, max-age=31536000, immutable"  # cache-busting: changed files have another URL


class StaticFiles:
    """Files of all pages by URL, plain and gzip-compressed.

    All URLs except those of the HTML files change when any file changes (cache-busting).
    """

    def __init__(self, folder: Path = resources.WEB) -> None:
        paths = [path for path in files_in(folder, "**/*") if path.suffix in MEDIA_TYPES]
        texts = {path.relative_to(folder).as_posix(): path.read_text() for path in paths}
        digest = hashlib.sha256(repr(texts).encode()).hexdigest()[:12]
        self._plain: dict[str, bytes] = {}
        for html, (module, sheet) in PAGES.items():
            at = f"web/{digest}/{Path(module).stem}/"
            contents = (
                texts | bundle_module(module, texts.__getitem__) | {sheet: bundle_style_sheet(sheet, texts.__getitem__)}
            )
            self._plain |= {at + name: text.encode() for name, text in contents.items() if not name.endswith(".html")}
            self._plain[html] = texts[html].replace('"/web/', f'"/{at}').encode()
        self._compressed = {name: gzip.compress(content, mtime=0) for name, content in self._plain.items()}

    def text(self, html: str) -> str:
        """Return the text of an HTML file."""
        return self._plain[html].decode()

    def answer(self, request: Request, name: str, cache_control: str) -> Response:
        """Return the file at URL `name` (without the first slash), gzip-compressed if the browser accepts that.

        HTTPException 404 for an unknown name.
        """
        if name not in self._plain:
            raise HTTPException(404)
        headers = {"Cache-Control": cache_control, "Vary": "Accept-Encoding"}
        if "gzip" in request.headers.get("accept-encoding", ""):
            headers["Content-Encoding"] = "gzip"
        content = (self._compressed if "Content-Encoding" in headers else self._plain)[name]
        return Response(content, media_type=MEDIA_TYPES[Path(name).suffix], headers=headers)


@cache
def page_files() -> StaticFiles:
    """Return the files of all pages, read and bundled once per process: a changed file needs a restart anyway."""
    return StaticFiles()


def add_page_routes(app: FastAPI) -> None:
    """Add the pages / and /technician and their files under /web/; a request uses neither a thread nor the disk."""
    files = page_files()

    @app.get("/", include_in_schema=False)
    async def index(request: Request) -> Response:
        return files.answer(request, "index.html", "no-cache")

    @app.get("/technician", include_in_schema=False)
    async def technician(request: Request) -> Response:
        return files.answer(request, "technician.html", "no-cache")

    @app.get("/web/{name:path}", include_in_schema=False)
    async def part(request: Request, name: str) -> Response:
        return files.answer(request, f"web/{name}", IMMUTABLE)
