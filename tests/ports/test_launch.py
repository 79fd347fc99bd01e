"""Launcher of the instrument over emulated buses: a press over HTTP, and the bytes that it prints."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path

import httpx

from device.clock import SystemClock
from device.config.head_file import InstrumentSpec, load_head
from device.config.marked_files import stated_in
from device.drivers.blank import dark_frame
from device.drivers.ring import lit_frame
from device.head import open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.optics.matrix import chain_of, ring
from device.values import ExposureSettings, Illumination
from services.identity.setup_code import SetupCode
from services.imaging.picture_files import read_raw_tiff
from tests.ports.conftest import HEAD
from tests.ports.emulators.wires import emulated_buses

ROOT = HEAD.parents[2]
HEADS = Path(__file__).parent / "emulators" / "heads"
READY_S = 300.0  # TimeoutStartSec of the unit: the first start measures FFTs
SMALL = {"rows = 544": "rows = 136", "cols = 728": "cols = 182", "pitch_um = 6.9": "pitch_um = 27.6"}


class Launched:
    """`diffuscope run` under the launcher, in a process group as a terminal has it, with sixteen times fewer pixels."""

    def __init__(self, folder: Path) -> None:
        text = (HEADS / "emulated.toml").read_text(encoding="utf-8")
        for usual, small in SMALL.items():
            assert usual in text
            text = text.replace(usual, small)
        self.head, self.log = folder / "small.toml", folder / "log"
        self.head.write_text(text.replace("full_well_e = 40000", "full_well_e = 640000"), encoding="utf-8")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        words = ["run", "--head", str(self.head), "--port", str(port), "--data", str(folder / "data")]
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tests.ports.emulators.launch", *words],
                cwd=ROOT,
                stdout=log,
                stderr=log,
                process_group=0,
            )
        self.client = httpx.Client(base_url=f"http://127.0.0.1:{port}", headers={"X-Controller": "test"}, timeout=60)

    def wait_until_ready(self) -> None:
        end_s = time.monotonic() + READY_S
        while time.monotonic() < end_s:
            assert self.process.poll() is None, self.output
            with suppress(httpx.HTTPError):
                if self.client.get("/api/status").json()["state"] == "aim":
                    return
            time.sleep(0.05)
        raise AssertionError(self.output)

    def interrupt(self) -> int:
        """Press Ctrl-C in its terminal; return the exit status."""
        os.killpg(self.process.pid, signal.SIGINT)
        return self.process.wait(30)

    @property
    def output(self) -> str:
        return self.log.read_text(encoding="utf-8")

    def close(self) -> None:
        self.client.close()
        self.process.kill()
        self.process.wait()


def printed_messages(output: str) -> list[bytes]:
    """Return the SPI messages that were printed in full: words of four bytes, equal neighbours counted."""
    found = []
    for line in re.findall(r"^SPI .* MHz: .*\n {5}(.*)$", output, re.MULTILINE):
        runs = [run.rpartition(" x ") for run in line.split(", ")]
        found.append(b"".join(bytes.fromhex(word) * int(count or 1) for count, _, word in runs))
    return found


def ring_frames(spec: InstrumentSpec, *lights: Illumination) -> set[bytes]:
    """Return the frames that the ring's driver sends for these lights, and for darkness."""
    chain = chain_of(spec)
    assert chain is not None
    return {dark_frame(chain.rows * chain.cols), *(lit_frame(chain, ring(chain), light) for light in lights)}


def test_a_press_gives_a_simulated_picture_and_its_light_is_printed(tmp_path: Path) -> None:
    launched = Launched(tmp_path)
    try:
        launched.wait_until_ready()
        code = SetupCode(tmp_path / "data/tls", SystemClock()).create()
        user = {"name": "Asha", "secret": "274913", "code": code}
        launched.client.post("/api/setup", json=user).raise_for_status()  # real drivers have no demonstration user
        capture = launched.client.post("/api/captures", json={"eye": "OD"}).raise_for_status().json()
        at = f"/api/captures/{capture['id']}"
        picture, raw = (launched.client.get(f"{at}/{name}").content for name in ("picture.png", "raw.tiff"))
        assert launched.interrupt() == 0
    finally:
        launched.close()
    assert (capture["simulated"], stated_in("picture.png", BytesIO(picture))) == (True, True)
    metadata = read_raw_tiff(raw)[1]
    assert (metadata.simulated, metadata.illumination) == (True, Illumination("green"))
    printed, spec = printed_messages(launched.output), load_head(launched.head)
    assert set(printed) == ring_frames(spec, Illumination("green"), Illumination("red"))
    assert {printed[0], printed[-1]} == ring_frames(spec)
    assert "thermometer, 25.0 C" in launched.output
    assert "It asks for the set-up code" in launched.output


def test_a_mixed_head_lights_the_real_ring_for_a_simulated_camera() -> None:
    """The head file that is shown as an example; every frame is marked as simulated."""
    emulated_buses().set_faults("memory.blank")
    spec, clock = load_head(HEADS / "mixed.toml"), SystemClock()
    before = len(emulated_buses().messages)
    with closing(open_head(spec, clock, MemoryLedger(clock))) as head:
        dark = head.camera.expose(ExposureSettings(0.01))
        with head.light.on(Illumination("green")):
            lit = head.camera.expose(ExposureSettings(0.01))
    emulated_buses().set_faults()
    assert (dark.simulated, lit.simulated, head.kind) == (True, True, "simulated")
    assert lit.counts.mean() > dark.counts.mean() + 10  # DN
    sent = {bytes.fromhex(message["hex"]) for message in emulated_buses().messages[before:]}
    assert sent == ring_frames(spec, Illumination("green"))
