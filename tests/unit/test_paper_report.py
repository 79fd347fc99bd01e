"""Report of `diffuscope paper`: failed assertions, self-contained page, refusals, and scenes of the bench."""

import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest

from device.clock import VirtualClock
from device.errors import SettingError, SpecError, StoreError
from device.sim.world import World
from tests.paper.bench import Bench, with_changes
from tests.paper.outcome import Experiment, Figure, Outcome, above, attempted, below, within
from tests.paper.pictures import plane, trend
from tests.paper.report import EXPERIMENTS, ORDER, ExperimentRun, all_hold, html, printed_value, run_experiments, table
from tests.paper.results_page import PAGE, kept_values, row
from tests.project_files import ROOT, text


def ran(*claims, **more) -> list[ExperimentRun]:
    experiment = Experiment("X1", "A <made up> title", "One sentence.", "Nothing.", lambda bench: Outcome(claims))
    return [ExperimentRun(experiment, Outcome(claims, **more), 1.0)]


@pytest.mark.parametrize(
    ("claim", "holds"),
    [
        (above("a", 0.9, 0.88), True),
        (above("a", 0.88, 0.88), False),
        (above("a", float("nan"), 0.88), False),
        (below("a", 0.9, 0.88), False),
        (below("a", float("nan"), 0.88), False),
        (within("a", 1.0, 0.5, 1.0), True),
        (within("a", 1.001, 0.5, 1.0), False),
        (within("a", float("nan"), 0.5, 1.0), False),
    ],
)
def test_claim_fails_outside_its_limits_and_for_nan(claim, holds) -> None:
    assert claim.holds is holds
    assert all_hold(ran(claim)) is holds
    assert ("does not hold" in html(ran(claim), 1)) is not holds
    assert ("NO" in table(ran(claim))) is not holds


def test_number_that_is_not_reproduced_is_not_counted_as_held() -> None:
    missed = attempted("SSIM", 0.977, 0.49, 0.69, "SSIM .59")
    both = ran(above("a", 0.9, 0.88), missed)
    page = html(both, 1)
    assert missed.status == "not reproduced"
    assert not missed.holds
    assert "1 of 1 assertions hold; statements of the paper that are not reproduced: 1. These are marked." in page
    assert '<a href="#X1">X1</a> A &lt;made up&gt; title <b class=open>not reproduced</b>' in page
    assert "<td>not reproduced</td><td>SSIM .59</td><td><b class=label-not-reproduced>not reproduced</b></td>" in page
    assert "NR" in table(both)
    assert all_hold(both), "it is known, so the command does not fail"
    assert attempted("SSIM", 0.6, 0.49, 0.69, "SSIM .59").status == "holds"
    assert attempted("SSIM", float("nan"), 0.49, 0.69, "SSIM .59").status == "not reproduced"


def test_every_row_has_a_label_and_the_reason_of_its_limit_or_a_star() -> None:
    rows = (
        above("a", 0.9, 0.88, "printed"),
        above("b", 0.9, 0.88),
        above("c", 0.9, 0.88, "printed").put_in("given"),
        above("d", 0.9, 0.88).limit_from("half a pixel"),
        attempted("e", 0.1, 0.4, 0.6, ".5").because("no figure"),
    )
    assert [claim.label for claim in rows] == ["as written", "ours", "put in", "ours", "not reproduced"]
    page = html(ran(*rows), 1)
    assert "Labels of the 5 rows: 1 as written, 1 put in, 1 not reproduced, 2 ours." in page
    assert "&gt; 0.88<small>half a pixel</small>" in page
    assert "1 of 2 rows on the paper's own statements hold (1 as written, 0 adapted), 1 are not reproduced." in page
    assert "The other 3 rows do not test the paper (1 put in, 2 ours)." in page
    assert page.count("&gt; 0.88&nbsp;*") == 3
    assert "<b class=label-not-reproduced>not reproduced</b><small>no figure</small>" in page
    adapted = Experiment("X1", "t", "s", "p", lambda bench: Outcome(rows), "a drawn retina").labelled(Outcome(rows))
    assert [claim.label for claim in adapted.claims] == ["adapted", "ours", "put in", "ours", "not reproduced"]
    assert adapted.claims[0].why == "a drawn retina"


def test_a_statement_that_does_not_hold_is_not_counted_as_held() -> None:
    rows = (
        above("a", 0.8, 0.88, "printed"),
        above("b", 0.9, 0.88, "printed").adapted("how"),
        above("c", 0.9, 0.88, "printed"),
    )
    words = "2 of 3 rows on the paper's own statements hold (1 as written, 1 adapted), 0 are not reproduced."
    assert words in html(ran(*rows), 1)


@pytest.mark.parametrize(
    ("value", "digits", "printed"),
    [(0.0, 3, "0"), (3.2e-7, 6, "3e-07"), (-4e-5, 4, "-4e-05"), (6e-5, 4, "0.0001"), (0.0, 0, "0"), (1.26, 1, "1.3")],
)
def test_a_small_value_is_not_printed_as_zero(value, digits, printed) -> None:
    assert f"<td class=n>{printed}</td>" in html(ran(above("a", value, -1, "", digits)), 1)


