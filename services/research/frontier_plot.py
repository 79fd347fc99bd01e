"""SVG plot of a frontier measurement: PSNR against run time of every method, bin, number of rounds, and burst."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import log10

from device.recon.methods import METHODS, Method
from services.plot import Mark, Panel, Plot, Series, log_axis, stacked_svg, time_axis, value_axis
from services.research.fft_time import pi5_s
from services.research.frontier_result import Choice, Frontier, Point, PressPoint, pareto_front
from services.research.frontier_thumbnails import LETTERS, nearest_points

PEER_KIND, BURST_KIND, BOUND_KIND = 5, 6, 7  # of marks, the same in both plots
LETTER_WEIGHT = 1.2  # of the marks of thumbnails
MIN_REFRACTION_S = 0.001  # less is the decision against an estimate, not an estimate


def draw_frontier(found: Frontier, methods: Mapping[str, Method] = METHODS, thumbnails: Panel | None = None) -> str:
    """Return the SVG of `found`, the result of `frontier.measure_frontier` with `methods`.

    It shows accuracy against time, `thumbnails` of the points that have letters, and accuracy against the dose if
    bursts were measured.
    """
    points = drawn_points(found)
    shown = nearest_points(points, ringed(found)[-1].seconds_median) if thumbnails else ()
    letters = dict(zip((_key(p) for p in shown), LETTERS, strict=False))
    plots = [_time_plot(found, methods, points, letters)]
    if found.light:
        plots.append(_light_plot(found))
    return stacked_svg(plots, [thumbnails] if thumbnails else [])


def draw_heads(found: Sequence[Frontier]) -> str:
    """Return the SVG of the frontiers of several heads: accuracy against time, one panel each, on one scale."""
    plots = [_time_plot(head, METHODS, drawn_points(head), {}) for head in found]
    marks = (mark for plot in plots for curve in plot.series for trail in curve.trails for mark in trail)
    y = value_axis([mark.y for mark in marks], plots[0].y.title)
    alike = (
        replace(plot, title=head.scene, y=y, right=_correlations(y.low, y.high, head.region.truth_variance))
        for plot, head in zip(plots, found, strict=True)
    )
    return stacked_svg([*alike])


def ringed(found: Frontier) -> tuple[PressPoint, ...] | tuple[Choice]:
    """Return the points with a ring: what a press does with each time budget; of a recorded frame the choice."""
    return found.presses or (found.choice,)


def drawn_points(found: Frontier) -> tuple[Point, ...]:
    """Return the points of the plot, with the Pareto front among them.

    The method for an unknown field is left out where the field is known: the instrument never uses it there.
    """
    points = [p for p in found.points if not (found.region.field_known and p.method == "open")]
    front = pareto_front([(p.seconds_median, p.psnr_db) for p in points])
    return tuple(replace(point, pareto=on) for point, on in zip(points, front, strict=True))


def _key(point: Point) -> tuple[str, int, int]:
    return point.method, point.bin, point.rounds


def _time_plot(
    found: Frontier, methods: Mapping[str, Method], points: Sequence[Point], letters: Mapping[tuple[str, int, int], str]
) -> Plot:
    limits = tuple((press.budget_s, f"{press.choice} {press.budget_s:g} s") for press in found.presses) or (
        (found.budget_s, f"budget {found.budget_s:g} s"),
    )
    edge = sorted((p.seconds_median, p.psnr_db) for p in points if p.pareto)
    words = "" if found.light else " (rounds)"  # the legend has no room for it beside bursts and peers
    kinds = {name: kind for kind, name in enumerate(dict.fromkeys((*METHODS, *methods)))}  # the choice is built in
    letter = LETTERS[len(letters)] if letters else ""
    series = (
        *_best_mus(found),
        *(
            _series(points, method, kinds[method.name], words, letters)
            for method in methods.values()
            if any(p.method == method.name for p in points)
        ),
        _presses(found, letter) if found.presses else _chosen(found, kinds[found.choice.method], letter),
        *_peers(found),
        *_bursts_in_time(found),
    )
    marks = [mark for curve in series for trail in curve.trails for mark in trail]
    y = value_axis([mark.y for mark in marks], "accuracy: PSNR in dB after an affine intensity fit")
    return Plot(
        title=f"Accuracy against time{' and light' if found.light else ''}: {found.scene}",
        subtitle=_subtitle(found),
        description=_description(found, edge),
        x=time_axis([mark.x for mark in marks] + [at for at, _ in limits], _axis_title(found), found.fft_pair_s),
        y=y,
        series=series,
        edge=tuple(edge),
        limits=limits,
        rings=tuple((p.seconds_median, p.psnr_db, "a press" if found.presses else "chosen") for p in ringed(found)),
        right=_correlations(y.low, y.high, found.region.truth_variance),
        right_title="the same as correlation (PCC)",
    )


def _axis_title(found: Frontier) -> str:
    if found.presses:
        return "from counts in memory to the picture; of a press from its last frame, with the eye's refraction"
    return f"from counts in memory to the picture; {_refraction(found)}"


def _refraction(found: Frontier) -> str:
    if found.choice.refract_s < MIN_REFRACTION_S:
        return "the budget leaves no time for the eye's refraction"
    return f"the chosen one includes {found.choice.refract_s * 1e3:.0f} ms for the eye's refraction"


def _best_mus(found: Frontier) -> tuple[Series, ...]:
    """Return the paper's method by the paper's rule: the best mu of its range, chosen by the truth."""
    marks = tuple(
        Mark(
            best.seconds_median,
            best.psnr_db,
            f"bin {best.bin}",
            f"tikhonov with mu {best.mu:.0e}, the best of the paper's range, bin {best.bin}: "
            f"{best.seconds_median * 1e3:.1f} ms, {best.psnr_db:.2f} dB, PCC {best.pcc:.3f}",
            0.95,
        )
        for best in found.best_mu
    )
    return (Series("tikhonov, best mu", (marks,), 0),) if marks else ()


def _chosen(found: Frontier, kind: int, letter: str) -> Series:
    """Return the instrument's choice: a line from its time without the refraction to the whole time."""
    choice = found.choice
    tooltip = (
        f"chosen: {choice.method}, bin {choice.bin}, {choice.rounds} rounds: {choice.solve_s * 1e3:.0f} ms and "
        f"{choice.refract_s * 1e3:.0f} ms for the refraction, {choice.psnr_db:.2f} dB, PCC {choice.pcc:.3f}"
    )
    start = Mark(choice.solve_s, choice.psnr_db, weight=0.0)
    whole = Mark(choice.seconds_median, choice.psnr_db, letter, tooltip, LETTER_WEIGHT)
    return Series("chosen", ((start, whole),), kind, named=False)


