"""SVG plot of a frontier measurement: PSNR against run time of every method, bin, number of rounds, and burst."""

from collections.abc import Mapping, Sequence
from math import log10

from device.recon.methods import METHODS, Method
from services.lab.frontier_result import Frontier, LightPoint, Point
from services.lab.plot import Mark, Plot, Series, log_axis, stacked_svg, time_axis, value_axis

BURST_KIND, BOUND_KIND = 6, 7  # of marks, the same in both plots


def draw_frontier(found: Frontier, methods: Mapping[str, Method] = METHODS) -> str:
    """Return the SVG of `found`, the result of `frontier.measure_frontier` with `methods`.

    Accuracy against time; below it, if bursts were measured, accuracy against the dose.
    """
    time = _time_plot(found, methods)
    return stacked_svg([time, _light_plot(found)] if found.light else [time])


def _time_plot(found: Frontier, methods: Mapping[str, Method]) -> Plot:
    points, choice, budget_s = found.points, found.choice, found.budget_s
    edge = sorted((p.seconds_median, p.psnr_db) for p in points if p.pareto)
    others = [(one.seconds_median, one.psnr_db) for one in found.light]
    others += [(one.seconds, one.psnr_db) for one in found.peers]
    seconds = [p.seconds_median for p in points] + [choice.solve_s, budget_s] + [one[0] for one in others]
    worths = [p.psnr_db for p in points] + [choice.psnr_db] + [one[1] for one in others]
    y = value_axis(worths, "accuracy: PSNR in dB after an affine intensity fit")
    words = "" if found.light else " (rounds)"  # the legend has no room for it beside bursts and peers
    return Plot(
        title=f"What accuracy costs in time{' and light' if found.light else ''}: {found.scene}",
        subtitle=_subtitle(found),
        description=_description(found, edge),
        x=time_axis(seconds, "from counts in memory to the picture on the sensor grid, refraction apart"),
        y=y,
        series=tuple(
            _series(points, method, words)
            for method in methods.values()
            if any(p.method == method.name for p in points)
        )
        + _peers(found)
        + _bursts_in_time(found),
        edge=tuple(edge),
        limit=(budget_s, f"budget {budget_s:g} s"),
        ring=(choice.solve_s, choice.psnr_db, "chosen" if found.light else "the instrument's choice"),
        right=_correlations(y.low, y.high, found.region.truth_variance),
        right_title="the same as correlation (PCC)",
    )


def _light_plot(found: Frontier) -> Plot:
    """Return accuracy against the dose: bursts, and the bound of a linear filter with as much light."""
    bursts, bounds = [], []
    for one in found.light:
        dose_uj_per_cm2, words = one.dose_j_per_cm2 * 1e6, _frames(one)
        spent = f"{words}, {dose_uj_per_cm2:.3g} uJ/cm2: {one.seconds_median * 1e3:.0f} ms"
        label = f"{words} in {one.seconds_median:.2g} s"
        bursts.append(Mark(dose_uj_per_cm2, one.psnr_db, label, f"{spent}, {one.psnr_db:.2f} dB"))
        bound = f"{spent}, linear bound {one.bound_psnr_db:.2f} dB"
        bounds.append(Mark(dose_uj_per_cm2, one.bound_psnr_db, "", bound, 0.7))
    doses = [one.x for one in bursts]
    worths = [one.y for one in bursts + bounds]
    y = value_axis(worths, "PSNR in dB", 0.15)
    return Plot(
        title="What more light buys",
        subtitle="bursts as the instrument solves them, refraction included; the best linear filter for as much light",
        description="",
        x=log_axis(doses, "retinal dose of all frames in uJ/cm2, weighted with the photochemical hazard", _number),
        y=y,
        series=(Series("burst", (tuple(bursts),), BURST_KIND), Series("linear bound", (tuple(bounds),), BOUND_KIND)),
        right=_correlations(y.low, y.high, found.region.truth_variance),
        right_title="PCC",
        height=360,
    )


def _frames(one: LightPoint) -> str:
    return f"{one.frames} frame{'s' if one.frames > 1 else ''}"


def _number(value: float) -> str:
    return f"{value:.3g}"


def _subtitle(found: Frontier) -> str:
    machine, frame = found.machine, found.frame
    kind = "simulated" if found.simulated else "recorded"
    return (
        f"{frame.rows} x {frame.cols} pixels, {kind}; {machine.cpu or 'unknown processor'}, "
        f"one FFT thread; {found.region.what}"
    )


