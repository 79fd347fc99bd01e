"""The `diffuscope` command: every word of it starts one capability, and every mistake is answered with a remedy."""

import json
import os
import sys
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from device.clock import SystemClock
from device.errors import DiffuscopeError
from device.head import recording
from device.recon.geometry import Grid
from device.recon.methods import DEFAULT, METHODS
from device.spec import InstrumentSpec, load_head
from device.values import Colour
from services import resources
from services.instrument import calibrations
from services.instrument.once import Order, reconstruct_file, written
from services.records.command import app as snapshots
from services.update.command import app as update_app

app = typer.Typer(
    name="diffuscope", help="A funduscope whose lens is a piece of diffuser.", no_args_is_help=True,
    add_completion=False, pretty_exceptions_enable=False,
)  # fmt: skip
app.add_typer(calibrations.app, name="calibrations")

app.add_typer(update_app, name="update")
app.add_typer(snapshots, name="snapshots")

SIM_HEAD = resources.HEADS / "sim.toml"


def _default_data() -> Path:
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "diffuscope"


@app.command()
def run(
    head: Annotated[Path | None, typer.Option(help="Head file; the simulated head if nothing is given.")] = None,
    replay: Annotated[Path | None, typer.Option(help="Folder with a recording, played instead of a head.")] = None,
    raw: Annotated[list[Path] | None, typer.Option(help="Raw frames of a recording, with --psf.")] = None,
    psf: Annotated[list[Path] | None, typer.Option(help="PSF of a recording, or a stack of them.")] = None,
    host: Annotated[str, typer.Option(help="Address to serve on; 0.0.0.0 for the whole network.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535)] = 8000,
    data: Annotated[Path | None, typer.Option(help="Where captures are kept.")] = None,
    protocol: Annotated[Path | None, typer.Option(help="What a screening consists of, as TOML.")] = None,
    name: Annotated[list[str] | None, typer.Option(help="A name of this computer in the network.")] = None,
    updates: Annotated[
        Path | None, typer.Option(help="The updater's folder, for the page to show.", readable=False)
    ] = None,
    wishes: Annotated[
        Path | None, typer.Option(help="Where the updater takes what the page asks for.", readable=False)
    ] = None,
    send: Annotated[Path | None, typer.Option(help="Where finished visits are sent, as TOML; else nowhere.")] = None,
) -> None:
    """Serve the page: one button, one true picture."""
    from services.instrument.carrier import Https, load_settings
    from services.instrument.serve import bound, handed_over, serve  # opens the web stack; others do not need it
    from services.instrument.watchdog import Watchdog
    from services.records.protocol import STANDARD, load_protocol

    spec, plan = _chosen(head, replay, tuple(raw or ()), tuple(psf or ())), load_protocol(protocol or STANDARD)
    carrier = Https(load_settings(send)) if send is not None else None
    typer.echo(f"{spec.name}: getting ready (the first start measures this computer, about half a minute)")
    address = handed_over(os.environ) or bound(host, port)
    served, at = address.getsockname()[:2]
    serve(
        spec, address, data or _default_data(), lambda: typer.echo(f"Open http://{served}:{at} in a browser"),
        Watchdog(os.environ.get("NOTIFY_SOCKET")), plan, tuple(name or ()), (updates, wishes), carrier,
    )  # fmt: skip


def _chosen(head: Path | None, replay: Path | None, raws: tuple[Path, ...], psfs: tuple[Path, ...]) -> InstrumentSpec:
    if replay is not None or raws or psfs:
        if head is not None:
            raise typer.BadParameter("choose --head or a recording (--replay, --raw with --psf), not both")
        return recording(replay or raws[0].parent if raws else replay or Path(), raws, psfs)
    return load_head(head or SIM_HEAD)


@app.command()
def reconstruct(
    raw: Annotated[Path, typer.Argument(help="Raw frame: tiff, png or npy; 2-D or three channels.")],
    output: Annotated[Path, typer.Option("--output", "-o", help=".npy or .tiff: linear float32; .png: for eyes.")],
    psf: Annotated[
        list[Path] | None, typer.Option(help="Measured PSF; several are a stack, the best is chosen.")
    ] = None,
    calibration: Annotated[
        str | None,
        typer.Option(metavar="DIR[:ID]", help="Instead of PSFs: a kept calibration; without ID the one in force."),
    ] = None,
    method: Annotated[
        str | None, typer.Option(help="A name of `diffuscope methods`; by default what suits the frame.")
    ] = None,
    budget_s: Annotated[float | None, typer.Option(help="Seconds from the loaded frame to the result.")] = None,
    dark: Annotated[Path | None, typer.Option(help="Dark frame of the same exposure.")] = None,
    flat: Annotated[Path | None, typer.Option(help="Flat frame: the sensor's response to even light.")] = None,
    head: Annotated[Path | None, typer.Option(help="Head file, for the geometry.")] = None,
    field_deg: Annotated[float | None, typer.Option(help="Illuminated disc around the centre, in degrees.")] = None,
    even: Annotated[
        bool, typer.Option("--even", help="Even out the illumination (paper: flat-field correction).")
    ] = False,
    report: Annotated[Path | None, typer.Option(help="Where to write the report as JSON.")] = None,
    sweep: Annotated[
        Path | None, typer.Option(help="Where to draw how well each of several PSFs fits, as SVG.")
    ] = None,
) -> None:
    """Turn one raw frame into a picture, without a head and without a page."""
    order = Order(
        raw, tuple(psf or ()), output, method, budget_s, dark, flat, head, field_deg, even, _cache(), report, sweep,
        calibration,
    )  # fmt: skip
    made = reconstruct_file(order)
    text = json.dumps(asdict(made.report), indent=1)
    if report is not None:
        written(report, lambda: report.write_text(text + "\n", encoding="utf-8"))
    seconds = sum(made.report.seconds.values())
    typer.echo(f"{output}: {made.report.method}, bin {made.report.bin}, {seconds:.3f} s")
    for warning in made.report.warnings:
        typer.echo(f"note: {warning}", err=True)


def _cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "diffuscope"


@app.command()
def health(
    at: Annotated[str, typer.Option(help="Address of the running instrument.")] = "http://127.0.0.1:8000",
    look: Annotated[bool, typer.Option("--look", help="Also take a live picture, which shines for a moment.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the list for a program.")] = False,
) -> None:
    """Ask the running instrument whether it could take a picture now; the exit status is 1 if a check fails."""
    from services.health import probe

    checks = probe.examine(at, look)
    typer.echo(json.dumps(probe.as_json(checks), indent=1) if as_json else probe.table(checks))
    raise typer.Exit(0 if all(check.ok for check in checks) else 1)


@app.command("probe")
def probe_head(head: Annotated[Path, typer.Option(help="Head file, such as hardware/heads/imx296.toml.")]) -> None:
    """Ask every part of a head whether it is there: camera, lamp and each of its LEDs, chips.

    The lamp shines, and its light is not counted for an eye: point the head at white paper. The exit status is 1 if a
    part is not well.
    """
    from device.probe import probe  # the drivers, which the other commands do not need

    well = True
    for found in probe(load_head(head), SystemClock()):
        well &= found.ok
        typer.echo(f"{'ok  ' if found.ok else 'FAIL'}  {found.part:<14} {found.said}")
        if found.remedy:
            typer.echo(f"{'':<22}{found.remedy}")
    raise typer.Exit(0 if well else 1)


@app.command("calibrate")
def calibrate_head(
    head: Annotated[Path, typer.Option(help="Head file, such as hardware/heads/imx296.toml.")],
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
    from services.instrument.calibrating import Wish, calibrate  # the drivers, which the other commands do not need

    def ask(said: str) -> None:
        typer.prompt(f"{said} Then press Enter", default="", show_default=False)

    mishaps = {stand: name for stand, _, name in (said.partition("=") for said in mishap or ())}
    wish = Wish(archive, serial, by, source_deg, eye_mm, dioptres, _colours(colours), keep_raw, leds, mishaps)
    kept = calibrate(load_head(head), wish, SystemClock(), ask, typer.echo)
    sensor, known = kept.calibration.sensor, dict(kept.provenance.figures)
    typer.echo(f"black {sensor.black_dn:.2f} DN, gain {sensor.gain_e_per_dn:.3f} e-/DN, white {sensor.white_dn:.0f} DN")
    typer.echo(f"read noise {sensor.read_noise_e:.2f} e-, " + ", ".join(f"{k} {v:.3g}" for k, v in known.items()))
    typer.echo(f"{kept.calibration.id} is in force in {archive}")


def _colours(words: str) -> tuple[Colour, ...]:
    known: dict[str, Colour] = {"red": "red", "green": "green", "blue": "blue"}
    named = [word.strip() for word in words.split(",") if word.strip()]
    if strange := [word for word in named if word not in known]:
        raise typer.BadParameter(f"--colours {strange[0]!r} is none of {', '.join(known)}")
    return tuple(known[word] for word in named)


@app.command("check")
def check_head(
    head: Annotated[Path, typer.Option(help="Head file, such as hardware/heads/imx296.toml.")],
    archive: Annotated[Path | None, typer.Option(help="Of calibrations; by default the one in the head file.")] = None,
    data: Annotated[Path | None, typer.Option(help="Where captures are kept.")] = None,
) -> None:
    """Ask whether the calibration in force still fits the head: after a drop, or when pictures look odd.

    The last captures tell; without any, dark frames are taken now. The exit status is 1 if a finding fails.
    """
    from services.instrument.checking import checked, table, with_archive  # the drivers, which others do not need

    spec = with_archive(load_head(head), archive)
    if spec.calibration is None:
        raise typer.BadParameter("the head file names no archive of calibrations; give one with --archive")
    found = checked(spec, data or _default_data(), SystemClock(), lambda line: typer.echo(line, err=True))
    typer.echo(f"calibration {found.kept.calibration.id} of {found.kept.provenance.serial}")
    typer.echo(table(found))
    raise typer.Exit(1 if any(one.fails for one in found.findings) else 0)


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(help="Scene file; ready ones are in device/sim/scenes/.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder to write into.")] = None,
    explain: Annotated[bool, typer.Option("--explain", help="Print the plan, and render nothing.")] = False,
    everything: Annotated[bool, typer.Option("--all", help="Simulate all effects, seen or not.")] = False,
    only: Annotated[list[str] | None, typer.Option(help="Simulate just this effect; may be repeated.")] = None,
    without: Annotated[list[str] | None, typer.Option(help="Leave this effect out; may be repeated.")] = None,
) -> None:
    """Write what the camera would give for a scene: raw.tiff, truth.npy, psf.tiff, plan.json.

    Only the effects that the scene calls for are simulated; the plan says for each which number decided.
    """
    from device.sim import exposure, plan  # the simulator, which the other commands do not need
    from device.sim.setup import Scene

    spec = load_head(scene)
    choose = partial(plan.decide, everything=everything, only=only or (), without=without or ())
    if explain:
        typer.echo(plan.table(choose(Scene(spec, spec.light.colour))))
        return
    if output is None:
        raise typer.BadParameter("give -o FOLDER to write into, or --explain to see the plan only")
    world = exposure.simulate(spec, output, choose)
    typer.echo(plan.table(world.plan, world.setup(spec.light.colour).spent_ms))
    typer.echo(f"{output}: raw.tiff, truth.npy, psf.tiff, plan.json")


@app.command()
def frontier(
    json_file: Annotated[Path, typer.Option("--json", help="Where to write every point, as JSON.")],
    plot: Annotated[Path, typer.Option(help="Where to draw accuracy against time, as SVG.")],
    scene: Annotated[Path | None, typer.Option(help="Scene file; its truth is known.")] = None,
    raw: Annotated[Path | None, typer.Option(help="Raw frame, with --psf and --truth.")] = None,
    psf: Annotated[Path | None, typer.Option(help="Measured PSF of the raw frame.")] = None,
    truth: Annotated[Path | None, typer.Option(help="What the picture should be, on the raw's own pixels.")] = None,
    head: Annotated[Path | None, typer.Option(help="Head file, for the geometry of a raw frame.")] = None,
    field_deg: Annotated[float | None, typer.Option(help="Illuminated disc of a raw frame, in degrees.")] = None,
    budget_s: Annotated[float, typer.Option(help="The time within which the instrument chooses.")] = 0.26,
    repeats: Annotated[int, typer.Option(min=1, help="Timed turns of every point; the median counts.")] = 7,
) -> None:
    """Measure accuracy against time: every method, bin and number of rounds, on this machine."""
    from services.instrument import frontier as measured  # the simulator, which a picture does not need

    wish = measured.Wish(scene, raw, psf, truth, head, field_deg, json_file, plot, budget_s, repeats, _cache())
    typer.echo(measured.table(measured.frontier(wish, lambda line: typer.echo(line, err=True))))
    typer.echo(f"{json_file}, {plot}")


@app.command()
def paper(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for report.html.")],
    only: Annotated[
        list[str] | None, typer.Option(help="Just this experiment (N, S0 ... S13, M, L); may be repeated.")
    ] = None,
    merged: Annotated[int, typer.Option(min=1, max=3, help="Make n x n pixels one: quicker, a little coarser.")] = 1,
) -> None:
    """Repeat the paper's experiments in the simulator and report them; fails if an assertion does not hold."""
    from services.instrument.paper import report  # the simulator, which a picture does not need

    ran = report.rerun(output, SystemClock(), lambda line: typer.echo(line, err=True), only or (), merged)
    typer.echo(report.table(ran))
    typer.echo(f"{output / 'report.html'}: {sum(one.seconds for one in ran):.0f} s")
    if not report.all_hold(ran):
        raise typer.Exit(1)


@app.command()
def hard(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for hard-cases.json, .md and pictures.")],
    case: Annotated[list[str] | None, typer.Option(help="Just this row; may be repeated.")] = None,
    method: Annotated[
        list[str] | None, typer.Option(help="Just this column: ladder (as shipped) or a method; may be repeated.")
    ] = None,
    merged: Annotated[int, typer.Option(min=1, max=4, help="Make n x n pixels one: quicker, a little coarser.")] = 1,
    check: Annotated[bool, typer.Option("--check", help="The exit status is 1 if there is a violation.")] = False,
) -> None:
    """Run the grid of hard cases: every kind of bad frame through every method and the ladder as shipped."""
    from services.instrument.hard_cases import grid  # the simulator, which a picture does not need
    from services.instrument.hard_cases.cells import COLUMNS

    eyes = tuple(replace(eye, merged=merged) for eye in grid.EYES)
    found = grid.run(eyes, case or (), tuple(method or COLUMNS), lambda line: typer.echo(line, err=True))
    grid.write(output, found)
    typer.echo(grid.summary(found))
    typer.echo(f"{output}: hard-cases.json, hard-cases.md and a picture of each eye")
    if check and found.violations:
        raise typer.Exit(1)


@app.command()
def optics(
    head: Annotated[Path | None, typer.Option(help="Head file, such as hardware/heads/imx296.toml.")] = None,
    sensor: Annotated[str | None, typer.Option(help="A sensor of device/sensors.py, such as imx296.")] = None,
    eye_mm: Annotated[float | None, typer.Option(min=5, max=35, help="Focal length of the eye.")] = None,
    pupil_mm: Annotated[float | None, typer.Option(min=0.1, max=10, help="Diameter of its pupil.")] = None,
    svg: Annotated[Path | None, typer.Option(help="Where to draw the light path, to scale.")] = None,
) -> None:
    """The optical budget of a head or a sensor: field, crop, scale, pupil, light; of all sensors if none is chosen."""
    from services.instrument import light_path_plot
    from services.instrument import optics as budget

    if head is not None and sensor is not None:
        raise typer.BadParameter("choose --head or --sensor, not both")
    if head is None and sensor is None:
        if svg is not None or eye_mm is not None or pupil_mm is not None:
            raise typer.BadParameter("choose --head or --sensor")
        typer.echo(budget.comparison())
        return
    chosen = budget.design(head, sensor, eye_mm, pupil_mm)
    typer.echo(budget.table(chosen))
    if svg is not None:
        written(svg, lambda: svg.write_text(light_path_plot.drawn(chosen), encoding="utf-8"))
        typer.echo(f"{svg}")


@app.command()
def methods(
    rows: Annotated[int, typer.Option(min=1, help="Rows of the frame.")] = 1080,
    cols: Annotated[int, typer.Option(min=1, help="Columns of the frame.")] = 1920,
) -> None:
    """List the solvers with their cost in FFT pairs and their memory for a frame size."""
    typer.echo(f"{'method':<12} {'FFT pairs':>9} {'memory':>8}   for {rows} x {cols}")
    for method in METHODS.values():
        memory = f"{method.memory_bytes(Grid.periodic((rows, cols), 1, float('inf'))) / 1e6:.0f} MB"
        mark = " (default)" if method.name == DEFAULT else ""
        typer.echo(f"{method.name:<12} {method.fft_pairs:>9} {memory:>8}   {method.sentence}{mark}")


def main(words: list[str] | None = None) -> None:
    """Run the command line (or the given words); an error of ours is a sentence and a remedy, never a traceback."""
    try:
        app(words)
    except DiffuscopeError as error:
        typer.echo(f"error: {error.message}\n{error.remedy}", err=True)
        sys.exit(2)
