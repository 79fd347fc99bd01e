"""A folder on a real web server, over real HTTPS, which hangs up when it is told to."""

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
    """A folder on a web server; `cuts` are the bytes after which it hangs up, one for each request to come."""

    at: str
    files: dict[str, bytes]
    cuts: list[int] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    knows_ranges: bool = True


def identity(folder: Path) -> tuple[Path, Path]:
    """A certificate for localhost, which vouches for itself, and its key."""
    certificate, key = folder / "web.crt", folder / "web.key"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", certificate, "-days", "30",
         "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"],
        check=True, capture_output=True,
    )  # fmt: skip
    return certificate, key


@contextmanager
def served(certificate: Path, key: Path) -> Iterator[Site]:
    known = Site("", {})

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            content = known.files.get(self.path.lstrip("/"))
            known.asked.append(self.headers.get("Range", "all"))
            if content is None:
                self.send_error(404)
                return
            begin = int(known.asked[-1][6:-1]) if known.knows_ranges and known.asked[-1] != "all" else 0
            self.send_response(206 if begin else 200)
            self.send_header("Content-Length", str(len(content) - begin))
            self.end_headers()
            self.wfile.write(content[begin:][: known.cuts.pop(0) if known.cuts else None])

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    server.socket = context.wrap_socket(server.socket, server_side=True)
    known.at = f"https://localhost:{server.server_port}"
    Thread(target=server.serve_forever, daemon=True).start()
    yield known
    server.shutdown()
    server.server_close()


def signed(keys: Path, content: bytes) -> bytes:
    """A channel's file, as services/update/README.md tells how to make it."""
    words = ["openssl", "cms", "-sign", "-nodetach", "-binary", "-outform", "DER"]
    signer = ["-signer", str(keys / "signer.crt"), "-inkey", str(keys / "signer.key")]
    return subprocess.run([*words, *signer], input=content, check=True, capture_output=True).stdout
