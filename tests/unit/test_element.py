"""Element of a head file: layouts that are read, and layouts that are refused with the reason."""

from pathlib import Path

import pytest

from device.config.element import half_widths_um
from device.config.head_file import OpticsSpec, load_head
from device.errors import SpecError
from device.optics.lens_design import focal_um
from device.optics.lens_layout import centroidal, hexagonal, layout_csv
from services import resources
from tests.paper.bench import with_changes

HEADER = "right_um,down_um,focal_um\n"
HEAD = (resources.HEADS / "imx296_control.toml").read_text().replace("iris_um = 1200", "iris_um = 3200")

BAD = {  # layout, or None for no file, and the required words of the error
    "no file": (None, ("optics.element", "there is no layout", "layout.csv", "focal_um")),
    "another table": ("x,y\n1,2\n", ("first line", "right_um,down_um,focal_um")),
    "a word": (HEADER + "0,0,6000\n0,far,6000\n", ("line 3", "three numbers", "far")),
    "two numbers": (HEADER + "0,0\n", ("line 2", "three numbers")),
    "no lens": (HEADER, ("optics.element", "needs the key layout")),
    "no focal length": (HEADER + "0,0,0\n", ("lens 1", "focal length 0 um", "above 0")),
    "overlapping centres": (HEADER + "0,0,6000\n500,0,6000\n503,4,6000\n", ("lenses 2 and 3 overlap", "20 um")),
    "a lens outside": (HEADER + "0,0,6000\n4000,0,6000\n", ("lens 2", "outside the iris of 3200 um")),
    "a thin plate": (HEADER + "0,0,1100\n", ("lens 1", "sag of", "thickness_um = 1000")),
}


@pytest.mark.parametrize("name", BAD)
def test_a_layout_that_cannot_be_made_is_refused(name: str, tmp_path: Path) -> None:
    layout, words = BAD[name]
    (tmp_path / "head.toml").write_text(HEAD.replace("one_lens", "layout.csv"))
    if layout is not None:
        (tmp_path / "layout.csv").write_text(layout)
    with pytest.raises(SpecError) as error:
        load_head(tmp_path / "head.toml")
    for word in ("head.toml", *words):
        assert word in str(error.value)


def test_a_diffuser_has_no_lenses_and_an_unknown_kind_is_refused(tmp_path: Path) -> None:
    for kind, words in (("diffuser", "lenses go with"), ("prisms", "'lenslets'")):
        (tmp_path / "head.toml").write_text(HEAD.replace('kind = "lenslets"', f'kind = "{kind}"'))
        with pytest.raises(SpecError, match=words):
            load_head(tmp_path / "head.toml")


def test_a_head_keeps_its_lenses_when_its_keys_are_changed() -> None:
    head = load_head(resources.HEADS / "imx296_lenslets.toml")
    changed = with_changes(head, {"camera.exposure_s": 0.2})
    assert head.optics is not None
    assert changed.optics == head.optics
    assert len(head.optics.element.lenses) == 22


def test_cells_share_the_iris_by_the_nearest_lens() -> None:
    assert half_widths_um(((-500.0, 0.0, 6000.0), (500.0, 0.0, 6000.0)), 2000.0) == pytest.approx([1000, 1000], abs=15)
    assert half_widths_um(((0.0, 0.0, 6000.0), (3000.0, 0.0, 6000.0)), 2000.0) == pytest.approx([1000, 0], abs=15)


def test_shipped_layouts_are_those_that_the_program_computes() -> None:
    """They focus 6 dioptres behind the sensor, which balances their curved field with a PSF measured on the axis."""
    behind_um = focal_um(OpticsSpec(), 6.0)
    layouts = {
        "lenslets_22.csv": centroidal(22, 3200.0, behind_um, seed=0),
        "lenslets_hexagonal.csv": hexagonal(1000.0, 3200.0, behind_um),
        "one_lens.csv": centroidal(1, 1200.0, behind_um, seed=0),
    }
    for name, lenses in layouts.items():
        assert (resources.HEADS / name).read_text() == layout_csv(lenses)
