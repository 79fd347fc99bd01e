"""Parameters of every command, and exit code and output of good and bad calls, in one process of fixed width.

The words of help and of errors stand in one place, the source: of an error only the number of lines is recorded.
"""

import io
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import typer

from services.cli import app, main
from tests.golden import compare
from tests.golden.instrument import HEAD
from tests.golden.normalise import Normaliser
from tests.progress_lines import without_progress
from tests.project_files import ROOT

WIDTH = "100"
START = "from tests.golden.command_line import print_made; print_made()"
UNSET = (
    "FORCE_COLOR",
    "GITHUB_ACTIONS",
    "PY_COLORS",
    "CLICOLOR_FORCE",
    "TTY_COMPATIBLE",
    "NOTIFY_SOCKET",
    "LISTEN_PID",
)
CALLS = (  # ordered: later calls use the files of earlier ones
    "",
    "fly",
    "--version",
    "methods",
    "methods --rows 136 --cols 240",
    "methods --rows 0",
    "chart -o {0}/chart.svg",
    "optics",
    "optics --sensor imx296",
    "optics --sensor none",
    "optics --head {0}/head.toml --sensor imx296",
    "simulate {0}/head.toml --explain",
    "simulate {0}/head.toml -o {0}/scene",
    "simulate {0}/head.toml",
    "simulate {0}/none.toml -o {0}/scene",
    "simulate {0}/head.toml --explain --only moonlight",
    "reconstruct {0}/scene/raw.tiff --psf {0}/scene/psf.tiff --head {0}/head.toml --method gradient -o {0}/x.npy",
    "reconstruct {0}/scene/raw.tiff --psf {0}/scene/psf.tiff -o {0}/x.npy --method guess",
    "reconstruct {0}/scene/raw.tiff --psf {0}/scene/psf.tiff -o {0}/x.bmp",
    "reconstruct {0}/scene/raw.tiff --psf {0}/scene/psf.tiff -o {0}/x.npy --budget-s 0",
    "reconstruct {0}/scene/raw.tiff -o {0}/x.npy",
    "reconstruct {0}/none.tiff --psf {0}/scene/psf.tiff -o {0}/x.npy",
    "reconstruct {0}/scene/raw.tiff --psf {0}/none.tiff -o {0}/x.npy",
    "reconstruct",
    "reconstruct --channel violet {0}/scene/raw.tiff {0}/scene/psf.tiff -o {0}/x.npy",
    "montage {0}/none.tiff -o {0}/x.npy",
    "run --head {0}/none.toml",
    "run --port 0",
    "run --head {0}/head.toml --replay {0}",
    "run --head {0}/head.toml --send {0}/none.toml",
    "run --head {0}/head.toml --programme {0}/none.toml",
    "health --at http://127.0.0.1:9",
    "health --at http://127.0.0.1:9 --json",
    "health --at nonsense",
    "doctor --parts --head {0}/head.toml",
    "doctor --parts",
    "doctor --head {0}/none.toml",
    "frame --head {0}/none.toml -o {0}/f.tiff",
    "frame --head {0}/head.toml -o {0}/f.bmp",
    "meter",
    "meter --head {0}/none.toml",
    "light --head {0}/none.toml --axis-uw 1 --waist-mw-per-cm2 1 --peak-nm 525 --meter M",
    "light",
    "check --head {0}/head.toml",
    "check --head {0}/head.toml --archive {0}/none",
    "calibrate --head {0}/head.toml",
    "calibrate --head {0}/head.toml --archive {0}/a --colours mauve",
    "trial-lenses --head {0}/head.toml",
    "trial-lenses --head {0}/head.toml --archive {0}/a --vertex-mm 40",
    "white-card --head {0}/head.toml",
    "white-card --head {0}/head.toml --archive {0}/a",
    "label --data {0}/head.toml",
    "erase patient X1 --data {0}/none --receipt {0}/receipt.json --yes",
    "erase patient X1 --data {0}/none --receipt {0}/none/receipt.json",
    "erase verify {0}/none --data {0}/audited",
    "audit verify",
    "audit verify --data {0}/audited",
    "audit archive {0}/entries.jsonl --data {0}/audited",
    "programme check {0}/none.toml",
    "users add Asha --role pilot --data {0}/audited",
    "users list",
    "users reset Asha --data {0}/audited --secret-file {0}/none",
    "archive plan {0}/scene -o {0}/plan.toml --rounds 2",
    "archive plan {0}/none -o {0}/plan.toml",
    "archive plan {0}/scene -o {0}/plan.toml --rounds 2 --budget-s 1",
    "archive plan",
    "archive run",
    "archive run {0}/plan.toml -o {0}/results --workers 0",
    "archive report",  # with or without Dask
    "archive adopt",
    "archive adopt {0}/none --data {0}/none",
    "frontier --json {0}/f.json --plot {0}/f.svg",
    "frontier --json {0}/f.json --plot {0}/f.svg --repeats 0",
    "frontier --data {0}/scene --scene {0}/head.toml --json {0}/f.json --plot {0}/f.svg",
    "data {0}/scene",
    "data {0}/scene --check --psf {0}/none.tiff",
    "data {0}",
    "data {0}/none",
    "data",
    "bench {0}/scene --method guess --no-peers",
    "bench {0}/none",
    "calibrations",
    "calibrations list --archive {0}/a",
    "calibrations new-key {0}/key --name Ada",
    "calibrations new-key {0}/key --name Ada",
    "calibrations import-psf {0}/scene/psf.tiff --archive {0}/a --by Ada --source bench",
    "calibrations import-psf {0}/none.tiff --archive {0}/a --by Ada --source bench",
    "calibrations list --archive {0}/a",
    "calibrations show {1} --archive {0}/a",
    "calibrations show 0000 --archive {0}/a",
    "calibrations export {1} {0}/e.zip --archive {0}/a --key {0}/key",
    "calibrations export {0}/e.zip --archive {0}/a --key {0}/none",
    "calibrations export a b c --archive {0}/a --key k",
    "calibrations import {0}/e.zip --archive {0}/b --trust {0}/key.pub",
    "calibrations import {0}/head.toml --archive {0}/b --trust {0}/key.pub",
    "calibrations use {1} --archive {0}/b",
    "calibrations use 0000 --archive {0}/b",
    "snapshots",
    "snapshots list --data {0}/none",
    "snapshots restore x --data {0}/none --yes",
    "store",
    "store check --data {0}/none",
    "store rebuild --data {0}/none --yes",
    "store copy x --data {0}/none -o {0}/none-copied",
    "store research --data {0}/none -o {0}/none-research",
    "store research --data {0}/none -o {0}",
    "store backup --to {0}/none --data {0}/none",
    "store restore --from {0}/none --data {0}/none",
    "update",
    "update status --settings {0}/none.toml",
    "update check --settings {0}/none.toml",
    *(f"update {word} --settings {{0}}/none.toml" for word in ("restart", "settle", "answer", "tidy")),
    "update install {0}/none.raucb --settings {0}/none.toml",
)
EXPERIMENTS = (["paper"], ["hard"])  # commands that only start one of the programs below
PROGRAMS = (  # of units, of RAUC and of experiments, each in a separate process
    "-m services.update --help",
    "-m services.update fly",
    "device/drivers/blank.py --help",
    "device/drivers/blank.py",
    "device/drivers/blank.py --device {0}/none",
    "services/update/bootchooser.py fly",
    "-m tests.paper --help",
    "-m tests.paper -o {0}/paper --only nothing",
    "-m tests.hard --help",
    "-m tests.hard -o {0}/hard --case nothing",
    "-m tests.hard -o {0}/hard --method guess",
)


