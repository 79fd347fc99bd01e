"""Command line `diffuscope`: each command parses its arguments and calls one function."""

import gc
import json
import os
import subprocess
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from typer.core import TyperGroup

# Before numpy is imported: matrices are small here, and idle threads of BLAS would take a processor from the solvers.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from device.clock import SystemClock
from device.config.head_file import InstrumentSpec, load_head
from device.errors import DiffuscopeError, SettingError
from device.values import Colour
from services import resources
from services.research.channel_options import ReconstructCommand, parse_channels, parse_darks, refuse_mixed
from services.research.named_files import head_file, scene_file
from services.research.peers import ENVIRONMENT, installed_peer
from services.running_time import announced, say, working

if TYPE_CHECKING:
    from services.research.reconstruct_burst import ChannelSource
    from services.research.reconstruct_file import FileReconstruction, OutputFiles
    from services.research.reconstruct_inputs import ReconstructOptions

GROUPS = {
    "calibrations": "services.workshop.calibration_archive",
    "update": "services.update.command",
    "snapshots": "services.records.command",
    "store": "services.backup.command",
    "archive": "services.archive.command",
    "programme": "services.records.programme_command",
    "users": "services.identity.users_command",
    "audit": "services.identity.audit_command",
    "erase": "services.identity.erase_command",
}


