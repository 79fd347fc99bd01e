"""Search for lenslets: what more light, curvature and the focus do to the expected detail, and the written layout."""

from pathlib import Path

import pytest

from device.config.element import read_layout
from device.config.head_file import OpticsSpec, load_head
from device.optics.lens_design import figure, focal_um, search
from services import resources
from services.workshop.lens_search import design_layout
from services.workshop.optics_report import design_of
from tests.paper.bench import with_changes

PITCH_UM, ELECTRONS = 10.35, 6000.0


def optics(head: str, **changes: object) -> OpticsSpec:
    found = load_head(resources.HEADS / f"{head}.toml").optics
    assert found is not None
    return found.model_copy(update=changes)


def test_lenslets_give_more_detail_than_the_diffuser_and_light_gives_more_of_it() -> None:
    diffuser, lenslets = (figure(optics(head), PITCH_UM, ELECTRONS, 1) for head in ("imx296", "imx296_lenslets"))
    assert lenslets.worst > diffuser.worst + 0.2
    assert diffuser.axis == pytest.approx(diffuser.edge), "the diffuser's PSF is the same over the field"
    assert lenslets.axis > lenslets.edge + 0.02, "curved lenses are worse at the edge"
    assert figure(optics("imx296_lenslets"), PITCH_UM, 4 * ELECTRONS, 1).mean > lenslets.mean + 0.02
    narrow = figure(optics("imx296_lenslets", field_deg=5.0), PITCH_UM, ELECTRONS, 1)
    assert narrow.edge == pytest.approx(narrow.axis, abs=0.005), "a narrow field is not curved"


def test_a_focus_behind_the_sensor_balances_the_curved_field() -> None:
    head = optics("imx296")
    assert focal_um(head, 0.0) == pytest.approx(6000)
    assert 1e6 / 6000 - 1e6 / focal_um(head, 9.8) == pytest.approx(0.5625 * 9.8)
    flat, behind = (found.figure for found in search(head, PITCH_UM, ELECTRONS, 0, (12,)) if found.focus_dpt in (0, 12))
    assert behind.edge > flat.edge + 0.02
    assert behind.axis < flat.axis
    assert behind.worst > flat.worst


def test_the_best_layout_is_written_as_a_head_reads_it(tmp_path: Path) -> None:
    head, lines = load_head(resources.HEADS / "imx296_control.toml"), []
    coarse = with_changes(head, {"camera.pitch_um": 10.35})
    best = design_layout(design_of(coarse), tmp_path / "best.csv", lines.append, (3,))
    written = read_layout(tmp_path / "best.csv")
    assert [lens[2] for lens in written] == pytest.approx([lens[2] for lens in best.lenses], abs=0.1)
    assert lines[-2].startswith("best: 3 lenses, focus ")
    assert len([line for line in lines if line.startswith("3 ")]) == 3
