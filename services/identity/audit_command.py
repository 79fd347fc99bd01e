"""Commands `diffuscope audit verify` and `archive`: check the audit log of a data folder, or move it to a file."""

from pathlib import Path
from typing import Annotated

import typer

from device.clock import SystemClock
from services.identity.audit_key import read_audit_key
from services.records.audit_log import AuditLog
from services.records.schema import DATABASE
from services.records.snapshots import refuse_in_use
from services.running_time import announced

app = typer.Typer(help="Who did what on the instrument.", no_args_is_help=True)


@app.command()
@announced("checking the audit log")
def verify(data: Annotated[Path, typer.Option(help="Where captures are kept.")]) -> None:
    """Check that no entry was changed, added, moved or left out; the exit status is 1 if one was."""
    found = AuditLog(data, read_audit_key(data), SystemClock()).check()
    typer.echo(f"{found.entries} entries are as they were written" + (f"; {found.problem}" if found.problem else "."))
    raise typer.Exit(1 if found.problem else 0)


@app.command()
@announced("moving the audit log")
def archive(
    file: Annotated[Path, typer.Argument(help="New file, for example on a USB stick.")],
    data: Annotated[Path, typer.Option(help="Where captures are kept.")],
) -> None:
    """Move all entries to a file, and go on with the next number; the instrument must be stopped."""
    refuse_in_use(data / DATABASE)
    number = AuditLog(data, read_audit_key(data), SystemClock()).archive(file)
    typer.echo(f"The entries up to number {number} are in {file}. Keep it: the device has no other copy.")
