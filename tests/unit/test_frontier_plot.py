"""Plot of a frontier: which methods it shows, and that its texts and thumbnails can be read."""

import re
from base64 import b64decode
from dataclasses import replace
from io import BytesIO
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as Pictures

from device.recon.methods import METHODS
from services.instrument.time_budget import PACES_S
from services.research.frontier_plot import draw_frontier, draw_heads, drawn_points, ringed
from services.research.frontier_result import (
    BestMu,
    Choice,
    FrameSize,
    Frontier,
    LightPoint,
    Machine,
    PeerPoint,
    Point,
    PressPoint,
    ScoredRegion,
)
from services.research.frontier_thumbnails import (
    SIDE_PX,
    Shown,
    detailed_place,
    nearest_points,
    thumbnail_panel,
    visible_spots,
)
from tests.drawings import SVG, TextBox, boxes, overlapping

SCORES = {"ssim": 0.7, "highpass_pcc": 0.8, "vessel_contrast": 0.1}
KINDS = [
    (name, n, rounds)
    for name, method in METHODS.items()
    for n in (1, 2, 3, 4)
    for rounds in ((0, 1, 2, 4, 8, 12, 20) if method.round_pairs else (0,))
]
LARGEST_BYTES = 250_000  # of a committed picture


def measured(
    rng: np.random.Generator, field_known: bool = True, refract_s: float = 0.04, presses: bool = True
) -> Frontier:
    """Return a measurement with all methods, bursts and peers, with random times and accuracies."""
    points = tuple(
        Point(*kind, 10 ** rng.uniform(-2.3, 0), 1.0, pcc=0.9, psnr_db=rng.uniform(24, 31), **SCORES) for kind in KINDS
    )
    best = tuple(BestMu("tikhonov", n, 1e-4, 0.01 / n, pcc=0.8, psnr_db=26.0 + n / 9, **SCORES) for n in (1, 2, 3, 4))
    choice = Choice(
        "variation", 2, 12, "budget", 0.1 + refract_s, 0.2, True, refract_s, 0.1, 0.0, pcc=0.9, psnr_db=30.9, **SCORES
    )
    light = tuple(
        LightPoint(n, n, n * 1e-5, 0.5 * n, pcc=0.9, psnr_db=31 + n / 8, **SCORES, bound_psnr_db=30.0)
        for n in (1, 2, 4, 8)
    )
    return Frontier(
        Machine("Some processor", 2, "Linux", 1),
        {},
        "Human eye scene, IMX296 with high-power ring",
        True,
        FrameSize(1080, 1920),
        ScoredRegion("the field", field_known, 9, "", "", 0.02, "", 60.0, (0, 0), 0.2),
        "",
        0.015,
        "",
        points,
        best,
        0.26,
        choice,
        (),
        light,
        tuple(
            PressPoint(name, budget_s, 4, "variation", 1, 8, 0.7 * budget_s, True, pcc=0.9, psnr_db=31.0, **SCORES)
            for name, budget_s in PACES_S.items()
        )
        if presses
        else (),
        (),
        tuple(PeerPoint(f"LenslessPiCam 1, {n} rounds", n / 1.0, 0.8, 28.0, 0.6) for n in (10, 40, 100)),
    )


def panel_boxes(drawing: str) -> list[list[TextBox]]:
    root = ElementTree.fromstring(drawing)
    groups = [group for group in root.findall(f"{SVG}g") if (group.get("transform") or "").startswith("translate")]
    return [boxes(group) for group in groups]


def thumbnails(rng: np.random.Generator, found: Frontier):
    truth = rng.uniform(0, 1, (600, 900))
    points = nearest_points(drawn_points(found), ringed(found)[-1].seconds_median)
    shown = [Shown(("5.0 ms, 29.1 dB", "variation, bin 3", "12 rounds, chosen"), truth) for _ in range(len(points) + 1)]
    return thumbnail_panel(shown, truth, np.ones(truth.shape, np.bool_), False)


def letters(drawing: str) -> list[str]:
    return [box.words for box in panel_boxes(drawing)[0] if box.words in ("A", "B", "C", "D")]


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000), st.booleans(), st.booleans())
def test_no_two_texts_intersect_and_all_lie_within_the_picture(seed, field_known, presses):
    rng = np.random.default_rng(seed)
    found = measured(rng, field_known, presses=presses)
    drawing = draw_frontier(found, thumbnails=thumbnails(rng, found))
    panels = panel_boxes(drawing)
    assert len(panels) == 3
    for panel in panels:
        assert overlapping(panel) == []
        assert [box for box in panel if box.left < 0 or box.right > 960] == []
    assert len(panels[0]) > 40
    assert len(drawing) < LARGEST_BYTES