class Commands(TyperGroup):
    """All commands; the module of a group of GROUPS is imported when the group is used or its help is shown."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands, groups last."""
        return [*super().list_commands(ctx), *GROUPS]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command or a group; None for an unknown name."""
        if cmd_name not in GROUPS:
            return super().get_command(ctx, cmd_name)
        group = typer.main.get_group(import_module(GROUPS[cmd_name]).app)
        group.name = cmd_name
        return group


app = typer.Typer(
    name="diffuscope",
    cls=Commands,
    help="A funduscope whose lens is a piece of diffuser.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

INSTRUMENT_PACKAGES = frozenset(
    {"fastapi", "starlette", "uvicorn", "sqlalchemy", "alembic", "cryptography", "pyrage", "argon2"}
)
ARCHIVE_PACKAGES = frozenset({"distributed", "dask", "pyarrow"})
SIM_HEAD = resources.HEADS / "sim.toml"

DataSet = Annotated[Path, typer.Argument(help="Folder of a data set: DLMD, DiffuserCam, LenslessPiCam or own pairs.")]
OwnPsf = Annotated[Path | None, typer.Option(help="PSF for a folder with none or with several.")]
Limit = Annotated[int | None, typer.Option(min=1, help="Just the first pairs of the data set.")]
Methods = Annotated[
    list[str] | None,
    typer.Option(help="Just this method of `diffuscope methods`, or FILE.py:NAME; may be repeated."),
]
Peers = Annotated[Path, typer.Option(help="Python environment with LenslessPiCam, for comparison.")]
NoPeers = Annotated[bool, typer.Option("--no-peers", help="Leave other solvers out.")]


def _head_file(head: Path | None) -> Path | None:
    return None if head is None else head_file(head)


def _default_data() -> Path:
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "diffuscope"


@app.command()
def run(
    head: Annotated[
        Path | None,
        typer.Option(callback=_head_file, help="Head file; the simulated head if nothing is given."),
    ] = None,
    replay: Annotated[Path | None, typer.Option(help="Folder with a recording, played instead of a head.")] = None,
    raw: Annotated[list[Path] | None, typer.Option(help="Raw frames of a recording, with --psf.")] = None,
    psf: Annotated[list[Path] | None, typer.Option(help="PSF of a recording; several, or a folder: a stack.")] = None,
    host: Annotated[
        str, typer.Option(help="Address to serve on; 0.0.0.0 for the whole network, after `diffuscope label`.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535)] = 8000,
    tls: Annotated[
        Path | None,
        typer.Option(
            help="Folder of server.pem, the certificate beyond this computer; by default `tls` of --data.",
            readable=False,
        ),
    ] = None,
    pairing_port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the pairing page; 0: none.")] = 0,
    data: Annotated[Path | None, typer.Option(help="Where captures are kept.")] = None,
    programme: Annotated[Path | None, typer.Option(help="What a screening consists of, as TOML.")] = None,
    name: Annotated[list[str] | None, typer.Option(help="A further name of this computer, or of a proxy.")] = None,
    updates: Annotated[
        Path | None, typer.Option(help="The updater's folder, for the page to show.", readable=False)
    ] = None,
    update_requests: Annotated[
        Path | None, typer.Option(help="Where the updater takes what the page asks for.", readable=False)
    ] = None,
    send: Annotated[Path | None, typer.Option(help="Where finished visits are sent, as TOML; else nowhere.")] = None,
) -> None:
    """Serve the page: one button, one true picture."""
    from services.delivery.uploader import HttpsUploader, load_settings
    from services.http.server import base_url, open_listeners, serve  # web stack: here only
    from services.instrument.watchdog import Watchdog
    from services.records.programme import DEFAULT_PROGRAMME, load_programme
    from services.research.frontier import measure_scene

    spec = _chosen(head, replay, tuple(raw or ()), tuple(psf or ()))
    plan = load_programme(programme or DEFAULT_PROGRAMME)
    uploader = HttpsUploader(load_settings(send)) if send is not None else None
    typer.echo(f"{spec.name}: getting ready (the first start measures this computer, about half a minute)")
    folder = data or _default_data()
    tls = tls or folder / "tls"
    listeners = open_listeners(os.environ, host, port, tls, pairing_port)
    served, at = listeners[0].socket.getsockname()[:2]

    def ready(needs_setup: bool) -> None:
        typer.echo(f"Open {base_url(served, at, listeners[0].certificate is not None)} in a browser")
        if needs_setup:
            typer.echo(f"It asks for the set-up code, which `diffuscope label --data {folder}` prints")

    serve(
        spec,
        listeners,
        folder,
        tls,
        ready,
        Watchdog(os.environ.get("NOTIFY_SOCKET")),
        plan,
        measure_scene,
        tuple(name or ()),
        (updates, update_requests),
        uploader,
    )


@app.command()
@announced("making the label")
def label(
    data: Annotated[Path | None, typer.Option(help="Data folder; by default that of the device.")] = None,
    pairing_port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the pairing page.")] = 80,
) -> None:
    """Print how a tablet is paired with this device: address, QR code, fingerprint, and a set-up code."""
    from services.identity.apply_at_boot import Computer
    from services.identity.label import pairing_label
    from services.identity.renewal import OUTPUT
    from services.records.storage_errors import storage_errors

    computer = Computer()
    folder = data or _default_data()
    folders = folder, folder / "identity", folder / "tls"
    if data is None and (computer.root / OUTPUT).exists():  # the units of systemd/ are installed
        stored = computer.data if computer.data.exists() else Path("/etc/diffuscope")
        folders = Path("/var/lib/diffuscope"), stored / "identity", computer.root / OUTPUT
    with storage_errors():
        typer.echo(pairing_label(*folders, pairing_port, SystemClock()))


def _chosen(head: Path | None, replay: Path | None, raws: tuple[Path, ...], psfs: tuple[Path, ...]) -> InstrumentSpec:
    if replay is not None or raws or psfs:
        from device.head import recording_spec
        from services.research.psf_stack import psf_stack

        if head is not None:
            raise typer.BadParameter("choose --head or a recording (--replay, --raw with --psf), not both")
        stack = tuple(path for path in psf_stack(psfs) if isinstance(path, Path))
        return recording_spec(replay or raws[0].parent if raws else replay or Path(), raws, stack)
    return load_head(head or SIM_HEAD)


@app.command(cls=ReconstructCommand)
def reconstruct(
    output: Annotated[Path, typer.Option("--output", "-o", help=".npy or .tiff: linear float32; .png: for eyes.")],
    raw: Annotated[
        list[Path] | None, typer.Argument(help="Raw frame: tiff, png, npy, npz or dng; several are one burst.")
    ] = None,
    psf: Annotated[
        list[Path] | None, typer.Option(help="Measured PSF; several, or a folder, are a stack, the best is chosen.")
    ] = None,
    channel: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME RAW [PSF]", help="One colour: red, green, blue or amber; again for each frame."),
    ] = None,
    calibration: Annotated[
        str | None,
        typer.Option(metavar="DIR[:ID]", help="Instead of PSFs: a kept calibration; without ID the one in force."),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(help="A name of `diffuscope methods`, or FILE.py:NAME; by default what suits the frame."),
    ] = None,
    bin: Annotated[int | None, typer.Option(help="Pixels per sample along each side; else what the PSF needs.")] = None,
    rounds: Annotated[int | None, typer.Option(help="Rounds of an iterative method, at the most.")] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A parameter of the method, else chosen from the frame."),
    ] = None,
    budget_s: Annotated[float | None, typer.Option(help="Seconds from the loaded frame to the result.")] = None,
    bayer: Annotated[
        str | None, typer.Option(metavar="RGGB", help="The raw is a mosaic: rggb, bggr, grbg or gbrg; or none.")
    ] = None,
    gamma: Annotated[
        float | None, typer.Option(help="Make raw, dark and flat frame linear: 2.2 for those of a picture.")
    ] = None,
    dark: Annotated[
        list[str] | None,
        typer.Option(metavar="[NAME=]FILE", help="Dark frame of the same exposure; with NAME that of one channel."),
    ] = None,
    flat: Annotated[Path | None, typer.Option(help="Flat frame: the sensor's response to even light.")] = None,
    head: Annotated[Path | None, typer.Option(callback=_head_file, help="Head file or name, for the geometry.")] = None,
    field_deg: Annotated[float | None, typer.Option(help="Illuminated disc around the centre, in degrees.")] = None,
    field_fixed: Annotated[
        bool,
        typer.Option("--field-fixed", help="Take the illuminated disc as exact, whatever the frame shows."),
    ] = False,
    no_refraction: Annotated[
        bool, typer.Option("--no-refraction", help="Leave out the eye's refraction, which --head has estimated.")
    ] = False,
    even: Annotated[
        bool, typer.Option("--even", help="Even out the illumination (paper: flat-field correction).")
    ] = False,
    report: Annotated[
        Path | None, typer.Option(help="Where to write the report as JSON; with --each a folder.")
    ] = None,
    sweep: Annotated[
        Path | None, typer.Option(help="Where to draw how well each of several PSFs fits, as SVG.")
    ] = None,
    each: Annotated[bool, typer.Option("--each", help="Make one picture of each raw, in the folder of -o.")] = False,
) -> None:
    """Turn one raw frame or a burst into a picture, without a head and without a page.

    With --each one picture of every frame of a recording; with --channel one colour picture.
    """
    from services.research.psf_stack import psf_stack
    from services.research.reconstruct_file import OutputFiles, parse_bayer, parse_settings, write_or_raise
    from services.research.reconstruct_inputs import ReconstructOptions

    channels = parse_channels(channel or [], calibration is not None)
    raws = raw or []
    common_dark, darks = parse_darks(dark or [])
    options = ReconstructOptions(
        psfs=psf_stack(psf or ()),
        method=method,
        budget_s=budget_s,
        dark=common_dark,
        flat=flat,
        head=head,
        field_deg=field_deg,
        even=even,
        plans=resources.fft_plans(),
        sweep=sweep,
        calibration=calibration,
        bin=bin,
        rounds=rounds,
        settings=parse_settings(setting or ()),
        bayer=parse_bayer(bayer),
        field_fixed=field_fixed,
        refraction=not no_refraction,
        gamma=gamma,
    )
    refuse_mixed(raws, channels, darks, each)
    with working("reconstructing") as beat:
        if each:
            from services.research.reconstruct_each import reconstruct_each

            failed = reconstruct_each(raws, options, output, report, typer.echo, say)
            raise typer.Exit(1 if failed else 0)
        made = _reconstructed(raws, channels, darks, options, OutputFiles(output, report))
    if report is not None:
        write_or_raise(report, lambda: report.write_text(made.report_json(), encoding="utf-8"))
    typer.echo(f"{output}: {made.summary}; {beat.spent}")
    if made.refraction_words is not None:
        typer.echo(made.refraction_words)
    for warning in made.report.warnings:
        typer.echo(f"note: {warning}", err=True)


def _reconstructed(
    raws: list[Path],
    channels: "list[ChannelSource]",
    darks: dict[str, Path],
    options: "ReconstructOptions",
    output: "OutputFiles",
) -> "FileReconstruction":
    if len(raws) == 1 and not channels:
        from services.research.reconstruct_file import reconstruct_file

        return reconstruct_file(raws[0], options, output)
    from services.research.reconstruct_burst import reconstruct_burst, reconstruct_colours

    if channels:
        return reconstruct_colours(channels, options, darks, output)
    return reconstruct_burst(raws, options, output)


@app.command()
@announced("joining pictures")
def montage(
    picture: Annotated[list[Path], typer.Argument(help="Pictures of one eye in several gaze directions.")],
    output: Annotated[Path, typer.Option("--output", "-o", help=".npy or .tiff: linear float32; .png: for eyes.")],
    report: Annotated[Path | None, typer.Option(help="Where to write the place of each picture as JSON.")] = None,
    head: Annotated[
        Path | None,
        typer.Option(callback=_head_file, help="Head file of the pictures: joined on the sphere with its scale."),
    ] = None,
) -> None:
    """Join pictures of one eye to one larger picture around the first; others are left out with a reason.

    Without a head file their scale in degrees is unknown, and they are joined on the plane; the report says so.
    """
    from services.research.montage_files import montage_files, placed_lines

    joined = montage_files(picture, output, report, say, head)
    rows, cols = joined.picture.shape[:2]
    used = sum(place.used for place in joined.placed)
    typer.echo(f"{output}: {used} of {len(picture)} pictures on the {joined.projection}, {rows} x {cols} pixels")
    for line in placed_lines(joined, picture):
        say(line)


@app.command()
@announced("asking the instrument")
def health(
    at: Annotated[str, typer.Option(help="Address of the running instrument.")] = "http://127.0.0.1:8000",
    look: Annotated[bool, typer.Option("--look", help="Also take a live picture, which shines for a moment.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the list for a program.")] = False,
) -> None:
    """Operator, while the page is open: could the running instrument take a picture now?

    The exit status is 1 if a check fails.
    """
    from services.health import probe

    checks = probe.probe_instrument(at, look)
    typer.echo(json.dumps(probe.as_json(checks), indent=1) if as_json else probe.table(checks))
    raise typer.Exit(0 if all(check.ok for check in checks) else 1)


@app.command("doctor")
@announced("examining the computer")
def examine_computer(
    head: Annotated[
        Path | None,
        typer.Option(callback=_head_file, help="Head file; its parts are opened, without light."),
    ] = None,
    parts: Annotated[
        bool, typer.Option("--parts", help="Builder of a head: also test each LED, lit before white paper.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Maker, before the first picture: what does this computer lack for a head?

    Buses, permissions and libraries, each with its remedy; with --head also camera, lamp and chips. With --parts every
    LED shines, and its light is not counted for an eye. The exit status is 1 if a check failed; a warning does not
    count.
    """
    from services.health import doctor

    if parts and head is None:
        raise typer.BadParameter("--parts are those of a head: give its file or name with --head")
    spec = None if head is None else load_head(head)
    report = doctor.examine(doctor.Machine(SystemClock(), leds=parts), spec)
    typer.echo(report.model_dump_json(indent=1) if as_json else doctor.table(report))
    raise typer.Exit(0 if report.healthy else 1)


