"""Commands `diffuscope store backup` and `diffuscope store restore`."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from device.clock import SystemClock
from device.user_files import read_text
from services.backup.store_command import Data, app, table
from services.identity.audit_key import find_audit_key
from services.running_time import announcing, say

if TYPE_CHECKING:
    from services.backup.backup_key import BackupHeader, BackupKey, SecretKey

PassphraseFile = Annotated[
    Path | None, typer.Option(help="File with the passphrase in its first line, instead of a question.")
]


@app.command()
def backup(
    to: Annotated[Path, typer.Option(help="USB stick or folder that gets the folder of the backups.")],
    data: Data,
    recipient: Annotated[
        list[str] | None, typer.Option(help="Public key of age (age1...) instead of a passphrase.")
    ] = None,
    passphrase_file: PassphraseFile = None,
    new_key: Annotated[bool, typer.Option("--new-key", help="Choose passphrase or keys again.")] = False,
    verify: Annotated[bool, typer.Option("--verify", help="Read the earlier backups too; mend what changed.")] = False,
) -> None:
    """Back up everything that is stored, encrypted, also while the instrument runs; later backups add what is new.

    The first backup asks for a passphrase, or takes --recipient. A restoration needs the passphrase, or the secret key
    of one recipient with the line that this command prints. With --new-key, --recipient or --passphrase-file a new,
    complete series of backups begins.
    """
    from services.backup.backup_key import read_key  # deferred: imports SQLAlchemy
    from services.backup.write_backup import write_backup

    chosen = new_key or recipient is not None or passphrase_file is not None
    needs_key = chosen or (read_key(data) is None and (data / "captures").is_dir())
    key = _new_key(recipient or [], passphrase_file) if needs_key else None
    with announcing("backing up"):
        made = write_backup(data, to, SystemClock(), _percent("backed up"), key, verify)
    typer.echo(
        f"Backup {made.number} in {made.folder}: {made.units} folders, {made.written_bytes / 1e6:.1f} MB written, "
        "read back."
    )
    for unit in made.unreadable:
        typer.echo(f"Not in the backup, because the disk does not return it: {unit}", err=True)
    if made.unreadable:
        sys.exit(1)


@app.command()
def restore(
    source: Annotated[Path, typer.Option("--from", help="Folder of the backups, or the stick that has it.")],
    data: Data,
    identity: Annotated[Path | None, typer.Option(help="File with the secret key of age.")] = None,
    passphrase_file: PassphraseFile = None,
    number: Annotated[int | None, typer.Option(min=1, help="Number of a backup; the newest if not given.")] = None,
) -> None:
    """Restore a backup on a device that has no records yet, and check what was restored; stop the instrument first."""
    from services.backup.backup_folder import find_folder  # deferred: imports SQLAlchemy
    from services.backup.backup_key import read_header
    from services.backup.restore_backup import restore_backup
    from services.records.capture_store import CaptureStore
    from services.records.store_check import check_store

    folder = find_folder(source)
    secret = _secret_key(read_header(folder), identity, passphrase_file)
    with announcing("restoring"):
        found = restore_backup(folder, secret, data, _percent("restored"), number)
        for damaged in found.damaged_backups:
            say(f"Backup {damaged} is damaged; an older one is restored.")
        for unit in found.damaged_units:
            say(f"Damaged in the backup, not restored: {unit}")
        key = find_audit_key(data)  # that of the restored store
        CaptureStore(data, key=key).close()  # migrates the tables; restores a row that is older than its file
        results = check_store(data, lambda line: say(f"{line} ..."), key)
    typer.echo(table(results))
    typer.echo(f"Backup {found.number} of {found.made_at:%Y-%m-%d %H:%M} UTC is restored in {data}.")
    if found.damaged_units or found.damaged_backups or not all(result.is_whole for result in results):
        sys.exit(1)


def _new_key(recipients: list[str], passphrase_file: Path | None) -> "BackupKey":
    from services.backup.backup_key import key_for_passphrase, key_for_recipients

    if recipients:
        key = key_for_recipients(recipients)
        typer.echo(f"Add this line to the file of each secret key. A restoration needs both:\n{key.line}", err=True)
        return key
    if passphrase_file is not None:
        return key_for_passphrase(_first_line(passphrase_file))
    typer.echo("Only this passphrase restores the backups. Write it down, and keep it away from the stick.", err=True)
    return key_for_passphrase(typer.prompt("New passphrase", hide_input=True, confirmation_prompt=True))


def _secret_key(header: "BackupHeader", identity: Path | None, passphrase_file: Path | None) -> "SecretKey":
    from services.backup.backup_key import key_in, key_of_passphrase

    if identity is not None:
        return key_in(identity, header)
    if passphrase_file is not None or not header.sealed_identity:
        return key_of_passphrase(header, _first_line(passphrase_file) if passphrase_file else "")
    return key_of_passphrase(header, typer.prompt("Passphrase of the backups", hide_input=True))


def _first_line(path: Path) -> str:
    return read_text(path).partition("\n")[0]


def _percent(verb: str) -> Callable[[int, int], None]:
    """Return a progress function that prints each further tenth."""
    shown = 0

    def progress(done: int, total: int) -> None:
        nonlocal shown
        if (tenth := 10 * done // max(total, 1)) > shown:
            shown = tenth
            say(f"{verb} {done} of {total} ...")

    return progress
