"""Command `diffuscope store check|rebuild|copy|research`: check what is stored, rebuild its database, copy captures."""

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from device import atomic_io
from device.clock import SystemClock
from device.user_files import files_in
from services.identity.audit_key import find_audit_key, load_or_create_audit_key
from services.records.audit_log import AuditLog
from services.running_time import announced, announcing, say

if TYPE_CHECKING:
    from services.records.store_check import Checked

app = typer.Typer(help="What is stored: check it, rebuild its database, copy captures.", no_args_is_help=True)
Data = Annotated[Path, typer.Option(help="Where captures are kept.")]


@app.command()
@announced("checking what is stored")
def check(
    data: Data,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Read everything that is stored, change nothing, and name what is damaged; exit status 1 if something is."""
    from services.records.store_check import check_store  # deferred: imports SQLAlchemy

    results = check_store(data, lambda line: say(f"{line} ..."), find_audit_key(data))
    typer.echo(json.dumps([asdict(result) for result in results], indent=1) if as_json else table(results))
    if not all(result.is_whole for result in results):
        sys.exit(1)


@app.command()
def rebuild(
    data: Data,
    sure: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Rebuild the database from the files of patients, visits and captures; stop the instrument first."""
    from services.records.capture_store import CaptureStore  # deferred: imports SQLAlchemy
    from services.records.recovery import rebuild_database
    from services.records.storage_errors import storage_errors

    if not sure:
        typer.confirm(f"Rebuild the database of {data}?", abort=True)
    with announcing("rebuilding the database"):
        with storage_errors():
            aside = rebuild_database(data)
        with CaptureStore(data, key=find_audit_key(data)) as store:
            report = store.recovery
    counts = f"{len(report.patients)} patients, {len(report.visits)} visits and {len(report.adopted)} captures"
    typer.echo(f"The database has {counts} from the files. The one before is in {aside}.")


@app.command()
@announced("copying captures")
def copy(
    capture: Annotated[list[str], typer.Argument(help="Ids of captures, names of folders in captures/.")],
    data: Data,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the copies, a folder for each capture.")],
) -> None:
    """Copy captures without encryption: raw frames, pictures and report; they are pictures of a person."""
    from services.records import schema  # deferred: imports SQLAlchemy
    from services.records.capture_store import CaptureStore
    from services.records.earlier_stores import require_store
    from services.records.storage_errors import storage_errors

    require_store(data / schema.DATABASE)
    key = load_or_create_audit_key(data)
    with CaptureStore(data, key=key) as store, storage_errors():
        atomic_io.make_folder(output)
        for id in capture:
            AuditLog(data, key, SystemClock()).append("", "copy", id, field="plain", by="command")
            atomic_io.write_folder(output / id, {name: store.read(id, name) for name in store.get(id).files})
    typer.echo(f"{output}: {len(capture)} captures")


@app.command()
@announced("writing the research export")
def research(
    data: Data,
    output: Annotated[Path, typer.Option("--output", "-o", help="New folder, which gets a folder for each visit.")],
) -> None:
    """Copy all finished visits with consent for research, without number, name, phone, village and dates.

    They are still pictures of persons: a retina identifies a person of whom another picture is known.
    """
    from services.delivery.research_export import research_folders  # deferred: imports SQLAlchemy
    from services.records import schema
    from services.records.capture_store import CaptureStore
    from services.records.earlier_stores import require_store
    from services.records.storage_errors import storage_errors

    if output.exists():
        raise typer.BadParameter(f"{output} exists; give a new folder")
    require_store(data / schema.DATABASE)
    key = load_or_create_audit_key(data)
    AuditLog(data, key, SystemClock()).append("", "export-research", by="command")
    with CaptureStore(data, key=key) as store, storage_errors():
        atomic_io.make_folder(output)
        for name, files in research_folders(store):
            atomic_io.write_folder(output / name, files)
    typer.echo(f"{output}: {len(files_in(output))} visits")


def table(results: list["Checked"]) -> str:
    """Return the results as a table of text, followed by the names of what is not whole."""
    lines = [f"{'':<26}{'whole':>8}{'healable':>10}{'damaged':>9}"]
    lines += [
        f"{result.name:<26}{result.whole:>8}{len(result.healable):>10}{len(result.damaged):>9}" for result in results
    ]
    lines += [f"healable by the next start: {result.name}: {name}" for result in results for name in result.healable]
    lines += [f"damaged: {result.name}: {name}" for result in results for name in result.damaged]
    return "\n".join(lines)