def test_page_is_self_contained_and_escapes_its_texts() -> None:
    shown = (
        plane("grey & black", np.eye(40, dtype=np.float32)),
        trend("t", "u", "x", "y", {"a": {0.0: 1.0, 1.0: 2.0}}),
    )
    page = html(ran(above("a < b", 1, 0), shown=shown), 2)
    assert "A &lt;made up&gt; title" in page
    assert "a &lt; b" in page
    assert "grey &amp; black" in page
    assert "2 x 2 pixels" in page
    assert "http" not in page
    assert "simulated" in page


def test_plots_are_svg_and_pictures_png() -> None:
    def content(shown: Figure) -> bytes:
        return b64decode(shown.address.split(",", 1)[1])

    assert content(plane("p", np.eye(40, dtype=np.float32)))[:4] == b"\x89PNG"
    drawn = ET.fromstring(content(trend("t", "u", "x", "y", {"a": {0.0: 1.0, 1.0: 2.0}})))
    assert drawn.tag.endswith("svg")


def test_each_experiment_exists_once() -> None:
    assert tuple(EXPERIMENTS) == ORDER


def test_report_of_one_experiment_is_written(tmp_path) -> None:
    progress = []
    found = run_experiments(tmp_path / "new", VirtualClock(), progress.append, ["N"])
    assert [run.experiment.key for run in found] == ["N"]
    assert progress == ["N: 8 of 8 assertions hold"]
    assert "The paper&#x27;s numbers" in (tmp_path / "new" / "report.html").read_text()


def test_several_experiments_run_in_processes_and_stand_in_their_order(tmp_path) -> None:
    progress = []
    found = run_experiments(tmp_path, VirtualClock(), progress.append, ["T", "N"])
    assert [run.experiment.key for run in found] == ["N", "T"]
    assert sorted(line.split(":")[0] for line in progress) == ["N", "T"]
    assert found[1].seconds > 0, "by the clock of the process, not the virtual one"
    page = (tmp_path / "report.html").read_text()
    assert page.index('<section id="N">') < page.index('<section id="T">')


def test_command_prints_the_path_of_the_report(tmp_path) -> None:
    command = [sys.executable, "-m", "services", "paper", "-o", "report", "--only", "N"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "report.html" in done.stdout
    assert "33.40" in done.stdout


def test_unknown_experiment_and_unwritable_folder_are_refused(tmp_path) -> None:
    with pytest.raises(SettingError, match="S99") as refused:
        run_experiments(tmp_path, VirtualClock(), lambda line: None, ["S99"])
    assert "S2b" in refused.value.remedy
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError):
        run_experiments(tmp_path / "file" / "under", VirtualClock(), lambda line: None, ["N"])


def test_merged_pixels_scale_light_full_well_and_noise() -> None:
    plain, merged = (Bench(n).scene("paper_heine") for n in (1, 2))
    assert (merged.camera.rows, merged.camera.cols) == (plain.camera.rows // 2, plain.camera.cols // 2)
    assert merged.camera.pitch_um == 2 * plain.camera.pitch_um
    assert merged.sim.peak_e / merged.camera.full_well_e == plain.sim.peak_e / plain.camera.full_well_e
    assert merged.sim.peak_e / merged.camera.read_noise_e**2 == pytest.approx(
        plain.sim.peak_e / plain.camera.read_noise_e**2
    )


def test_change_of_a_scene_is_validated() -> None:
    spec = Bench().scene("paper_heine")
    assert with_changes(spec, {"sim.eye.m_dpt": 3.0}).sim.eye.m_dpt == 3
    with pytest.raises(ValueError, match="less than or equal to 20"):
        with_changes(spec, {"sim.eye.m_dpt": 30.0})
    dots = with_changes(spec, {"sim.object.kind": "dots"})
    with pytest.raises(SpecError, match="half_size_um"):
        _ = World(dots, VirtualClock()).retina


def test_the_kept_page_has_the_values_and_labels_of_today() -> None:
    """The numbers by formula, with each label; the other experiments are run again in test_paper_results.py."""
    outcome = EXPERIMENTS["N"].labelled(EXPERIMENTS["N"].run(Bench()))
    page = text(PAGE)
    assert kept_values(page, "N") == {claim.what: printed_value(claim) for claim in outcome.claims}
    assert [claim.what for claim in outcome.claims if row(claim) not in page] == []
    assert re.findall(r"^## (\w+): ", page, re.M) == list(ORDER)


def test_the_kept_pictures_are_small() -> None:
    pictures = re.findall(r"\]\((results/\S+)\)", text(PAGE))
    assert len(pictures) > 20
    assert sum((ROOT / PAGE).with_name("results").joinpath(Path(name).name).stat().st_size for name in pictures) < 1.5e6
