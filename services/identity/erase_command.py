"""Commands `diffuscope erase patient` and `diffuscope erase verify`: erase a patient, check the receipt."""

from pathlib import Path
from typing import Annotated, cast, get_args

import typer

from device import atomic_io
from device.clock import SystemClock
from device.user_files import read_text
from services.identity.audit_key import read_audit_key
from services.records.audit_log import AuditLog
from services.records.visit import EraseReason
from services.running_time import announced, announcing

app = typer.Typer(help="Erase a patient for good, and check the receipt of an erasure.", no_args_is_help=True)
Data = Annotated[Path, typer.Option(help="Where captures are kept.")]


@app.command()
def patient(
    number: Annotated[str, typer.Argument(help="Number of the patient.")],
    data: Data,
    receipt: Annotated[Path, typer.Option(help="File of the receipt, which has no name and no number.")],
    reason: Annotated[str, typer.Option(help=f"One of {', '.join(get_args(EraseReason))}.")] = "requested",
    sure: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Erase all that is stored of a patient, for good; stop the instrument first, make new backups afterwards."""
    from services.records import schema  # deferred: imports SQLAlchemy
    from services.records.capture_store import CaptureStore
    from services.records.earlier_stores import require_store
    from services.records.snapshots import refuse_in_use
    from services.records.storage_errors import storage_errors

    if reason not in get_args(EraseReason):
        raise typer.BadParameter(f"{reason} is no reason; choose from {', '.join(get_args(EraseReason))}")
    if receipt.exists() or not receipt.absolute().parent.is_dir():
        raise typer.BadParameter(f"{receipt} cannot be a new file; choose another for the receipt")
    require_store(data / schema.DATABASE)
    refuse_in_use(data / schema.DATABASE)
    key, clock = read_audit_key(data), SystemClock()
    with CaptureStore(data, key=key) as store:
        found = store.erasures.find(number)
        if not sure:
            typer.confirm(f"Erase {len(found.visits)} visits with {len(found.captures)} captures for good?", abort=True)
        with announcing("erasing"), storage_errors():
            _, written = store.erasures.erase(number, cast(EraseReason, reason), clock.wall())
            atomic_io.write_atomically(receipt, written.model_dump_json(indent=1).encode())
            AuditLog(data, key, clock).append("", "erase-patient", found.patient_id, field=reason, by="command")
    typer.echo(f"{written.visits} visits with {written.captures} captures are erased. The receipt is in {receipt}.")
    typer.echo("Make a backup to each stick and folder that has backups: that erases the patient there too.")


@app.command()
@announced("checking the receipt")
def verify(receipt: Annotated[Path, typer.Argument(help="File of a receipt.")], data: Data) -> None:
    """Check that the store in a data folder wrote a receipt, and that nothing in it was changed."""
    from services.records.erasure import verified  # deferred: imports SQLAlchemy

    found = verified(read_text(receipt).encode(), read_audit_key(data))
    typer.echo(
        f"{found.visits} visits with {found.captures} captures were erased on {found.erased_at:%Y-%m-%d %H:%M} UTC."
    )