def _description(found: Frontier, edge: list[tuple[float, float]]) -> str:
    choice = found.choice
    best = ", ".join(f"{value:.1f} dB in {seconds * 1e3:.0f} ms" for seconds, value in edge)
    bursts = ", ".join(
        f"{one.frames} frames {one.psnr_db:.1f} dB (linear bound {one.bound_psnr_db:.1f}) for "
        f"{one.dose_j_per_cm2 * 1e6:.3g} uJ/cm2"
        for one in found.light
    )
    return (
        f"Each mark is one method at one bin and one number of rounds: its median time, and its PSNR against the known "
        f"truth. The best within each time: {best}. Within {found.budget_s:g} s the instrument chooses "
        f"{choice.method}, bin {choice.bin}, {choice.rounds} rounds: {choice.psnr_db:.1f} dB in "
        f"{choice.solve_s * 1e3:.0f} ms, and looks for the eye's refraction in {choice.refract_s * 1e3:.0f} ms."
        + (f" More light, refraction included: {bursts}." if bursts else "")
    )


def _series(points: Sequence[Point], method: Method, words: str) -> Series:
    """Return the marks of one method; `words` follow the name of an iterative one.

    A closed-form method has one trail over the bins; an iterative one has a trail over the rounds of each bin.
    """
    own = [p for p in points if p.method == method.name]
    if method.round_pairs == 0:
        return Series(method.name, (tuple(_mark(p, method, f"bin {p.bin}") for p in own),))
    trails = []
    for n in sorted({p.bin for p in own}):
        rounds = [p for p in own if p.bin == n]
        labels = [f"bin {n}", *(str(p.rounds) if p.pareto else "" for p in rounds[1:])]
        trails.append(tuple(_mark(p, method, label) for p, label in zip(rounds, labels, strict=True)))
    return Series(f"{method.name}{words}", tuple(trails))


def _peers(found: Frontier) -> tuple[Series, ...]:
    """Return the marks of other people's solvers."""
    marks = tuple(
        Mark(one.seconds, one.psnr_db, one.name.split(", ")[-1].removesuffix(" rounds"),
             f"{one.name}: {one.seconds:.2f} s, {one.psnr_db:.2f} dB, PCC {one.pcc:.3f}", 0.9)
        for one in found.peers
    )  # fmt: skip
    return (Series("LenslessPiCam", (marks,)),) if marks else ()


def _bursts_in_time(found: Frontier) -> tuple[Series, ...]:
    """Return the bursts at their times, refraction included."""
    marks = tuple(
        Mark(one.seconds_median, one.psnr_db, _frames(one),
             f"{_frames(one)}: {one.seconds_median * 1e3:.0f} ms, {one.psnr_db:.2f} dB")
        for one in found.light
    )  # fmt: skip
    return (Series("burst", (marks,), BURST_KIND),) if marks else ()


def _mark(point: Point, method: Method, label: str) -> Mark:
    ms = point.seconds_median * 1e3
    rounds = f", {point.rounds} rounds" if method.round_pairs else ""
    tooltip = f"{point.method}, bin {point.bin}{rounds}: {ms:.1f} ms, {point.psnr_db:.2f} dB, PCC {point.pcc:.3f}"
    return Mark(point.seconds_median, point.psnr_db, label, tooltip, 1.0 if point.pareto else 0.75)


def _correlations(low_db: float, high_db: float, truth_variance: float) -> tuple[tuple[float, str], ...]:
    """Return ticks for the right axis: the PSNR in dB and the text of round correlations (PCC) in the plotted range.

    After the best affine fit, mse = `truth_variance` (1 - PCC^2). Ticks that are too close are left out.
    """
    ladder = (0.2, 0.4, 0.6, 0.7, 0.8, 0.85, 0.9, 0.92, 0.94, 0.95, 0.96, 0.97, 0.975, 0.98, 0.985, 0.99, 0.995, 0.999)
    places = [(-10 * log10(max(truth_variance * (1 - pcc**2), 1e-20)), f"{pcc:g}") for pcc in ladder]
    apart: list[tuple[float, str]] = []
    for place in places:
        if low_db <= place[0] <= high_db and (not apart or place[0] - apart[-1][0] > 0.04 * (high_db - low_db)):
            apart.append(place)
    return tuple(apart)
