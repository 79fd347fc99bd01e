"""`python -m tests.paper`, which `diffuscope paper` starts: the paper's experiments with their report."""

from pathlib import Path
from typing import Annotated

import typer

from device.clock import SystemClock
from services.cli import main
from tests.paper import report
from tests.paper.results_page import write_page

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def paper(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for report.html.")],
    only: Annotated[
        list[str] | None, typer.Option(help="Just this experiment (N, T, S0 ... S13, M, L, D); may be repeated.")
    ] = None,
    merged: Annotated[int, typer.Option(min=1, max=3, help="Make n x n pixels one: quicker, a little coarser.")] = 1,
    page: Annotated[Path | None, typer.Option(help="Markdown page to write, its pictures beside it.")] = None,
) -> None:
    """Repeat the paper's experiments in the simulator and report them; fails if an assertion does not hold."""
    ran = report.run_experiments(output, SystemClock(), lambda line: typer.echo(line, err=True), only or (), merged)
    if page is not None:
        write_page(page, ran)
    typer.echo(report.table(ran))
    typer.echo(f"{output / 'report.html'}: {sum(done.seconds for done in ran):.0f} s")
    if not report.all_hold(ran):
        raise typer.Exit(1)


if __name__ == "__main__":  # several experiments run in processes, which import this module again
    main(program=app, name="diffuscope paper")
