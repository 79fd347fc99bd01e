"""`make bench`, part `preview`: live reconstructed pictures a second and their age, at the real server over HTTP.

From replayed frames, whose camera costs nothing, and from the simulated head, whose camera computes each exposure. The
lamp is off for at least as long as it was on, so that no more than one picture in two exposures is possible.
"""

import http.client
import shutil
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import urlsplit

import numpy as np

from tests.bench.timing import head, row
from tests.browser.conftest import ROOT, Server

ASKED_S, MIN_PER_S, FRAMES = 8.0, 15.0, 4
SCENE = ROOT / "device" / "sim" / "scenes" / "diabetic.toml"


def preview() -> None:
    """Print pictures a second and the age of a picture when it arrives, milliseconds."""
    head("live pictures while aiming, 1080 x 1920", "a second", "asked", "age p50", "age p95")
    with TemporaryDirectory() as folder:
        sources = {
            "replayed frames": ("--replay", str(recording(Path(folder) / "recording"))),
            "simulated head": ("--head", "hardware/heads/sim.toml"),
        }
        for name, (kind, source) in sources.items():
            server = Server(Path(folder) / name, source, kind)
            server.start()
            try:
                server.wait_until_ready()
                per_s, ages_ms = watched(server.url)
            finally:
                server.stop()
            row(name, per_s, MIN_PER_S, *(float(np.percentile(ages_ms, q)) for q in (50, 95)))


def recording(folder: Path) -> Path:
    """Return a folder with FRAMES simulated raw frames and their PSF."""
    made = folder.parent / "scene"
    command = [str(Path(sys.executable).parent / "diffuscope"), "simulate", str(SCENE), "-o", str(made)]
    subprocess.run(command, check=True, capture_output=True)
    folder.mkdir()
    shutil.copy(made / "psf.tiff", folder)
    for k in range(FRAMES):
        shutil.copy(made / "raw.tiff", folder / f"raw-{k}.tiff")
    return folder


def watched(url: str) -> tuple[float, list[float]]:
    """Ask for live pictures for ASKED_S, after the first one; return pictures a second and their ages in ms."""
    client = http.client.HTTPConnection(urlsplit(url).netloc, timeout=60)
    number, ages_ms = ask(client, 0), list[float]()
    begin_s, seen = time.perf_counter(), 0
    while time.perf_counter() - begin_s < ASKED_S:
        number = ask(client, number, ages_ms)
        seen += 1
    per_s = seen / (time.perf_counter() - begin_s)
    client.close()
    return per_s, ages_ms


def ask(client: http.client.HTTPConnection, after: int, ages_ms: list[float] | None = None) -> int:
    """Return the number of the next live picture; its age when it has arrived is appended to `ages_ms`."""
    while True:
        sent_s = time.perf_counter()
        client.request("GET", f"/api/preview?after={after}", headers={"X-Controller": "bench"})
        answer = client.getresponse()
        answer.read()
        if answer.status == 200:
            break
        if answer.status != 204 and answer.status != 503:
            raise AssertionError(f"{answer.status} {answer.reason}")
        time.sleep(max(0.0, 0.2 - (time.perf_counter() - sent_s)))
    if ages_ms is not None:
        ages_ms.append(float(answer.headers["X-Age-Ms"]))
    return int(answer.headers["X-Frame"])
