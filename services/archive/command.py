"""Command `diffuscope archive plan|run|report|adopt`: reprocess every stored raw frame, on one machine or a cluster."""

from pathlib import Path
from typing import Annotated

import typer

from device.clock import SystemClock
from services.archive.plan import PlanSettings, read_plan, write_plan
from services.research.reconstruct_file import require_writable
from services.running_time import announced, say

app = typer.Typer(help="Reprocess an archive of raw frames: plan, run, report, adopt.", no_args_is_help=True)


@app.command()
@announced("planning")
def plan(
    source: Annotated[list[Path], typer.Argument(help="A store, exports, or a folder with raw frames and psf.tiff.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Where to write the plan, as TOML.")],
    method: Annotated[str | None, typer.Option(help="A name of `diffuscope methods`; else what suits a frame.")] = None,
    rounds: Annotated[int | None, typer.Option(help="Rounds of an iterative method, at the most.")] = None,
    budget_s: Annotated[float | None, typer.Option(help="Seconds for each capture; results depend on them.")] = None,
) -> None:
    """List what would be reconstructed, and how; nothing is computed yet."""
    from services.archive.planning import make_plan

    require_writable(output)
    settings = PlanSettings(method=method, rounds=rounds, budget_s=budget_s)
    made = make_plan(source, settings, SystemClock(), say)
    write_plan(made, output)
    for left_out in made.left_out[:20]:
        say(f"left out: {left_out.id}: {left_out.reason}")
    if len(made.left_out) > 20:
        say(f"and {len(made.left_out) - 20} more, which the plan lists")
    counts = f"{len(made.captures)} captures with {len(made.calibrations)} calibrations"
    typer.echo(f"{output}: {counts}; {len(made.left_out)} left out")


@app.command()
@announced("reconstructing")
def run(
    plan: Annotated[Path, typer.Argument(help="A plan of `diffuscope archive plan`.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the results; again to resume.")],
    workers: Annotated[int | None, typer.Option(min=1, help="Processes on this machine; else one per core.")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler, as tcp://host:8786.")] = None,
) -> None:
    """Reconstruct what a plan lists and has no result yet; write captures.parquet. Exit status 1 if some failed."""
    from services.archive.result import QUARANTINE
    from services.archive.run import run_plan  # deferred: imports Dask and pyarrow, of the extra `archive`

    if workers is not None and scheduler is not None:
        raise typer.BadParameter("choose --workers on this machine or --scheduler, not both")
    ran = run_plan(read_plan(plan), output, SystemClock(), say, workers, scheduler)
    typer.echo(
        f"{output}: {ran.done} with a result, {ran.quarantined} in quarantine, {ran.left_out} left out; "
        f"{ran.computed} computed in {ran.seconds:.0f} s"
    )
    if ran.quarantined:
        typer.echo(f"reasons and remedies: {output / QUARANTINE}")
    raise typer.Exit(1 if ran.quarantined else 0)


@app.command()
@announced("writing the page")
def report(
    folder: Annotated[Path, typer.Argument(help="Folder of `diffuscope archive run`.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Where to write the page, as HTML.")],
) -> None:
    """Write one page: quality before and after, best and worst as pictures, drift, retakes, refraction, cost."""
    from services.archive.report import write_report  # deferred: imports pyarrow, of the extra `archive`

    require_writable(output)
    typer.echo(f"{output}: {write_report(folder, output, say)}")


@app.command()
@announced("adopting")
def adopt(
    folder: Annotated[Path, typer.Argument(help="Folder of `diffuscope archive run`.")],
    data: Annotated[Path, typer.Option(help="Where captures are kept; stop the instrument first.")],
) -> None:
    """Store the results as later versions of the captures; those as taken stay. Exit status 1 if some are refused."""
    from services.archive.adopt import adopt_results  # deferred: imports SQLAlchemy, of the extra `instrument`

    done = adopt_results(folder, data, SystemClock(), say)
    for refused in done.refused[:20]:
        say(f"refused: {refused.id}: {refused.reason}. {refused.remedy}")
    if len(done.refused) > 20:
        say(f"and {len(done.refused) - 20} more")
    typer.echo(
        f"{data}: {done.adopted} adopted, {done.known} adopted before, {len(done.refused)} refused, "
        f"{done.missing} without a result"
    )
    raise typer.Exit(1 if done.refused else 0)