@pytest.mark.parametrize("field_known", [True, False])
def test_method_without_a_field_is_drawn_only_where_no_field_is_known(field_known):
    found = measured(np.random.default_rng(1), field_known)
    drawing = draw_frontier(found)
    assert ("open, bin 2" in drawing) is not field_known
    drawn = [p for p in found.points if p.method != "open" or not field_known]
    for p in drawn_points(found):  # the Pareto front is that of the drawn points
        better = [q for q in drawn if q.seconds_median < p.seconds_median and q.psnr_db > p.psnr_db]
        assert p.pareto is not bool(better)


def test_paper_method_has_filled_marks_at_the_best_mu_and_hollow_ones_at_gcv():
    drawing = draw_frontier(measured(np.random.default_rng(2)))
    pattern = r'<path class="mark"( style="fill: none[^"]*")?[^>]*><title>(tikhonov[^<]*)'
    marks = {title: hollow for hollow, title in re.findall(pattern, drawing)}
    assert len(marks) == 8
    assert all(bool(hollow) is ("best of the paper" not in title) for title, hollow in marks.items())


def test_choice_is_drawn_at_its_whole_time_and_the_axis_names_the_refraction():
    found = measured(np.random.default_rng(3), presses=False)
    whole = draw_frontier(found)
    assert "the chosen one includes 40 ms for the eye&#x27;s refraction" in whole
    none = draw_frontier(measured(np.random.default_rng(3), refract_s=0.0, presses=False))
    assert "the budget leaves no time for the eye&#x27;s refraction" in none
    before, after = (float(re.findall(r'class="ring" cx="([\d.]+)"', drawing)[0]) for drawing in (none, whole))
    assert after > before


def test_each_time_budget_has_a_line_and_what_a_press_does_has_a_ring():
    drawing = draw_frontier(measured(np.random.default_rng(7)))
    lines = re.findall(r'class="limit"/>\n<text[^>]*>([^<]*)<', drawing)
    assert lines == [f"{name} {budget_s:g} s" for name, budget_s in PACES_S.items()]
    assert len(re.findall(r"<title>a press</title>", drawing)) == len(PACES_S)
    assert "chosen:" not in drawing


def test_every_thumbnail_has_its_letter_at_a_mark():
    rng = np.random.default_rng(4)
    found = measured(rng)
    panel = thumbnails(rng, found)
    drawing = draw_frontier(found, thumbnails=panel)
    images = [element for element in panel.elements if element.startswith("<image")]
    assert sorted(letters(drawing)) == list("ABCD")[: len(images) - 1]
    picture = Pictures.open(BytesIO(b64decode(images[0].split("base64,")[1].split('"')[0])))
    assert picture.size == (SIDE_PX, SIDE_PX)


def test_points_near_the_times_are_shown_once_and_in_order():
    base = measured(np.random.default_rng(5)).points[0]
    points = [replace(base, seconds_median=s, pareto=True, rounds=k) for k, s in enumerate((0.004, 0.006, 0.019, 0.3))]
    assert [p.seconds_median for p in nearest_points(points, 1.0)] == [0.006, 0.019]
    assert nearest_points([replace(base, pareto=False)], 1.0) == ()


def test_place_is_inside_the_region_where_the_detail_is():
    truth, inside = np.zeros((300, 400)), np.ones((300, 400), np.bool_)
    truth[::5, :60], truth[150:200:5, 250:300] = 9, 1  # more outside the region than in it
    inside[:, :80] = False
    rows, cols = detailed_place(truth, inside)
    assert inside[rows, cols].all()
    assert truth[rows, cols].sum() == truth[:, 80:].sum()


def test_a_spot_counts_as_visible_with_its_contrast_and_over_the_error():
    truth = np.ones((140, 140))
    truth[20:25, 20:25] = truth[60:65, 60:65] = truth[100:105, 100:105] = 0
    faint, inverted = 1 - 0.3 * (1 - truth), 2 - truth
    partial = truth.copy()
    partial[20:25, 20:25] = 1
    noisy = truth + np.random.default_rng(6).normal(0, 4, truth.shape)
    counts, spots = visible_spots([truth, partial, faint, inverted, noisy], truth)
    assert spots == 3
    assert counts[:4] == [3, 2, 0, 0]
    assert counts[4] < 3


def test_heads_have_a_panel_each() -> None:
    names = ("behind the diffuser", "behind lenslets", "behind one lens")
    drawn = draw_heads([replace(measured(np.random.default_rng(seed)), scene=name) for seed, name in enumerate(names)])
    texts = [*ElementTree.fromstring(drawn).iter(f"{SVG}text")]
    assert [sum(text.text == name for text in texts) for name in names] == [1, 1, 1]
    levels = [text for text in texts if (text.get("x"), text.get("text-anchor")) == ("66.0", "end")]
    assert len(levels) > 6
    scale = [(level.get("y"), level.text) for level in levels]
    assert scale == scale[: len(scale) // 3] * 3
    assert len(drawn) < LARGEST_BYTES
