"""How well each PSF of a stack explains a frame, as a picture: the depth or the refraction at which it was taken."""

from collections.abc import Sequence

from services.instrument.plot import Axis, Mark, Plot, Series, svg, value_axis


def drawn(frame: str, names: Sequence[str], unlikelihood: Sequence[float]) -> str:
    """The SVG of a sweep: one mark for each PSF in the order given, the sharpest with a ring.

    `unlikelihood` is minus the log evidence per frequency (optics.md 6.2); shown is what each loses against the best.
    """
    least = min(unlikelihood)
    best = list(unlikelihood).index(least)
    lost = [least - value for value in unlikelihood]
    marks = tuple(
        Mark(k, value, says=f"{name}: {value:.4f} nats per frequency")
        for k, (name, value) in enumerate(zip(names, lost, strict=True))
    )
    last = len(names) - 1
    x = Axis(-0.5, last + 0.5, "PSF, in the order given", tuple((k, name) for k, name in enumerate(names)))
    return svg(
        Plot(
            title=f"Which PSF explains {frame}",
            under=f"evidence of each PSF against the best, nats per frequency; sharpest: {names[best]}",
            says=f"The sharpest of {len(names)} PSFs is {names[best]}; the worst loses {-min(lost):.3f} nats.",
            x=x,
            y=value_axis(lost, "log evidence per frequency, less the best"),
            series=(Series("PSF", (marks,)),),
            ring=(best, lost[best], names[best]),
        )
    )