@app.command("frame")
@announced("exposing")
def take_frame(
    head: Annotated[Path, typer.Option(callback=_head_file, help="Head file, such as hardware/heads/bench.toml.")],
    output: Annotated[Path, typer.Option("-o", help="Raw frame to write, .tiff.")],
    count: Annotated[int, typer.Option(min=1, max=256, help="Exposures, of which the mean is written.")] = 1,
    exposure_s: Annotated[float | None, typer.Option(min=1e-5, max=10, help="Exposure; else the head file's.")] = None,
) -> None:
    """Take one raw frame with the lamp dark, in the light that is there: of a scene, a point source or a cap."""
    from services.workshop.take_frames import summary, take_frames

    counts = take_frames(head, output, count, exposure_s, SystemClock())
    typer.echo(f"{output}: {summary(counts)}")


@app.command("meter")
def light_for_meter(
    head: Annotated[
        Path,
        typer.Option(callback=_head_file, help="Head file whose ring is measured; no camera is opened."),
    ],
    colour: Annotated[str, typer.Option(help="Of the light; by default the picture's.")] = "",
    seconds: Annotated[float, typer.Option(min=0.1, max=120, help="Of pulses and pauses together.")] = 20,
    level: Annotated[
        float | None, typer.Option(min=0.001, max=1, help="Share of full drive; by default all that is permitted.")
    ] = None,
    peak: Annotated[
        bool, typer.Option("--peak", help="The reading is the highest of a pulse; else the mean, half of it, is taken.")
    ] = False,
    data: Annotated[Path | None, typer.Option(help="Where the dose is counted, as of an eye.")] = None,
) -> None:
    """Light the ring for a power meter in pulses, ask for its reading, and compare it with the limits.

    No person looks in. The light guard permits no continuous light: half of the time is dark. The exit status is 1 if
    the ring is brighter than the guard counts, or than an eye may see.
    """
    from services.workshop import measured_light, power_meter

    spec = load_head(head)
    spec = measured_light.in_colour(spec, colour) if colour else spec
    run = power_meter.run_of(spec, level, seconds)
    typer.echo(power_meter.announcement(run))
    typer.confirm("A power meter stands behind the hole on the axis, and no person looks in?", abort=True)
    power_meter.give_pulses(run, data or _default_data(), SystemClock(), say)
    shown_uw = typer.prompt("Reading in uW", type=float)
    verdict = power_meter.judge_reading(run, shown_uw, peak=peak)
    typer.echo(power_meter.words(head, run, verdict))
    raise typer.Exit(0 if verdict.is_go else 1)


