"""SVG plot of the log evidence of one frame for each PSF of a stack (PSFs of several depths or refractions)."""

from collections.abc import Sequence

from services.plot import Axis, Mark, Plot, Series, svg, value_axis


def draw_sweep(frame: str, names: Sequence[str], unlikelihood: Sequence[float]) -> str:
    """Return the SVG of a sweep: one mark per PSF (`names`) in the given order, and a ring around the best.

    `frame` is the frame's name. `unlikelihood` is minus the log evidence per frequency (NUMERICS.md 7.3); the plot
    shows the log evidence of each PSF minus that of the best one, in nats (at most 0).
    """
    least = min(unlikelihood)
    best = list(unlikelihood).index(least)
    lost = [least - value for value in unlikelihood]
    marks = tuple(
        Mark(k, value, tooltip=f"{name}: {value:.4f} nats per frequency")
        for k, (name, value) in enumerate(zip(names, lost, strict=True))
    )
    last = len(names) - 1
    x = Axis(-0.5, last + 0.5, "PSF, in the order given", tuple((k, name) for k, name in enumerate(names)))
    return svg(
        Plot(
            title=f"Which PSF explains {frame}",
            subtitle=f"evidence of each PSF against the best, nats per frequency; sharpest: {names[best]}",
            description=f"The sharpest of {len(names)} PSFs is {names[best]}; the worst loses {-min(lost):.3f} nats.",
            x=x,
            y=value_axis(lost, "log evidence per frequency, less the best"),
            series=(Series("PSF", (marks,)),),
            rings=((best, lost[best], names[best]),),
        )
    )