def _presses(found: Frontier, letter: str) -> Series:
    """Return what a press does with each choice of the time budget; the last one has the letter of its thumbnail."""
    marks = [
        Mark(
            press.seconds_median,
            press.psnr_db,
            press.choice,
            f"a press with the choice {press.choice}, {press.frames} lit: {press.method}, bin {press.bin}, "
            f"{press.rounds} rounds, {press.seconds_median * 1e3:.0f} ms, {press.psnr_db:.2f} dB, PCC {press.pcc:.3f}",
        )
        for press in found.presses
    ]
    if letter:
        marks[-1] = replace(marks[-1], label=letter, weight=LETTER_WEIGHT)
    return Series("press", tuple((mark,) for mark in marks), BURST_KIND, named=False)


def _light_plot(found: Frontier) -> Plot:
    """Return accuracy against the dose: bursts, and the bound of a linear filter with as much light."""
    bursts = []
    bounds = []
    for burst in found.light:
        dose_uj_per_cm2 = burst.dose_j_per_cm2 * 1e6
        words = burst.length
        spent = f"{words}, {dose_uj_per_cm2:.3g} uJ/cm2: {burst.seconds_median * 1e3:.0f} ms"
        label = f"{words} in {burst.seconds_median:.2g} s"
        bursts.append(Mark(dose_uj_per_cm2, burst.psnr_db, label, f"{spent}, {burst.psnr_db:.2f} dB"))
        bound = f"{spent}, linear bound {burst.bound_psnr_db:.2f} dB"
        bounds.append(Mark(dose_uj_per_cm2, burst.bound_psnr_db, "", bound, 0.7))
    doses = [mark.x for mark in bursts]
    worths = [mark.y for mark in bursts + bounds]
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


def _number(value: float) -> str:
    return f"{value:g}"