@app.command("light")
@announced("judging the light")
def judge_light(
    head: Annotated[Path, typer.Option(callback=_head_file, help="Head file whose ring was measured.")],
    axis_uw: Annotated[float, typer.Option(min=0, help="Power behind the hole on the axis, as diffuscope meter asks.")],
    waist_mw_per_cm2: Annotated[float, typer.Option(min=0, help="Mean over the brightest disc of 1 mm in the waist.")],
    peak_nm: Annotated[float, typer.Option(min=400, max=700, help="Peak wavelength.")],
    meter: Annotated[str, typer.Option(help="Instrument and date of the reading.")],
    colour: Annotated[str, typer.Option(help="Of the reading; by default the picture's.")] = "",
    guard_factor: Annotated[float, typer.Option(min=1.3, max=10, help="For the meter's error.")] = 1.3,
    fwhm_nm: Annotated[float, typer.Option(min=0, max=100, help="Full width at half maximum of the spectrum.")] = 35,
    level: Annotated[float, typer.Option(min=0.001, max=1, help="Share of full drive, as diffuscope meter says.")] = 1,
) -> None:
    """Judge a power meter's reading of a ring: its shares of the limits, GO or NO GO, and the lines for the head file.

    A reading that such a ring cannot give is refused. The exit status is 1 for NO GO.
    """
    from device.light_safety.hazard import light_limits
    from services.workshop import measured_light, optics_report

    spec = load_head(head)
    if colour:
        spec = measured_light.in_colour(spec, colour)
    reading = measured_light.MeterReading(
        spec.light.colour, axis_uw, waist_mw_per_cm2, peak_nm, meter, guard_factor, fwhm_nm
    )
    reading = reading.scaled(level)
    found = measured_light.judge(spec, optics_report.design_of(spec), reading, light_limits())
    typer.echo(measured_light.words(reading, found))
    raise typer.Exit(0 if found.is_go else 1)


