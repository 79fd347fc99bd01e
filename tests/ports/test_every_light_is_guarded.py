"""Contract of every command and endpoint: no light without the guard, and each one that lights is listed here.

The head has a real ring on emulated wires, and a radiometry so bright that the guard permits no level. So whatever
reaches the ring has gone past the guard. With the same head as it is, each command that lights must light.
"""

import ast
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
import typer
from typer.testing import CliRunner

from device.calibration.archive import Archive
from services.cli import app
from services.identity.users import FOLDER, ROLES, UserTable
from tests.golden.command_line import subcommands
from tests.ports.conftest import HEAD
from tests.ports.emulators.wires import emulated_buses
from tests.project_files import nodes, python_files, text
from tests.simulated import SMALL_SCENE, small_head_toml

ROOT = HEAD.parents[2]
READY_S = 300.0  # TimeoutStartSec of the unit
TOO_BRIGHT = "\n".join(
    ['[light.radiometry]\nmeasured = "in a test"\nguard_factor = 10']
    + [
        f"[light.radiometry.{colour}]\nwavelength_um = {um}\nretina_mw_per_cm2 = 1e9\nwaist_mw_per_cm2 = 1e9"
        for colour, um in (("red", 0.62), ("green", 0.525), ("blue", 0.465))
    ]
)
Words = tuple[str, list[str], str | None]  # command, arguments, what is typed; None: killed once the ring was lit
LIT: tuple[Words, ...] = (  # every command that lights the ring of a head
    ("doctor", ["--head", "HEAD", "--parts"], ""),
    ("meter", ["--head", "HEAD", "--seconds", "0.1", "--data", "DATA"], "y\n0.1\n"),
    ("check", ["--head", "HEAD", "--model-eye", "--archive", "ARCHIVE", "--exposure-s", "0.01"], None),
    ("trial-lenses", ["--head", "HEAD", "--archive", "ARCHIVE"], None),
    ("white-card", ["--head", "HEAD", "--archive", "ARCHIVE"], ""),
)
DARK: tuple[Words, ...] = (  # every other command that opens a part of a head
    ("calibrate", ["--head", "HEAD", "--archive", "ARCHIVE", "--serial", "DS-1"], ""),
    ("frame", ["--head", "HEAD", "-o", "FOLDER/dark.tiff"], ""),
    ("doctor", ["--head", "HEAD"], ""),
    ("check", ["--head", "HEAD", "--archive", "ARCHIVE", "--data", "DATA"], ""),
    ("calibrations use", ["ID", "--archive", "ARCHIVE", "--head", "HEAD"], ""),
    (
        "calibrations import",
        ["FOLDER/none.zip", "--archive", "ARCHIVE", "--trust", "FOLDER/none.pem", "--head", "HEAD"],
        "",
    ),
)
SERVED = {"run", "health"}  # the server, whose endpoints are tried below, and its client
WITHOUT_HEAD = {  # files, stores, simulated scenes: no part of a head is opened
    "reconstruct",
    "montage",
    "light",
    "chart",
    "simulate",
    "frontier",
    "data",
    "bench",
    "paper",
    "hard",
    "optics",
    "methods",
    "calibrations list",
    "calibrations show",
    "calibrations new-key",
    "calibrations export",
    "calibrations import-psf",
    "update check",
    "update install",
    "update restart",
    "update settle",
    "update answer",
    "update tidy",
    "update status",
    "audit verify",
    "programme check",
    "users add",
    "users list",
    "users reset",
    "label",
    "audit archive",
    "erase patient",
    "erase verify",
    "snapshots list",
    "snapshots restore",
    "store check",
    "store rebuild",
    "store copy",
    "store research",
    "store backup",
    "store restore",
    "archive plan",
    "archive run",
    "archive report",
    "archive adopt",
}
OPENERS = {"open_head", "open_bench", "open_light", "head_memory", "probe", "HeadOpener"}  # of device/head.py
OPENING = {  # every module outside device/head.py that calls one of them, and its commands
    "services/health/doctor.py": "doctor",
    "services/workshop/power_meter.py": "meter",
    "services/workshop/model_eye.py": "check",
    "services/workshop/check_head.py": "check",
    "services/workshop/take_frames.py": "frame",
    "services/workshop/trial_lens_check.py": "trial-lenses",
    "services/workshop/white_card_check.py": "white-card",
    "services/workshop/calibrate_head.py": "calibrate",
    "services/workshop/calibration_archive.py": "calibrations use",
    "services/http/server.py": "run",
    "services/instrument/head_arbiter.py": "run",
    "services/instrument/guided_run.py": "run",
}
LIT_ENDPOINTS = {"POST /api/captures", "GET /api/preview", "POST /api/calibration/trial-lenses/ready"}
MAIN = [sys.executable, "-c", "from services.cli import main; main()"]
PIN = "274913"
ENDPOINTS = 58  # at least: a new one is tried without a change here


