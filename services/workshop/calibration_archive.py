"""`diffuscope calibrations`: list, show, activate, export and import calibrations as signed files; import PSFs."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from device.calibration.archive import Archive, StoredCalibration, parse_calibration
from device.clock import SystemClock
from device.config.head_file import load_head
from device.errors import CalibrationError, HeadMismatch, MemoryDamaged
from device.head import head_memory, refuse_unsuitable_calibration
from device.ports import HeadMemory
from device.values import HeadIdentity
from services.research.named_files import head_file
from services.research.reconstruct_file import parse_bayer
from services.running_time import announced, say
from services.workshop.calibration_words import details, printable, summary

app = typer.Typer(
    help="List the calibrations that are kept, put one in force, and bring them from head to head as signed files.",
    no_args_is_help=True,
)
ArchiveOption = Annotated[Path, typer.Option("--archive", help="Where calibrations are kept.")]
HeadOption = Annotated[
    Path | None, typer.Option(help="Head file or name; it must fit, and its memory is asked or written.")
]
IdArgument = Annotated[str, typer.Argument(metavar="ID", help="As `calibrations list` shows it.")]


@app.command("list")
@announced("reading the archive")
def list_all(archive: ArchiveOption) -> None:
    """List every calibration that is kept, the oldest first; * marks the one in force."""
    kept = Archive(archive)
    if not kept.ids():
        typer.echo(f"no calibration is kept in {archive}")
    in_force = _in_force(kept)
    for id in kept.ids():
        mark = "*" if id == in_force else " "
        try:
            first, *rest = summary(kept.load(id))
            typer.echo("\n    ".join((f"{mark} {first}", *rest)))
        except CalibrationError as error:
            typer.echo(f"{mark} {id}  DAMAGED: {error.message}\n    {error.remedy}")


def _in_force(archive: Archive) -> str | None:
    try:
        return archive.active_id()
    except CalibrationError as error:
        if archive.ids():
            typer.echo(f"{error.message}\n{error.remedy}")
        return None


@app.command()
@announced("reading the archive")
def show(id: IdArgument, archive: ArchiveOption) -> None:
    """Say all that is known of one calibration, and what is not."""
    kept = Archive(archive).load(id)
    for line in (*summary(kept), *details(kept)):
        typer.echo(line)


@app.command()
@announced("putting a calibration in force")
def use(id: IdArgument, archive: ArchiveOption, head: HeadOption = None) -> None:
    """Put a calibration in force, an earlier one too; with --head the head's memory is told."""
    kept = Archive(archive)
    typer.echo(_put_in_force(kept, id, head))


def _put_in_force(archive: Archive, id: str, head: Path | None) -> str:
    """Activate a calibration in the archive, then (if `head` is given) in the head's memory; return the line to print.

    If the second write fails, the instrument refuses to start and names this command.
    """
    with ExitStack() as stack:
        found = archive.load(id)
        memory = None
        if head is not None:
            spec = load_head(head_file(head))
            refuse_unsuitable_calibration(found, spec)
            memory = stack.enter_context(head_memory(spec, SystemClock()))
        activate(archive, found, memory)
    head_note = "" if memory is None else f", and head {found.provenance.serial} knows it"
    return f"{id} is in force in {archive.root}{head_note}; the instrument uses it from its next start"


def activate(archive: Archive, kept: StoredCalibration, memory: HeadMemory | None) -> None:
    """Activate an archived calibration, and write its ID and serial number to the head's memory, if there is one.

    HeadMismatch, before any change, if the memory names another head.
    """
    if memory is None:
        archive.activate(kept.calibration.id)
        return
    serial = agreed_serial(kept, memory)
    archive.activate(kept.calibration.id)
    memory.write(HeadIdentity(serial, kept.calibration.id))


def agreed_serial(kept: StoredCalibration, memory: HeadMemory) -> str:
    """Return the serial number for the head's memory; HeadMismatch if the memory names another head.

    A blank or damaged memory names no head. An imported PSF belongs to no head: the memory keeps its serial number.
    """
    try:
        known = memory.read()
    except MemoryDamaged:
        known = None  # a power cut during the write damaged it
    serial = kept.provenance.serial
    if known is None or known.serial == serial:
        return serial
    if kept.provenance.origin == "measured":
        raise HeadMismatch(
            f"this head is {known.serial}, and {kept.calibration.id} was measured on {kept.provenance.serial}",
            "Choose a calibration of this head from `diffuscope calibrations list`, or calibrate it.",
        )
    return known.serial


