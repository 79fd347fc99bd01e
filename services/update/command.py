"""Command line `diffuscope update check|install|restart|settle|answer|tidy|status`, for technician, timer and boot."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from device.clock import SystemClock
from device.errors import DiffuscopeError
from services.update.preconditions import waiting_uploads
from services.update.settings import SETTINGS_PATH, load_settings
from services.update.updater import Updater

app = typer.Typer(help="Look for another version, install it, and see what became of it.", no_args_is_help=True)
Settings = Annotated[Path, typer.Option(help="Where updates come from and when they are refused.")]


def _updater(settings: Path) -> Updater:
    return Updater(load_settings(settings), SystemClock(), typer.echo)


@app.command()
def check(
    settings: Settings = SETTINGS_PATH,
    download: Annotated[bool, typer.Option("--download", help="Fetch it already, and install nothing.")] = False,
) -> None:
    """Ask the channel whether there is a newer version."""
    updater = _updater(settings)
    updater.tidy()
    offer = updater.check(download)
    typer.echo(f"Version {offer.version} is offered." if offer else f"Nothing is newer than {updater.running_version}.")
    if offer and (waiting := waiting_uploads(load_settings(settings).instrument)):
        typer.echo(f"Waiting to be sent: {waiting}. They stay on the device, and are sent after the update.")


@app.command()
def install(
    source: Annotated[
        Path | None, typer.Argument(help="A bundle or a stick's folder; else any stick, else the channel.")
    ] = None,
    settings: Settings = SETTINGS_PATH,
    restart: Annotated[bool, typer.Option(help="Restart at once to try it.")] = True,
) -> None:
    """Install a newer version beside the one that runs, and restart to try it."""
    _updater(settings).install(source, restart)


@app.command("restart")
def restart_device(settings: Settings = SETTINGS_PATH) -> None:
    """Restart to try what is installed and waits."""
    _updater(settings).restart()


@app.command()
def settle(settings: Settings = SETTINGS_PATH) -> None:
    """In a version that is being tried: commit it if it is well, else fail, which restarts into the one before."""
    _updater(settings).settle()


@app.command()
def answer(settings: Settings = SETTINGS_PATH) -> None:
    """Carry out a request of the technician's page; systemd calls this when the page has written one."""
    _updater(settings).answer()


@app.command()
def tidy(settings: Settings = SETTINGS_PATH) -> None:
    """Record that an update was interrupted, if no updater works on it any more."""
    _updater(settings).tidy()


@app.command()
def status(
    settings: Settings = SETTINGS_PATH,
    as_json: Annotated[bool, typer.Option("--json", help="Print it for a program.")] = False,
) -> None:
    """Say which version runs and what became of the last update."""
    entry, words = _updater(settings).status()
    typer.echo(json.dumps(entry.model_dump() | {"words": words}, indent=1) if as_json else words)


def main() -> None:
    """Run the update commands alone; on a DiffuscopeError print message and remedy to stderr, exit status 2."""
    try:
        app(prog_name="python -m services.update")
    except DiffuscopeError as error:
        typer.echo(f"error: {error.message}\n{error.remedy}", err=True)
        sys.exit(2)
