"""Pairing page over plain HTTP: how a tablet comes to trust the device, its authority, and nothing else."""

from pathlib import Path
from string import Template
from typing import Literal

from fastapi import FastAPI, Request, Response
from fastapi.responses import FileResponse, HTMLResponse
from starlette.exceptions import HTTPException

from services.http.problem_responses import problem_response, register_error_handlers
from services.http.security import CrossOriginProtection, SecurityHeaders, own_host_names
from services.http.static_files import IMMUTABLE, page_files
from services.identity.certificates import fingerprint
from services.identity.renewal import AUTHORITY


def pairing_app(tls: Path, https_port: int) -> FastAPI:
    """Return the application of the pairing page; `tls`: folder of the authority, `https_port`: of the page itself."""
    app = FastAPI(openapi_url=None, redirect_slashes=False)
    register_error_handlers(app)
    files = page_files()
    stated = {"FINGERPRINT": fingerprint((tls / AUTHORITY).read_bytes()), "PORT": str(https_port)}

    @app.get("/")
    async def page() -> Response:
        return HTMLResponse(Template(files.text("pairing.html")).substitute(stated))

    @app.get("/web/{name:path}")
    async def part(request: Request, name: str) -> Response:
        if "/pairing/" not in name:
            raise HTTPException(404)
        return files.answer(request, f"web/{name}", IMMUTABLE)

    @app.get("/{name}.crt")
    def authority(name: Literal["authority", "authority-unconstrained"]) -> Response:
        return FileResponse(tls / f"{name}.crt", media_type="application/x-x509-ca-cert", filename=f"{name}.crt")

    app.add_middleware(CrossOriginProtection, names=own_host_names(), answer=problem_response)
    app.add_middleware(SecurityHeaders)
    return app
