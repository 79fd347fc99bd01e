"""Command `diffuscope audit verify`: check the audit log of a data folder."""

from pathlib import Path
from typing import Annotated

import typer

from device.clock import SystemClock
from services.identity.audit_key import read_audit_key
from services.records.audit_log import AuditLog
from services.running_time import announced

app = typer.Typer(help="Who did what on the instrument.", no_args_is_help=True)


@app.callback()
def root() -> None:
    """Who did what on the instrument."""  # with a callback, `verify` stays a command of its own


@app.command()
@announced("checking the audit log")
def verify(data: Annotated[Path, typer.Option(help="Where captures are kept.")]) -> None:
    """Check that no entry was changed, added, moved or left out; the exit status is 1 if one was."""
    found = AuditLog(data, read_audit_key(data), SystemClock()).check()
    typer.echo(f"{found.entries} entries are as they were written" + (f"; {found.problem}" if found.problem else "."))
    raise typer.Exit(1 if found.problem else 0)