@app.command("calibrate")
def calibrate_head(
    head: Annotated[Path, typer.Option(callback=_head_file, help="Head file, or the name of a shipped one: imx296.")],
    archive: Annotated[Path, typer.Option(help="Where calibrations are kept.")],
    serial: Annotated[str | None, typer.Option(help="Of the head; what its memory says if nothing is given.")] = None,
    by: Annotated[str, typer.Option(help="Who calibrates.")] = "technician",
    source_deg: Annotated[
        float | None, typer.Option(min=0, max=5, help="Width of the point source; 275 um behind a 25 mm lens: 0.63.")
    ] = None,
    dioptres: Annotated[
        bool, typer.Option("--dioptres", help="Also move the source by -4 to +4 mm: what one dioptre does to the PSF.")
    ] = False,
    eye_mm: Annotated[
        float | None, typer.Option(min=10, max=60, help="Focal length of the model eye's lens; 25 if nothing is given.")
    ] = None,
    source_mm: Annotated[
        float | None,
        typer.Option(
            min=5, max=100, help="Distance of the source from that lens, as measured: the zero of refractions."
        ),
    ] = None,
    colours: Annotated[
        str, typer.Option(help="Also show the source in these, such as red,blue: a PSF of its own where they differ.")
    ] = "",
    keep_raw: Annotated[
        bool, typer.Option("--keep-raw", help="Keep every raw frame beside the calibration, with its SHA-256.")
    ] = False,
    leds: Annotated[
        Path | None, typer.Option(help="TOML with what a meter said of each LED; trims the ring, tells the guard.")
    ] = None,
    mishap: Annotated[
        list[str] | None, typer.Option(help="Let a step of a simulated head go wrong, such as point=moving.")
    ] = None,
) -> None:
    """Measure a head with a cap, an even screen and a point source, and put its calibration in force."""
    from services.instrument.calibration_request import CalibrationRequest
    from services.workshop.calibrate_head import calibrate, measured_values

    mishaps = {stand: name for stand, _, name in (pair.partition("=") for pair in mishap or ())}
    options = source_deg, eye_mm, dioptres, _colours(colours), keep_raw, leds, source_mm, mishaps
    request = CalibrationRequest(archive, serial, by, *options)
    calibrated = calibrate(load_head(head), request, SystemClock(), _ask_operator, typer.echo)
    for line in (*measured_values(calibrated), f"{calibrated.calibration.id} is in force in {archive}"):
        typer.echo(line)


def _ask_operator(prompt: str) -> None:
    typer.prompt(f"{prompt} Then press Enter", default="", show_default=False)


@app.command("trial-lenses")
def show_trial_lenses(
    head: Annotated[Path, typer.Option(callback=_head_file, help="Head file, or the name of a shipped one: imx296.")],
    archive: Annotated[Path | None, typer.Option(help="Of calibrations; by default the one in the head file.")] = None,
    vertex_mm: Annotated[float, typer.Option(min=0, max=30, help="From the lens to the trainer eye's pupil.")] = 12.0,
    eye_dpt: Annotated[float, typer.Option(min=-10, max=10, help="Correction that the trainer eye alone needs.")] = 0.0,
) -> None:
    """Show lenses before a trainer eye: the offset of the refraction goes into the calibration in force.

    A head whose offset, slope or cylinder is outside its limits is refused, and its calibration stays as it is.
    """
    from device.optics.trial_lens import PowerVector
    from services.instrument.trial_lens_measurement import LensBench
    from services.workshop.check_head import with_archive
    from services.workshop.trial_lens_check import calibrate_with_lenses

    say("the lamp shines for moments: a trainer eye stands before the head, and no person")
    spec = with_archive(load_head(head), archive)
    bench = LensBench(vertex_mm, PowerVector(eye_dpt))
    done = calibrate_with_lenses(spec, bench, SystemClock(), _ask_operator, typer.echo)
    typer.echo(f"{done.stored.calibration.id} is in force; reports subtract its offset")


@app.command("white-card")
def show_white_card(
    head: Annotated[Path, typer.Option(callback=_head_file, help="Head file, or the name of a shipped one: imx296.")],
    archive: Annotated[Path | None, typer.Option(help="Of calibrations; by default the one in the head file.")] = None,
) -> None:
    """Show a white card to the head's own light: colour pictures then have the colours of the retina.

    Without it their hue is neutral. The reference goes into the calibration in force.
    """
    from services.workshop.calibration_words import details
    from services.workshop.check_head import with_archive
    from services.workshop.white_card_check import measure_white_card

    say("the lamp shines for moments: a white card stands before the head, and no person")
    stored = measure_white_card(with_archive(load_head(head), archive), SystemClock(), _ask_operator, typer.echo)
    typer.echo(next(line for line in details(stored) if "white card" in line))
    typer.echo(f"{stored.calibration.id} is in force; colour pictures are balanced by it")


def _colours(words: str) -> tuple[Colour, ...]:
    known: dict[str, Colour] = {name: name for name in get_args(Colour)}
    named = [word.strip() for word in words.split(",") if word.strip()]
    if unknown := [word for word in named if word not in known]:
        raise typer.BadParameter(f"--colours {unknown[0]!r} is none of {', '.join(known)}")
    return tuple(known[word] for word in named)


