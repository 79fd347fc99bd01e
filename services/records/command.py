"""Command `diffuscope snapshots list|restore`: list the snapshots of the database; restore one of them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from device import atomic_io
from device.clock import SystemClock
from services.running_time import announced, announcing

if TYPE_CHECKING:
    from services.records.snapshots import Snapshots

app = typer.Typer(help="The tables as they were before each migration, and the way back.", no_args_is_help=True)
Data = Annotated[Path, typer.Option(help="Where captures are kept.")]


def _snapshots(data: Path) -> "Snapshots":
    from services.records import schema  # deferred: imports SQLAlchemy
    from services.records.earlier_stores import require_store
    from services.records.snapshots import Snapshots

    require_store(data / schema.DATABASE)
    return Snapshots(data / schema.DATABASE, SystemClock())


@app.command("list")
@announced("reading the snapshots")
def list_snapshots(data: Data) -> None:
    """Name the snapshots, the oldest tables first."""
    for name in _snapshots(data).names():
        typer.echo(name)


@app.command()
def restore(
    name: Annotated[str, typer.Argument(help="A snapshot, as `list` names it.")],
    data: Data,
    sure: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Put a snapshot in the place of the tables; stop the instrument first."""
    from services.records.storage_errors import storage_errors  # deferred: imports SQLAlchemy

    snapshots = _snapshots(data)
    with storage_errors(), atomic_io.file_lock(data / ".lock"):
        if name in snapshots.names() and (missing := snapshots.missing_from(name, data / "captures")):
            typer.echo(f"{len(missing)} captures were kept since, from {missing[0]} on.")
            typer.echo("The next start restores them, and later answers, from their files.")
        if not sure:
            typer.confirm(f"Go back to {name}?", abort=True)
        with announcing("restoring the tables"):
            aside = snapshots.restore(name)
    typer.echo(f"The tables are those of {name}. What they replaced is in {aside}.")