def record() -> dict[str, Any]:
    """Return the parameters of each command and the calls, made by a process with a terminal of 100 columns."""
    with TemporaryDirectory() as temporary:
        folder = Path(temporary).resolve()
        command = [sys.executable, "-c", START, str(folder)]
        done = subprocess.run(command, cwd=ROOT, env=_environment(folder), capture_output=True, text=True, check=True)
        normaliser = Normaliser(folder)
        made: dict[str, Any] = json.loads(done.stdout)
        made["programs"] = [_program(words, folder) for words in PROGRAMS]
        return {kind: _plain(value, normaliser) for kind, value in made.items()}


def _environment(folder: Path) -> dict[str, str]:
    """Return an environment with new folders, and without variables that change colours or widths."""
    kept = {name: value for name, value in os.environ.items() if name not in UNSET}
    own = {"HOME": folder, "XDG_CACHE_HOME": folder / "cache", "XDG_DATA_HOME": folder / "data"}
    fixed = {"COLUMNS": WIDTH, "TERMINAL_WIDTH": WIDTH, "TERM": "dumb", "NO_COLOR": "1", "LC_ALL": "C.UTF-8"}
    return kept | fixed | {name: str(path) for name, path in own.items()} | {"PYTHONPATH": str(ROOT)}


def _program(words: str, folder: Path) -> dict[str, Any]:
    command = [sys.executable, *words.format(folder).split()]
    done = subprocess.run(command, cwd=ROOT, env=_environment(folder), capture_output=True, text=True, check=False)
    return {"call": f"python {words.format(folder)}", "exit": done.returncode, "out": done.stdout, "err": done.stderr}