@app.command("new-key")
def make_key(
    file: Annotated[Path, typer.Argument(help="The private key; the public one gets the ending .pub.")],
    name: Annotated[str, typer.Option(help="Who signs, as others will read it.")],
) -> None:
    """Make a key pair for signing; keep the private one secret, and give the public one to who shall trust it."""
    from device.calibration.signing import create_key_pair  # imports cryptography only for this command

    signer = create_key_pair(file, name)
    typer.echo(
        f"{file} is secret: whoever has it signs as {signer.name}\n"
        f"{file}.pub is for everyone, key {signer.fingerprint[:16]}"
    )


@app.command("export")
@announced("signing")
def export_one(
    words: Annotated[
        list[str], typer.Argument(metavar="[ID] FILE", help="Which (else the one in force), and where to.")
    ],
    archive: ArchiveOption,
    key: Annotated[Path, typer.Option(help="Private key to sign with, its public one beside it.")],
) -> None:
    """Write a calibration as one signed file. It holds nothing about any patient."""
    from device.calibration.signing import export

    if len(words) > 2:
        raise typer.BadParameter("give one calibration and one file")
    kept = Archive(archive)
    id = words[0] if len(words) == 2 else kept.active_id()
    file = Path(words[-1])
    signer = export(kept.files(id), file, key)
    typer.echo(f"{file}: {id}, signed by {signer.name}, key {signer.fingerprint[:16]}")


@app.command("import")
@announced("importing")
def import_one(
    file: Annotated[Path, typer.Argument(help="An exported calibration.")],
    archive: ArchiveOption,
    trust: Annotated[list[Path], typer.Option(help="Public key of whom to believe; may be repeated.")],
    head: HeadOption = None,
    use: Annotated[bool, typer.Option("--use", help="Put it in force.")] = False,
) -> None:
    """Take a signed calibration into the archive; it is in force only with --use."""
    from device.calibration.signing import read_export, read_signer

    files, signer = read_export(file, tuple(read_signer(path) for path in trust))
    found = parse_calibration(files)
    kept = Archive(archive)
    if head is not None:
        spec = load_head(head_file(head))
        refuse_unsuitable_calibration(found, spec)
        with head_memory(spec, SystemClock()) as memory:
            if memory is not None:
                agreed_serial(found, memory)
    id = kept.add_files(files)
    typer.echo(f"{id} of {printable(found.provenance.serial)}, signed by {signer.name}, is kept in {archive}")
    if use:
        typer.echo(_put_in_force(kept, id, head))


@app.command("import-psf")
@announced("importing")
def import_psf(
    psf: Annotated[list[Path], typer.Argument(help="PSF images: tiff, png or npy; several are a stack over depth.")],
    archive: ArchiveOption,
    by: Annotated[str, typer.Option(help="Who imports.")],
    source: Annotated[str, typer.Option(help="Where they come from, in words.")],
    dark: Annotated[Path | None, typer.Option(help="Dark frame of the PSF's own exposure.")] = None,
    pitch_um: Annotated[float | None, typer.Option(min=0.1, max=100, help="Pixel pitch of the sensor.")] = None,
    black_dn: Annotated[float | None, typer.Option(min=0, max=65535, help="Count without light.")] = None,
    white_dn: Annotated[float | None, typer.Option(min=1, max=65535, help="Count at which the sensor ends.")] = None,
    bayer: Annotated[
        str | None, typer.Option(metavar="RGGB", help="none: the images are monochrome, whatever a dng says.")
    ] = None,
) -> None:
    """Archive a PSF of another laboratory, its unknown values marked as unknown; it is not put in force.

    A PSF of a colour mosaic is refused: the pixels decide, not the label of a dng.
    """
    from importlib.metadata import version

    from device.calibration.archive import Provenance
    from device.calibration.import_psf import ImportedPsfInfo, read_imported_psf

    found = read_imported_psf(tuple(psf), ImportedPsfInfo(black_dn, white_dn, pitch_um, dark, parse_bayer(bayer)))
    provenance = Provenance(
        "unknown",
        SystemClock().wall(),
        by,
        version("diffuscope"),
        None,
        found.figures,
        "imported",
        source,
        found.unknown,
    )
    kept = Archive(archive)
    id = kept.add(found.calibration, provenance)
    for line in summary(kept.load(id)):
        typer.echo(line)
    for note in found.notes:
        say(f"note: {note}")