def wait_until(holds: Callable[[], bool]) -> None:
    end_s = time.monotonic() + READY_S
    while not holds():
        assert time.monotonic() < end_s, "timeout"
        time.sleep(0.02)


def command_names() -> set[str]:
    """Return every command of the command line by its words."""

    def below(group: Any, words: str) -> Iterator[str]:
        for name, command in subcommands(group):
            if subcommands(command):
                yield from below(command, f"{words}{name} ")
            else:
                yield f"{words}{name}"

    return set(below(typer.main.get_command(app), ""))


def test_every_command_is_listed_by_its_light() -> None:
    lit, dark = ({name for name, *_ in table} for table in (LIT, DARK))
    assert command_names() == lit | dark | SERVED | WITHOUT_HEAD
    assert not (lit | dark | SERVED) & WITHOUT_HEAD


def test_every_module_that_opens_a_head_is_listed_by_its_command() -> None:
    found = {
        name
        for name in python_files("device", "services")
        if name != "device/head.py" and any(opener in text(name) for opener in OPENERS)
        for node in nodes(text(name))
        if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in OPENERS
    }
    assert found == set(OPENING)
    assert set(OPENING.values()) | {"calibrations import"} == {name for name, *_ in (*LIT, *DARK)} | {"run"}


class Heads:
    """Two head files, as they are and with light that is never permitted, and an archive with their calibration."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.archive = folder, folder / "archive"
        self.usual, self.too_bright = folder / "usual.toml", folder / "too_bright.toml"
        mixed = small_head_toml("Mixed head", SMALL_SCENE, 2, 0.01).replace(
            '[light]\nbackend = "sim"', '[light]\nbackend = "apa102"\n[light.chain]'
        )
        self.usual.write_text(mixed, encoding="utf-8")
        self.too_bright.write_text(f"{mixed}\n{TOO_BRIGHT}\n", encoding="utf-8")

    def run(self, head: Path, name: str, words: list[str], typed: str | None) -> list[dict[str, Any]]:
        """Run a command in this process; return the messages to the ring that light an LED."""
        places = {"HEAD": str(head), "ARCHIVE": str(self.archive), "DATA": str(self.folder / "data")}
        if "ID" in words:
            places["ID"] = Archive(self.archive).active_id()
        given = [places.get(word, word.replace("FOLDER", str(self.folder))) for word in words]
        before = len(emulated_buses().messages)
        if typed is None and head == self.usual:
            self._until_lit([*name.split(), *given], before)
        else:
            self.result = CliRunner().invoke(app, [*name.split(), *given], input=typed)
            assert "Usage:" not in self.result.output
        assert not emulated_buses().lit
        return [message for message in emulated_buses().messages[before:] if message["lit"]]

    def _until_lit(self, words: list[str], before: int) -> None:
        """Run a command as a process, and kill it once the ring has been lit: its computations are not needed."""
        with subprocess.Popen(
            [*MAIN, *words], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as process:
            wait_until(
                lambda: (
                    process.poll() is not None or any(message["lit"] for message in emulated_buses().messages[before:])
                )
            )
            process.kill()
        wait_until(lambda: not emulated_buses().lit)


@pytest.fixture(scope="module")
def heads(tmp_path_factory: pytest.TempPathFactory) -> Heads:
    emulated_buses().set_faults()
    made = Heads(tmp_path_factory.mktemp("heads"))
    assert made.run(made.usual, *DARK[0]) == []
    assert made.result.exit_code == 0, made.result.output
    return made


@pytest.mark.parametrize("command", LIT, ids=lambda words: words[0])
def test_a_command_lights_the_ring_within_the_guard_only(heads: Heads, command: Words) -> None:
    assert heads.run(heads.usual, *command)
    assert heads.run(heads.too_bright, *command) == []


@pytest.mark.parametrize("command", DARK[1:], ids=lambda words: words[0])
def test_a_command_without_light_leaves_the_ring_dark(heads: Heads, command: Words) -> None:
    assert heads.run(heads.usual, *command) == []


class Server:
    """`diffuscope run` with a head whose light is never permitted, and a client of a user with every role.

    A head with a real lamp has no demonstration user.
    """

    def __init__(self, heads: Heads) -> None:
        head = heads.folder / "served.toml"
        table = f'\n[calibration]\narchive = "{heads.archive}"\n'
        head.write_text(heads.too_bright.read_text(encoding="utf-8") + table, encoding="utf-8")
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        UserTable(heads.folder / "served" / FOLDER).add("Asha", PIN, ROLES)
        words = ["run", "--head", str(head), "--port", str(port), "--data", str(heads.folder / "served")]
        self.process = subprocess.Popen([*MAIN, *words], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.client = httpx.Client(base_url=f"http://127.0.0.1:{port}", headers={"X-Controller": "a test"}, timeout=20)
        self.ask = self.client.request

    def wait(self) -> None:
        wait_until(self._is_ready)
        assert self.ask("POST", "/api/login", json={"name": "Asha", "secret": PIN}).is_success

    def _is_ready(self) -> bool:
        with suppress(httpx.HTTPError):
            return bool(self.ask("GET", "/api/status").json()["state"] == "aim")
        return False

    def operations(self) -> list[tuple[str, str]]:
        """Return method and path of every endpoint; that which ends the login is the last one."""
        paths = self.ask("GET", "/api/openapi.json").json()["paths"]
        found = [(method.upper(), path) for path, methods in paths.items() for method in methods]
        return sorted(found, key=lambda operation: operation == ("DELETE", "/api/login"))

    def lenses(self) -> dict[str, Any]:
        found: dict[str, Any] = self.ask("GET", "/api/calibration").json()
        return found

    def close(self) -> None:
        self.client.close()
        self.process.kill()
        self.process.wait()


@pytest.fixture
def server(heads: Heads) -> Iterator[Server]:
    made = Server(heads)
    try:
        made.wait()
        yield made
    finally:
        made.close()


def test_no_endpoint_lights_the_ring_past_the_guard(server: Server) -> None:
    """Those that light try to, and are refused by the guard; every other one is asked as well."""
    before, names = len(emulated_buses().messages), {"id": "x", "name": "raw.tiff", "eye": "OD"}
    pressed = server.ask("POST", "/api/captures", json={"eye": "OD"})
    assert pressed.json()["code"] == "light.limit"
    assert server.ask("POST", "/api/calibration/trial-lenses", json={}).is_success
    wait_until(lambda: server.lenses()["lenses"]["state"] == "asking")
    assert server.ask("POST", "/api/calibration/trial-lenses/ready", json={"lens": 0}).is_success
    wait_until(lambda: server.lenses()["lenses"]["error"] is not None)
    assert "brighter than an eye may see" in server.lenses()["lenses"]["error"]["message"]
    tried = set()
    for method, path in server.operations():
        body = {} if method == "GET" else {"json": {}}
        with server.client.stream(method, path.format_map(names), **body) as answer:
            assert answer.status_code != 405
        tried.add(f"{method} {path}")
    assert tried >= LIT_ENDPOINTS
    assert len(tried) >= ENDPOINTS
    assert not [message for message in emulated_buses().messages[before:] if message["lit"]]