@app.command("check")
@announced("checking the head")
def check_head(
    head: Annotated[Path, typer.Option(callback=_head_file, help="Head file, or the name of a shipped one: imx296.")],
    archive: Annotated[Path | None, typer.Option(help="Of calibrations; by default the one in the head file.")] = None,
    data: Annotated[Path | None, typer.Option(help="Where captures are kept.")] = None,
    model_eye: Annotated[
        bool, typer.Option("--model-eye", help="Compare the model eye's chart with what the head file promises.")
    ] = False,
    raw: Annotated[Path | None, typer.Option(help="Frame of the chart; else one is taken, with light.")] = None,
    psf: Annotated[Path | None, typer.Option(help="Measured PSF of that frame.")] = None,
    dark: Annotated[Path | None, typer.Option(help="Dark frame of the same exposure.")] = None,
    exposure_s: Annotated[
        float | None, typer.Option(min=1e-5, max=10, help="Of that frame; else the head's, or what suits a new one.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="With --model-eye: as JSON.")] = False,
) -> None:
    """Technician, after a drop or odd pictures: does the calibration in force still fit the head?

    The last captures tell; without any, dark frames are taken now. With --model-eye the printed retina of
    hardware/model-eye.md gives resolution, scale, field and light. The exit status is 1 if a finding fails.
    """
    if model_eye:
        raise typer.Exit(_check_model_eye(head, archive, (raw, psf, dark), exposure_s, as_json))
    if raw or psf or dark or exposure_s or as_json:
        raise typer.BadParameter("--raw, --psf, --dark, --exposure-s and --json go with --model-eye")
    from services.workshop.check_head import (  # imports the drivers only for this command
        check_calibration,
        table,
        with_archive,
    )

    spec = with_archive(load_head(head), archive)
    if spec.calibration is None:
        raise typer.BadParameter("the head file names no archive of calibrations; give one with --archive")
    found = check_calibration(spec, data or _default_data(), SystemClock(), say)
    typer.echo(f"calibration {found.kept.calibration.id} of {found.kept.provenance.serial}")
    typer.echo(table(found))
    raise typer.Exit(1 if any(finding.fails for finding in found.findings) else 0)


def _check_model_eye(
    head: Path, archive: Path | None, files: tuple[Path | None, ...], exposure_s: float | None, as_json: bool
) -> int:
    """Print the check of the model eye with the frame of `files` (raw, psf, dark) or a new one; return the status."""
    from services.workshop import model_eye
    from services.workshop.check_head import with_archive

    raw, psf, dark = files
    if (raw is None) != (psf is None) or (dark is not None and raw is None):
        raise typer.BadParameter("a frame from a file needs both --raw and --psf; --dark goes with them")
    spec = with_archive(load_head(head), archive)
    if raw is not None and psf is not None:
        frame = model_eye.ModelEyeFrame(raw, psf, dark, exposure_s or spec.camera.exposure_s)
    else:
        say("the lamp shines for a moment: the model eye stands before the head, and no person")
        frame = model_eye.expose_model_eye(spec, exposure_s, SystemClock())
    found = model_eye.check_model_eye(head, frame)
    typer.echo(model_eye.as_json(found) if as_json else model_eye.table(found))
    return 0 if found.ok else 1


@app.command("chart")
@announced("drawing the chart")
def draw_chart(
    output: Annotated[Path, typer.Option("--output", "-o", help="Where to draw the chart, as SVG.")],
) -> None:
    """Draw the retina chart of the model eye, to print at 100 % and cut out: hardware/model-eye.md."""
    from device.optics.retina_chart import chart_svg
    from services.research.reconstruct_file import write_or_raise

    write_or_raise(output, lambda: output.write_text(chart_svg(), encoding="utf-8"))
    typer.echo(f"{output}: print at 100 %; the line below the chart is 20 mm long")


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(help="Scene file, or the name of one of device/sim/scenes/: healthy.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder to write into.")] = None,
    explain: Annotated[bool, typer.Option("--explain", help="Print the plan, and render nothing.")] = False,
    everything: Annotated[bool, typer.Option("--all", help="Simulate all effects, seen or not.")] = False,
    only: Annotated[list[str] | None, typer.Option(help="Simulate just this effect; may be repeated.")] = None,
    without: Annotated[list[str] | None, typer.Option(help="Leave this effect out; may be repeated.")] = None,
    frames: Annotated[
        int, typer.Option(help="Frames of one burst: the same diffuser and eye, new noise and motion.")
    ] = 1,
) -> None:
    """Write what the camera would give for a scene: raw.tiff (raw-2.tiff, ...), truth.npy, psf.tiff, plan.json.

    Of a scene with vessels also vessels.png, their mask. Only the effects that the scene calls for are simulated; the
    plan says for each which number decided.
    """
    from services.research import simulate_scene  # imports the simulator only for this command

    spec = load_head(scene_file(scene))
    selected = simulate_scene.SelectedEffects(everything, tuple(only or ()), tuple(without or ()))
    if output is None and not explain:
        raise typer.BadParameter("give -o FOLDER to write into, or --explain to see the plan only")
    with working(f"simulating {spec.name}"):
        if output is None or explain:
            typer.echo(simulate_scene.explain_plan(spec, selected))
            return
        plan = simulate_scene.write_scene(spec, output, selected, frames)
    typer.echo(plan)
    more = "" if frames == 1 else f", ..., raw-{frames}.tiff"
    vessels = ", vessels.png" if (output / "vessels.png").is_file() else ""
    typer.echo(f"{output}: raw.tiff{more}, truth.npy, psf.tiff{vessels}, plan.json")


