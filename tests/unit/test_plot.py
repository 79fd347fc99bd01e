"""Pareto front and SVG plots."""

from xml.etree import ElementTree

from hypothesis import given
from hypothesis import strategies as st

from services.plot import Mark, Plot, Series, stacked_svg, svg, time_axis, value_axis
from services.research.frontier_result import pareto_front

SVG = "{http://www.w3.org/2000/svg}"
places = st.lists(st.tuples(st.integers(1, 9).map(float), st.integers(0, 9).map(float)), min_size=1, max_size=30)


def dominates(a: tuple[float, float], b: tuple[float, float]) -> bool:
    """Return whether `a` costs at most as much as `b`, is worth at least as much, and is better in one of the two."""
    return a[0] <= b[0] and a[1] >= b[1] and a != b


@given(places)
def test_point_is_on_the_pareto_front_if_and_only_if_it_is_not_dominated(among):
    assert pareto_front(among) == [not any(dominates(other, place) for other in among) for place in among]


@given(places)
def test_pareto_front_holds_the_fastest_and_the_best(among):
    edge = {place for place, on in zip(among, pareto_front(among), strict=True) if on}
    fastest, best = min(place[0] for place in among), max(place[1] for place in among)
    assert any(place[0] == fastest for place in edge)
    assert any(place[1] == best for place in edge)


def plotted(marks: list[Mark], **more: object) -> ElementTree.Element:
    x, y = time_axis([m.x for m in marks], "time"), value_axis([m.y for m in marks], "worth")
    series = (Series("one & only", (tuple(marks),)),)
    return ElementTree.fromstring(svg(Plot("A < B", "under", "what it shows", x, y, series, **more)))  # type: ignore[arg-type]


@given(st.lists(st.tuples(st.floats(1e-5, 1e3), st.floats(-60, 200)), min_size=1, max_size=25))
def test_marks_lie_within_the_frame(values):
    root = plotted([Mark(x, y, "label", "says") for x, y in values])
    frame = next(rect for rect in root.iter(f"{SVG}rect") if rect.get("class") == "frame")
    left, top, wide, tall = (float(frame.get(key, "nan")) for key in ("x", "y", "width", "height"))
    for line in root.iter(f"{SVG}polyline"):
        for place in (line.get("points") or "").split():
            x, y = map(float, place.split(","))
            assert left <= x <= left + wide
            assert top <= y <= top + tall


def test_plot_has_texts_for_screen_readers():
    root = plotted([Mark(0.1, 1.0, tooltip="a"), Mark(0.2, 2.0, tooltip="b")], rings=((0.2, 2.0, "chosen"),))
    assert root.get("role") == "img"
    named = {element.get("id") for element in root.iter() if element.get("id")}
    assert set((root.get("aria-labelledby") or "").split()) == named
    assert [title.text for title in root.iter(f"{SVG}title")] == ["A < B", "a", "b", "chosen"]


def test_plot_has_no_external_resources():
    text = ElementTree.tostring(plotted([Mark(0.1, 1.0), Mark(0.2, 2.0)]), "unicode")
    assert not [word for word in ("href", "url(", "@import", "<script") if word in text]


def test_labels_do_not_overlap():
    root = plotted([Mark(0.1 * 1.02**k, 1 + 0.01 * k, "bin 2, 8") for k in range(12)] + [Mark(1, 3, "far")])
    labels = [t for t in root.iter(f"{SVG}text") if "label" in (t.get("class") or "")]
    boxes = [(float(t.get("x", 0)), float(t.get("y", 0)), 6.6 * len(t.text or "")) for t in labels]
    assert len(boxes) > 2
    for k, (x, y, wide) in enumerate(boxes):
        for a, b, other in boxes[:k]:
            assert abs(y - b) >= 12.8 or x + wide <= a + 0.2 or a + other <= x + 0.2


def test_ticks_of_a_time_axis_are_also_in_fft_pairs():
    axis = time_axis([0.011, 0.09], "time", fft_pair_s=0.02)
    assert [words for _, words in axis.ticks] == ["10 ms", "20 ms", "50 ms", "0.1 s"]
    assert [words for _, words in axis.below] == ["0.5 FFT pairs", "1", "2.5", "5"]


def test_plots_stand_one_below_the_other():
    marks = (Mark(0.1, 1.0, tooltip="a"), Mark(0.2, 2.0, tooltip="b"))
    x, y = time_axis([m.x for m in marks], "time"), value_axis([m.y for m in marks], "worth")
    upper, lower = (
        Plot(name, "", f"{name} is", x, y, (Series("s", (marks,)),), width=900, height=tall)
        for name, tall in (("upper", 500), ("lower", 300))
    )
    root = ElementTree.fromstring(stacked_svg([upper, lower]))
    assert (root.get("width"), root.get("height")) == ("900", "800")
    panels = [group for group in root.findall(f"{SVG}g") if (group.get("transform") or "").startswith("translate")]
    assert [panel.get("transform") for panel in panels] == ["translate(0 0)", "translate(0 500)"]
    assert [next(panel.iter(f"{SVG}text")).text for panel in panels] == ["upper", "lower"]
    assert root.findtext(f"{SVG}desc") == "upper is lower is"