def _subtitle(found: Frontier) -> str:
    machine = found.machine
    frame = found.frame
    kind = "simulated" if found.simulated else "recorded"
    pi_ms = 1e3 * pi5_s(1, (frame.rows, frame.cols))
    return (
        f"{frame.rows} x {frame.cols} pixels, {kind}; {machine.cpu or 'unknown processor'}, one FFT thread: "
        f"{1e3 * found.fft_pair_s:.3g} ms a pair (Raspberry Pi 5: {pi_ms:.2g} ms, not measured)"
    )


def _description(found: Frontier, edge: list[tuple[float, float]]) -> str:
    choice = found.choice
    best = ", ".join(f"{value:.1f} dB in {seconds * 1e3:.0f} ms" for seconds, value in edge)
    bursts = ", ".join(
        f"{burst.length} {burst.psnr_db:.1f} dB (linear bound {burst.bound_psnr_db:.1f}) for "
        f"{burst.dose_j_per_cm2 * 1e6:.3g} uJ/cm2"
        for burst in found.light
    )
    return (
        f"Each mark is one method at one bin and one number of rounds: its median time, and its PSNR against the known "
        f"truth; scored: {found.region.what}. The best within each time: {best}. "
        f"Within {found.budget_s:g} s the instrument chooses {choice.method}, bin {choice.bin}, "
        f"{choice.rounds} rounds: {choice.psnr_db:.1f} dB in {choice.solve_s * 1e3:.0f} ms; {_refraction(found)}."
        + "".join(
            f" A press within {press.budget_s:g} s ({press.choice}): {press.psnr_db:.1f} dB in "
            f"{press.seconds_median * 1e3:.0f} ms."
            for press in found.presses
        )
        + (f" More light, refraction included: {bursts}." if bursts else "")
    )


def _series(
    points: Sequence[Point], method: Method, kind: int, words: str, letters: Mapping[tuple[str, int, int], str]
) -> Series:
    """Return the marks of one method; `words` follow the name of an iterative one, `letters` are those of thumbnails.

    A closed-form method has one trail over the bins; an iterative one has a trail over the rounds of each bin.
    """
    own = [p for p in points if p.method == method.name]
    if method.round_pairs == 0:
        marks = tuple(_mark(p, method, f"bin {p.bin}", letters) for p in own)
        paper = method.name == "tikhonov"
        return Series(f"{method.name}, GCV" if paper else method.name, (marks,), kind, hollow=paper)
    trails = []
    for n in sorted({p.bin for p in own}):
        rounds = [p for p in own if p.bin == n]
        labels = [f"bin {n}", *(str(p.rounds) if p.pareto else "" for p in rounds[1:])]
        trails.append(tuple(_mark(p, method, label, letters) for p, label in zip(rounds, labels, strict=True)))
    return Series(f"{method.name}{words}", tuple(trails), kind)


def _peers(found: Frontier) -> tuple[Series, ...]:
    """Return the marks of other people's solvers."""
    marks = tuple(
        Mark(
            peer.seconds,
            peer.psnr_db,
            peer.name.split(", ")[-1].removesuffix(" rounds"),
            f"{peer.name}: {peer.seconds:.2f} s, {peer.psnr_db:.2f} dB, PCC {peer.pcc:.3f}",
            0.9,
        )
        for peer in found.peers
    )
    return (Series("LenslessPiCam", (marks,), PEER_KIND),) if marks else ()


def _bursts_in_time(found: Frontier) -> tuple[Series, ...]:
    """Return the bursts at their times, refraction included."""
    marks = tuple(
        Mark(
            burst.seconds_median,
            burst.psnr_db,
            burst.length,
            f"{burst.length}: {burst.seconds_median * 1e3:.0f} ms, {burst.psnr_db:.2f} dB",
        )
        for burst in found.light
    )
    return (Series("burst", (marks,), BURST_KIND),) if marks else ()


def _mark(point: Point, method: Method, label: str, letters: Mapping[tuple[str, int, int], str]) -> Mark:
    rounds = f", {point.rounds} rounds" if method.round_pairs else ""
    tooltip = (
        f"{point.method}, bin {point.bin}{rounds}: {point.seconds_median * 1e3:.1f} ms, {point.psnr_db:.2f} dB, "
        f"PCC {point.pcc:.3f}"
    )
    if letter := letters.get(_key(point)):
        return Mark(point.seconds_median, point.psnr_db, letter, tooltip, LETTER_WEIGHT)
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