@app.command()
def frontier(
    json_file: Annotated[Path, typer.Option("--json", help="Where to write every point, as JSON.")],
    plot: Annotated[Path, typer.Option(help="Where to draw accuracy against time, as SVG.")],
    scene: Annotated[Path | None, typer.Option(help="Scene file, or its name; its truth is known.")] = None,
    raw: Annotated[Path | None, typer.Option(help="Raw frame, with --psf and --truth.")] = None,
    psf: Annotated[Path | None, typer.Option(help="Measured PSF of the raw frame.")] = None,
    truth: Annotated[Path | None, typer.Option(help="What the picture should be, on the raw's own pixels.")] = None,
    head: Annotated[
        Path | None, typer.Option(callback=_head_file, help="Head file, for the geometry of a raw frame.")
    ] = None,
    field_deg: Annotated[float | None, typer.Option(help="Illuminated disc of a raw frame, in degrees.")] = None,
    budget_s: Annotated[float, typer.Option(help="The time within which the instrument chooses.")] = 0.26,
    repeats: Annotated[int, typer.Option(min=1, help="Timed turns of every point; the median counts.")] = 7,
    data: Annotated[Path | None, typer.Option(help="Data set with many pairs, instead of one frame.")] = None,
    limit: Limit = None,
    method: Methods = None,
    peers: Peers = ENVIRONMENT,
    no_peers: NoPeers = False,
) -> None:
    """Measure accuracy against time: every method, bin and number of rounds, on this machine."""
    from services.research import frontier as measured  # imports the simulator only for this command
    from services.research import frontier_pairs

    request = measured.FrontierRequest(
        scene and scene_file(scene),
        raw,
        psf,
        truth,
        head,
        field_deg,
        json_file,
        plot,
        budget_s,
        repeats,
        resources.fft_plans(),
        tuple(method or ()),
    )
    wanted = None if data is None else frontier_pairs.dataset_request(request, data, limit)
    with installed_peer(None if no_peers else peers, frontier_pairs.LENSLESS_ROUNDS, say) as peer:
        if wanted is None:
            typer.echo(measured.table(measured.frontier(request, say, peer)))
        else:
            typer.echo(frontier_pairs.dataset_table(frontier_pairs.frontier_of_dataset(wanted, peer, say)))
    typer.echo(f"{json_file}, {plot}")


@app.command("data")
@announced("reading the data set")
def show_data_set(
    folder: DataSet,
    psf: OwnPsf = None,
    check: Annotated[
        bool, typer.Option("--check", help="Read every file; the exit status is 1 if one is bad.")
    ] = False,
    every: Annotated[bool, typer.Option("--all", help="Also pairs that the list of test files leaves out.")] = False,
) -> None:
    """Say what a folder of lensless recordings holds: layout, pairs, sizes, PSFs, orientation."""
    from services.research import dataset_summary
    from services.research.datasets import open_dataset

    dataset = open_dataset(folder, psf, "all" if every else "test")
    typer.echo(dataset_summary.summary(dataset))
    if not check:
        return
    problems = dataset_summary.check(dataset, SystemClock(), say)
    for problem in problems:
        typer.echo(f"FAIL  {problem.pair}: {problem.reason}")
    typer.echo(f"{len(dataset) - len(problems)} of {len(dataset)} pairs can be read")
    raise typer.Exit(1 if problems else 0)


@app.command("bench")
def bench_data_set(
    folder: DataSet,
    psf: OwnPsf = None,
    limit: Limit = None,
    method: Methods = None,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of every method on every pair.")] = 3,
    json_file: Annotated[Path | None, typer.Option("--json", help="Where to write every score, as JSON.")] = None,
    peers: Peers = ENVIRONMENT,
    no_peers: NoPeers = False,
) -> None:
    """Compare all methods and LenslessPiCam on a data set: seconds, PSNR, SSIM and PCC, with their spread over pairs.

    The exit status is 1 if a pair, or a method on a pair, was left out.
    """
    from services.research import benchmark  # imports the simulator only for this command
    from services.research.datasets import open_dataset
    from services.research.pair_scores import table

    request = benchmark.BenchmarkRequest(
        open_dataset(folder, psf), limit, tuple(method or ()), repeats, json_file, resources.fft_plans()
    )
    with installed_peer(None if no_peers else peers, benchmark.LENSLESS_ROUNDS, say) as peer:
        found = benchmark.benchmark(request, peer, SystemClock(), say)
    typer.echo(table(found.rows))
    for left_out in found.left_out:
        typer.echo(f"left out: {left_out}")
    raise typer.Exit(1 if found.left_out else 0)


def _run_experiments(package: str, words: list[str]) -> None:
    """Run a package of experiments of the checkout as a process, with the words that follow its command."""
    if not (resources.ROOT / "tests" / package).is_dir():
        raise SettingError(
            f"`diffuscope {package}` runs experiments that an installed package does not hold",
            "Run it in a checkout of the project, after `make .venv/ready`.",
        )
    # -P: a folder `tests` of the working directory is not that of the checkout.
    command = [sys.executable, "-P", "-m", f"tests.{package}", *words]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(resources.ROOT)}, check=False)
    raise typer.Exit(done.returncode)


PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True}


@app.command(context_settings=PASSED_ON, add_help_option=False)
def paper(context: typer.Context) -> None:
    """Repeat the paper's experiments in the simulator and report them; fails if an assertion does not hold."""
    _run_experiments("paper", context.args)


