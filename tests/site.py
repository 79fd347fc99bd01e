"""HTTPS server for a folder, with aborted transfers on request."""

import ssl
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread


@dataclass
class Site:
    """Folder on a web server; `cuts` are the numbers of bytes after which the next transfers abort.

    `moved`: URLs to which requests of a name are redirected.
    """

    url: str
    files: dict[str, bytes]
    cuts: list[int] = field(default_factory=list)
    moved: dict[str, str] = field(default_factory=dict)
    requested_ranges: list[str] = field(default_factory=list)
    supports_ranges: bool = True


def identity(folder: Path) -> tuple[Path, Path]:
    """Create a self-signed certificate for localhost and its key."""
    certificate, key = folder / "web.crt", folder / "web.key"
    subprocess.run(
        [
            "openssl",
            "req",
            "-x509",
            "-newkey",
            "rsa:2048",
            "-nodes",
            "-keyout",
            key,
            "-out",
            certificate,
            "-days",
            "30",
            "-subj",
            "/CN=localhost",
            "-addext",
            "subjectAltName=DNS:localhost",
        ],
        check=True,
        capture_output=True,
    )
    return certificate, key


@contextmanager
def serve(certificate: Path, key: Path) -> Iterator[Site]:
    """Serve a site over HTTPS until the context ends."""
    site = Site("", {})

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if (moved := site.moved.get(self.path.lstrip("/"))) is not None:
                self.send_response(302)
                self.send_header("Location", moved)
                self.end_headers()
                return
            content = site.files.get(self.path.lstrip("/"))
            site.requested_ranges.append(self.headers.get("Range", "all"))
            if content is None:
                self.send_error(404)
                return
            begin = (
                int(site.requested_ranges[-1][6:-1])
                if site.supports_ranges and site.requested_ranges[-1] != "all"
                else 0
            )
            self.send_response(206 if begin else 200)
            self.send_header("Content-Length", str(len(content) - begin))
            self.end_headers()
            self.wfile.write(content[begin:][: site.cuts.pop(0) if site.cuts else None])

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    server.socket = context.wrap_socket(server.socket, server_side=True)
    site.url = f"https://localhost:{server.server_port}"
    Thread(target=server.serve_forever, daemon=True).start()
    yield site
    server.shutdown()
    server.server_close()


def signed(keys: Path, content: bytes) -> bytes:
    """Sign a channel's file as services/update/README.md describes."""
    words = ["openssl", "cms", "-sign", "-nodetach", "-binary", "-outform", "DER"]
    signer = ["-signer", str(keys / "signer.crt"), "-inkey", str(keys / "signer.key")]
    return subprocess.run([*words, *signer], input=content, check=True, capture_output=True).stdout