def _plain(value: Any, normaliser: Normaliser, key: str = "") -> Any:
    """Return a value with texts as lists of lines and runs of blanks as two, and of errors their number of lines.

    Measured numbers in `out` become placeholders.
    """
    if isinstance(value, dict):
        return {name: _plain(entry, normaliser, name) for name, entry in value.items()}
    if isinstance(value, list):
        return [_plain(entry, normaliser, key) for entry in value]
    if not isinstance(value, str):
        return value
    if key == "call":
        return normaliser.text(value)
    if value.lstrip().lower().startswith("usage:"):
        return "<help>"
    lines = [
        normaliser.text(line.rstrip().replace(version("diffuscope"), "<version>"))
        for line in without_progress(value).splitlines()
    ]
    if key == "out":
        lines = [re.sub(r"(?<![\w.])-?\d+\.\d+(e-?\d+)?(?![\w.])", "<number>", line) for line in lines]
        lines = [re.sub(r"((?:simulated|skipped) +\S+ +)\d+ ", r"\1<ms> ", line) for line in lines]
    if key == "err":
        return len([line for line in lines if line])
    return [re.sub(r" {2,}", "  ", line) for line in lines if line]


def commands() -> Iterator[tuple[list[str], Any]]:
    """Yield the words of every command and subcommand, and the command; the words of the first are empty."""

    def below(command: Any, words: list[str]) -> Iterator[tuple[list[str], Any]]:
        yield words, command
        for name, inner in subcommands(command):
            yield from below(inner, [*words, name])

    yield from below(typer.main.get_command(app), [])


def subcommands(command: Any) -> list[tuple[str, Any]]:
    """Return the commands of a group by their names; none for a single command."""
    if not hasattr(command, "list_commands"):
        return []
    context = command.make_context("diffuscope", [], resilient_parsing=True)
    return [(name, command.get_command(context, name)) for name in command.list_commands(context)]


def parameters(command: Any) -> list[dict[str, Any]]:
    """Return the parameters of a command: names, type, limits, default, and whether it is required or repeated."""
    return [
        {
            "names": [*parameter.opts, *parameter.secondary_opts],
            "type": parameter.type_descriptor.annotation.__name__,
            "limits": [parameter.min, parameter.max],
            "default": None if parameter.default is None else str(parameter.default),
            "required": parameter.required,
            "repeated": parameter.multiple or parameter.nargs == -1,
        }
        for parameter in command.params
    ]


def called(words: list[str]) -> dict[str, Any]:
    """Call the command line in this process; return exit code and output."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            main(words)
            code: Any = 0
        except SystemExit as ended:
            code = ended.code
    return {"exit": code or 0, "out": out.getvalue(), "err": err.getvalue()}


def _made(folder: Path) -> dict[str, Any]:
    """Return the part of the record that one process makes."""
    (folder / "head.toml").write_text(HEAD)
    shown = {
        " ".join(["diffuscope", *words]): {
            "parameters": parameters(command),
            "exit of --help": called([*words, "--help"])["exit"],
        }
        for words, command in commands()
        if words not in EXPERIMENTS
    }
    calls = []
    for call in CALLS:
        kept = [path.name for path in (folder / "a").glob("*") if len(path.name) == 16]
        words = call.format(folder, *(kept or ["none"])).split()
        calls.append({"call": " ".join(["diffuscope", *words])} | called(words))
    return {"commands": shown, "calls": calls}


def print_made() -> None:
    """Print the record of one process as JSON; the first argument is an empty folder for the files of the calls."""
    folder = Path(sys.argv[1])
    sys.argv[:] = ["diffuscope"]  # the name in the usage lines
    json.dump(_made(folder), sys.stdout)


def write() -> Path:
    """Write the record of the command line."""
    compare.write("command-line", record())
    return compare.RECORDS / "command-line.json"