@app.command(context_settings=PASSED_ON, add_help_option=False)
def hard(context: typer.Context) -> None:
    """Run the grid of hard cases: every kind of bad frame through every method and the default schedule."""
    _run_experiments("hard", context.args)


@app.command()
@announced("computing")
def optics(
    head: Annotated[
        Path | None,
        typer.Option(callback=_head_file, help="Head file, or the name of a shipped one: imx296."),
    ] = None,
    sensor: Annotated[str | None, typer.Option(help="A file of device/config/sensor_presets/, such as imx296.")] = None,
    eye_mm: Annotated[float | None, typer.Option(min=5, max=35, help="Focal length of the eye.")] = None,
    pupil_mm: Annotated[float | None, typer.Option(min=0.1, max=10, help="Diameter of its pupil.")] = None,
    svg: Annotated[Path | None, typer.Option(help="Where to draw the light path, to scale.")] = None,
    light: Annotated[
        bool, typer.Option("--light", help="The chain of light from LED to electron, and its limits.")
    ] = False,
    frames: Annotated[int, typer.Option(min=1, max=64, help="Frames of one picture, for --light.")] = 1,
    light_svg: Annotated[Path | None, typer.Option(help="Where to draw what limits the light.")] = None,
    search: Annotated[
        bool, typer.Option("--search", help="Search LEDs, ring, iris and exposure for enough light.")
    ] = False,
    design: Annotated[
        bool, typer.Option("--design", help="Search lenslets in place of the diffuser, for the head's own light.")
    ] = False,
    layout: Annotated[Path | None, typer.Option(help="Where --design writes the best layout, CSV.")] = None,
) -> None:
    """The optical budget of a head or a sensor: field, crop, scale, pupil, light; of all sensors if none is chosen."""
    from services.research.reconstruct_file import write_or_raise
    from services.workshop import head_search, lens_search, light_path_plot, light_report
    from services.workshop import optics_report as budget

    if head is not None and sensor is not None:
        raise typer.BadParameter("choose --head or --sensor, not both")
    if head is None and sensor is None:
        if svg or light or light_svg or search or design or eye_mm is not None or pupil_mm is not None:
            raise typer.BadParameter("choose --head or --sensor")
        typer.echo(budget.comparison())
        return
    chosen = budget.design(head, sensor, eye_mm, pupil_mm)
    if design:
        lens_search.design_layout(chosen, layout, typer.echo)
        return
    report = head_search.table if search else budget.table
    typer.echo(light_report.table(chosen, frames) if light and not search else report(chosen))
    if light_svg is not None:
        write_or_raise(
            light_svg, lambda: light_svg.write_text(light_report.gains_svg(chosen, frames), encoding="utf-8")
        )
        typer.echo(f"{light_svg}")
    if svg is not None:
        write_or_raise(svg, lambda: svg.write_text(light_path_plot.draw_light_path(chosen), encoding="utf-8"))
        typer.echo(f"{svg}")


@app.command()
@announced("listing the methods")
def methods(
    rows: Annotated[int, typer.Option(min=1, help="Rows of the frame.")] = 1080,
    cols: Annotated[int, typer.Option(min=1, help="Columns of the frame.")] = 1920,
) -> None:
    """List the solvers with their cost in FFT pairs and their memory for a frame size."""
    from device.recon.installed_methods import available_methods
    from device.recon.methods import DEFAULT
    from device.recon.model.grid import Grid

    found = available_methods().values()  # before the first line is printed: a plug-in may be wrong
    typer.echo(f"{'method':<12} {'FFT pairs':>9} {'memory':>8}   for {rows} x {cols}")
    for method in found:
        memory = f"{method.memory_bytes(Grid.periodic((rows, cols), 1, float('inf'))) / 1e6:.0f} MB"
        mark = " (default)" if method.name == DEFAULT else ""
        typer.echo(f"{method.name:<12} {method.fft_pairs:>9} {memory:>8}   {method.sentence}{mark}")


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(version("diffuscope"))
        raise typer.Exit


@app.callback()
def root(
    _: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version, and exit.")
    ] = False,
) -> None:
    """Image reconstruction for a funduscope whose lens is a piece of diffuser; and the whole instrument."""


def main(words: list[str] | None = None, program: typer.Typer = app, name: str | None = None) -> None:
    """Run a program with `words`, by default `diffuscope` with the process arguments; `name` is shown in its help.

    For a DiffuscopeError, or a command that needs an extra (`instrument`, `archive`) which is not installed, print the
    message and its remedy to stderr and exit with status 2.
    """
    if words is None:  # in a process of its own: what was imported is no garbage, and each collection would search it
        gc.freeze()
    try:
        program(words, prog_name=name)
    except DiffuscopeError as error:
        typer.echo(f"error: {error.message}\n{error.remedy}", err=True)
        sys.exit(2)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        extras = {"instrument": INSTRUMENT_PACKAGES, "archive": ARCHIVE_PACKAGES}
        missing = [extra for extra, packages in extras.items() if package in packages]
        if not missing:
            raise
        remedy = f'Install it with: pip install "diffuscope[{missing[0]}]", in a clone: pip install ".[{missing[0]}]"'
        typer.echo(f"error: this command needs {error.name}, which is not installed\n{remedy}", err=True)
        sys.exit(2)
