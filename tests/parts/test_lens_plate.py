"""The plate of lenslets as exported: the same surface as solid and as height map, whose lenses focus the light."""

import csv
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from build123d import Part, Plane, import_step, section
from numpy.typing import NDArray
from PIL import Image

from device.errors import SpecError
from hardware.parts.dimensions import Dimensions
from hardware.parts.lens_drawing import TOLERANCES, lenslets
from hardware.parts.lens_plate import HEAD, LensPlate, export_plate, lens_plate
from tests.drawings import boxes, overlapping

pytestmark = pytest.mark.parts

INDEX, FOCAL_UM, IRIS_UM, RIM_UM = 1.5, 6124.0, 3200.0, 954.0
Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def plate(d: Dimensions) -> LensPlate:
    return lens_plate(d)


@pytest.fixture(scope="module")
def folder(plate: LensPlate, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("plate")
    assert [file.name for file in export_plate(plate, out)] == ["lenslets-22.step", "lenslets-22-height.png"]
    return out


@pytest.fixture(scope="module")
def heights_um(folder: Path) -> Floats:
    """Return the image of the heights, in um by its own text: 1 nm a count."""
    with Image.open(folder / "lenslets-22-height.png") as image:
        assert "1 nm a count; 2 um a pixel; seen from the lenses' side" in image.info["Description"]
        assert image.info["dpi"] == pytest.approx((12700, 12700), rel=1e-4)
        assert image.mode == "I;16"
        return np.asarray(image, np.float64) / 1000


def vertices_um() -> Floats:
    with (HEAD.parent / "lenslets_22.csv").open(encoding="utf-8", newline="") as lines:
        return np.array([[float(row["right_um"]), float(row["down_um"])] for row in csv.DictReader(lines)])


def places_um(heights_um: Floats) -> tuple[Floats, Floats]:
    """Return the place of each pixel right and down of the axis as the sensor sees it, through the plate."""
    rows, cols = heights_um.shape
    right, down = np.meshgrid((cols / 2 - 0.5 - np.arange(cols)) * 2, (np.arange(rows) + 0.5 - rows / 2) * 2)
    return right, down


def test_every_cell_of_the_height_map_focuses_its_light_at_the_vertex_of_the_layout(heights_um: Floats) -> None:
    """Rays along the axis, each turned by (n - 1) times the slope, meet one focal length behind the plate."""
    right, down = (axis[::4, ::4] for axis in places_um(heights_um))
    by_row, by_col = (slope[::4, ::4] for slope in np.gradient(heights_um, 2.0))
    landed = np.stack([right - (INDEX - 1) * FOCAL_UM * by_col, down + (INDEX - 1) * FOCAL_UM * by_row], axis=-1)
    vertices = vertices_um()
    off_um = np.hypot(*(np.stack([right, down], axis=-1)[..., None, :] - vertices).transpose(3, 0, 1, 2))
    owner, inside = off_um.argmin(axis=-1), np.hypot(right, down) < IRIS_UM / 2
    edge_um = np.diff(np.partition(off_um, 1, axis=-1)[..., :2], axis=-1)[..., 0]
    for number, vertex in enumerate(vertices):
        spot = landed[(owner == number) & inside & (edge_um > 12)] - vertex
        assert np.abs(spot.mean(axis=0)).max() < 1.0
        assert spot.std(axis=0).max() < 6.0


def test_lenses_leave_no_gap_in_the_iris_and_its_play(heights_um: Floats) -> None:
    reached = np.hypot(*places_um(heights_um)) < IRIS_UM / 2 + 100
    assert 0 < heights_um[reached].min() < 4
    assert heights_um.max() == pytest.approx(1000 - RIM_UM, abs=0.1)
    border = [heights_um[0], heights_um[-1], heights_um[:, 0], heights_um[:, -1]]
    assert max(edge.max() for edge in border) == 0, "the map ends on the rim"


def test_solid_is_the_height_map_on_a_disc_that_fits_the_cell(d: Dimensions, folder: Path, heights_um: Floats) -> None:
    step = import_step(folder / "lenslets-22.step")
    assert step.is_valid
    assert len(step.solids()) == 1
    assert tuple(step.bounding_box().size) == pytest.approx((d.bought.diffuser_mm, d.bought.diffuser_mm, 1.0))
    disc = np.pi * d.bought.diffuser_mm**2 / 4 * RIM_UM / 1000
    assert step.volume - disc == pytest.approx(heights_um.sum() * 4e-9, rel=1e-3)
    for height_um in (10.0, 30.0):
        face = section(Part() + step, section_by=Plane.XY.offset((RIM_UM + height_um) / 1000))
        assert face.area == pytest.approx((heights_um > height_um).sum() * 4e-6, rel=1e-3)


def test_another_layout_makes_another_plate(d: Dimensions, head_with: Callable[[str, str], Path]) -> None:
    other = lens_plate(d, head_with('layout = "lenslets_22"', 'layout = "lenslets_hexagonal"'))
    assert len(other.centres_mm) == 19
    assert other.vertex_mm > lens_plate(d).vertex_mm, "lenses 1 mm apart have the deeper edges"


@pytest.fixture
def head_with(tmp_path: Path) -> Callable[[str, str], Path]:
    """Return the head with lenslets with a line replaced."""

    def change(was: str, becomes: str) -> Path:
        text = HEAD.read_text(encoding="utf-8")
        assert text.count(was) == 1
        (file := tmp_path / "head.toml").write_text(text.replace(was, becomes), encoding="utf-8")
        return file

    return change


@pytest.mark.parametrize(
    ("becomes", "why"),
    [
        ('layout = "lenslets_22"\naperture_um = 500', "no plate of lenslets without gaps"),
        ('layout = "unlike.csv"', "several focal lengths"),
    ],
)
def test_plate_that_one_ball_cannot_make_is_refused(
    d: Dimensions, head_with: Callable[[str, str], Path], becomes: str, why: str
) -> None:
    head = head_with('layout = "lenslets_22"', becomes)
    (head.parent / "unlike.csv").write_text("right_um,down_um,focal_um\n0,0,6000\n600,0,6200\n", encoding="utf-8")
    with pytest.raises(SpecError, match=why):
        lens_plate(d, head)


def test_diffuser_has_no_plate(d: Dimensions) -> None:
    with pytest.raises(SpecError, match="no plate of lenslets"):
        lens_plate(d, HEAD.with_name("imx296.toml"))


def test_drawing_has_every_vertex_and_tolerance_and_says_that_none_was_made(d: Dimensions) -> None:
    drawing = lenslets(d)
    found = boxes(ElementTree.fromstring(drawing))
    assert overlapping(found) == []
    words = {box.words for box in found}
    assert {f"{-right / 1000:+.3f}" for right, _ in vertices_um()} <= words
    assert {f"{-down / 1000:+.3f}" for _, down in vertices_um()} <= words
    with TOLERANCES.open(encoding="utf-8", newline="") as lines:
        assert {cell for row in csv.reader(lines) for cell in row if cell} <= words
    assert any("none was made" in line for line in words)
    assert max(box.right for box in found) < float(ElementTree.fromstring(drawing).attrib["width"])
