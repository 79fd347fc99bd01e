"""The model eye: one geometry for print, simulator and check, and the check of a simulated head with its chart."""

import json
import re
from dataclasses import replace
from math import atan, degrees
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from device.config.head_file import OpticsSpec, load_head
from device.config.radiometry import BeamSpec, RadiometrySpec
from device.config.scene import ObjectSpec, SimSpec
from device.errors import FrameError, PsfError
from device.optics import retina_chart
from device.optics.light_budget import chain, product
from device.optics.retina_chart import BAR_GROUPS, EYE_MM, GREY, INK, MARKS, RINGS, BarGroup, chart_svg, srgb
from device.sim import scene_files
from device.sim.objects import draw_object
from services.cli import app
from services.workshop.model_eye import ModelEyeFrame, check_model_eye, light_row, mean_tone, promise_of
from services.workshop.model_eye_fit import fit_chart, lit_diameter_px
from services.workshop.optics_report import design_of
from tests.simulated import small_head_toml

HEADS = Path(__file__).parents[2] / "hardware" / "heads"
EXPOSURE_S = 0.005
SCENE = """\
[sim]
seed = 11
peak_e = 15000

[sim.object]
kind = "chart"

[sim.eye]
shown_by = "print"
surface = "flat"
"""
PX_PER_DEG = 20.0


def drawn(field_deg: float = 33.4, size: int = 701) -> np.ndarray:
    """Return the simulator's chart, (size, size), at PX_PER_DEG."""
    optics = OpticsSpec(iris_um=3200, diffuser_to_sensor_um=6000, angular_magnification=0.75, field_deg=field_deg)
    scene = SimSpec(object=ObjectSpec(kind="chart"))
    return draw_object(scene, optics, "OD", (size, size), PX_PER_DEG).reflectance["green"]


def seen(plane: np.ndarray, right_um: float, down_um: float) -> float:
    """Return the value of the drawing at a place on the chart, by OPTICS.md 1.2."""
    height = np.hypot(right_um, down_um)
    per_um = PX_PER_DEG * degrees(atan(height / (1000 * EYE_MM))) / height
    middle = (plane.shape[0] - 1) / 2
    return float(plane[round(middle + down_um * per_um), round(middle + right_um * per_um)])


def shapes() -> list[tuple[str, dict[str, str]]]:
    """Return tag and attributes of every shape of the SVG but the paper's edge."""
    root = ElementTree.fromstring(chart_svg())
    found = [(el.tag.rpartition("}")[2], dict(el.attrib)) for el in root]
    return [(tag, keys) for tag, keys in found if tag in ("rect", "circle")][1:]


def test_svg_and_simulator_have_the_same_chart_at_every_place() -> None:
    """Each printed shape has its tone in the middle of the simulator's drawing, and paper is left around it."""
    plane, tones = drawn(), {srgb(INK): INK, srgb(GREY): GREY}
    checked = 0
    for tag, keys in shapes():
        if tag == "rect":
            x, y, w, h = (float(keys[key]) for key in ("x", "y", "width", "height"))
            places = [(x + w / 2, y + h / 2)]
        elif "cx" in keys:
            places = [(float(keys["cx"]), float(keys["cy"]))]
        else:
            places = [(float(keys["r"]), 0.0), (0.0, -float(keys["r"]))]
        tone = tones[keys.get("stroke") or keys["fill"]]
        for right, down in places:
            if np.hypot(right, down) < 7000:
                assert seen(plane, right, down) == pytest.approx(tone, abs=0.06), (tag, keys)
                checked += 1
    assert checked == 3 * len(BAR_GROUPS) + len(MARKS) + 2 + 2
    paper = retina_chart.PAPER_PATCH
    assert seen(plane, paper.right_um, paper.down_um) == 1
    ink = float((1 - plane[np.hypot(*np.ogrid[-350:351, -350:351]) < 13 * PX_PER_DEG]).sum()) / PX_PER_DEG**2
    printed_um2 = sum((1 - INK) * 1.5 * g.period_um * g.side_um for g in BAR_GROUPS)
    discs = (*MARKS, retina_chart.GREY_PATCH, retina_chart.INK_PATCH)
    printed_um2 += sum((1 - disc.tone) * np.pi * disc.diameter_um**2 / 4 for disc in discs)
    assert ink * np.radians(1) ** 2 * (1000 * EYE_MM) ** 2 == pytest.approx(printed_um2, rel=0.03)


def test_svg_is_to_scale_and_no_element_touches_another() -> None:
    root = ElementTree.fromstring(chart_svg())
    width, box = root.attrib["width"], [float(value) for value in root.attrib["viewBox"].split()]
    assert float(width.removesuffix("mm")) * 1000 == box[2]
    assert re.search(r"M-10000 14000H10000", chart_svg())
    steps = np.arange(-7400, 7401, 25, dtype=np.float32)
    inside = [element.signed_distance_um(steps[None, :], steps[:, None]) < 60 for element in retina_chart.ELEMENTS]
    assert np.sum(inside, axis=0).max() == 1
    assert MARKS[1].right_um - MARKS[0].right_um == 10_000
    assert [round(degrees(atan(ring.radius_um / 1000 / EYE_MM)), 6) for ring in RINGS] == [14, 20, 25]


@pytest.mark.parametrize("upright", [True, False])
def test_bars_have_their_period(upright: bool) -> None:
    group = BarGroup(0, 0, 400, upright)
    across, zero = np.arange(-600, 601, 1, dtype=np.float32), np.zeros(1201, np.float32)
    distance = group.signed_distance_um(*((across, zero) if upright else (zero, across)))
    begins = across[1:][(distance[:-1] >= 0) & (distance[1:] < 0)]
    assert np.diff(begins) == pytest.approx([400, 400], abs=1)
    assert (distance < 0).sum() == pytest.approx(600, abs=4)


def test_fit_finds_a_turned_and_moved_chart_and_its_scale() -> None:
    """The drawing at 20 pixels per degree is taken for one of 21; a part of another scale or an empty one fails."""
    plane = drawn()
    turned = np.rot90(np.roll(plane, (12, -25), axis=(0, 1)), 1)
    fit = fit_chart(np.ascontiguousarray(turned), 21.0, 33.4)
    assert fit.px_per_deg == pytest.approx(PX_PER_DEG, rel=0.003)
    assert fit.turn_deg == pytest.approx(270, abs=0.3)
    assert (fit.row - 350, fit.col - 350) == pytest.approx((25, 12), abs=0.6)
    assert fit.agreement > 0.9
    assert lit_diameter_px(plane, PX_PER_DEG) / PX_PER_DEG == pytest.approx(33.4, rel=0.01)
    noise = np.random.default_rng(3).normal(1, 0.1, plane.shape).astype(np.float32)
    assert fit_chart(noise, 21.0, 33.4).agreement < 0.3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the head file and the frame of a good head."""
    return simulated(tmp_path_factory.mktemp("good"))


def simulated(folder: Path, was: str = "", becomes: str = "", tables: str = "") -> Path:
    """Write a small head with the chart before it, one key replaced, and what its camera gives."""
    text = small_head_toml("Small head", SCENE, exposure_s=EXPOSURE_S)
    assert was in text
    (folder / "head.toml").write_text(text.replace(was, becomes) + tables if was else text + tables, encoding="utf-8")
    scene_files.simulate(load_head(folder / "head.toml"), folder)
    return folder


def checked(folder: Path, frame: Path) -> dict[str, bool]:
    """Return which figures of a frame are as the head of `folder` promises, with the PSF of `folder`."""
    found = check_model_eye(
        folder / "head.toml", ModelEyeFrame(frame / "raw.tiff", folder / "psf.tiff", None, EXPOSURE_S)
    )
    return {row.name: row.ok for row in found.rows}


def called(folder: Path, *words: str) -> tuple[int, str]:
    """Return exit status and output of the command with the files of a folder."""
    files = ["--head", folder / "head.toml", "--raw", folder / "raw.tiff", "--psf", folder / "psf.tiff"]
    result = CliRunner().invoke(app, ["check", "--model-eye", *map(str, files), *words])
    return result.exit_code, result.stdout


def test_quarter_of_the_light_is_a_miss_with_remedy(folder: Path) -> None:
    """With four times the frame's exposure as argument the head gives a quarter of the promised light."""
    status, output = called(folder, "--exposure-s", str(4 * EXPOSURE_S))
    assert status == 1
    assert re.findall(r"^FAIL +(\w+)", output, re.M) == ["light"]
    assert "--exposure-s" in output


def test_promised_light_is_the_budget_of_white_paper_and_half_of_it_fails_a_measured_head() -> None:
    """The model eye has the pupil of the budget, whose edge cuts this ring; a measured ring has a narrower range."""
    head = load_head(HEADS / "imx296_power.toml")
    design = design_of(head)
    led = replace(design.led, reflectance=retina_chart.PAPER_REFLECTANCE * mean_tone(33.4))
    cells = product(chain(replace(design, eye_mm=EYE_MM, led=led)))
    right = promise_of(head, 0.1)
    assert right.lit_e == pytest.approx(cells * (3.45 / 10) ** 2)
    beam = BeamSpec(wavelength_um=0.525, retina_mw_per_cm2=0.6, waist_mw_per_cm2=20)
    table = RadiometrySpec(measured="2026-11-26, meter", guard_factor=1.3, green=beam)
    measured = promise_of(head.model_copy(update={"light": head.light.model_copy(update={"radiometry": table})}), 0.1)
    assert measured.lit_e == pytest.approx(right.lit_e * 0.6 / design.highest_mw_per_cm2)
    assert light_row(measured.lit_e, measured).ok
    assert not light_row(measured.lit_e / 2, measured).ok
    assert measured.light_factor < right.light_factor == pytest.approx(2.57, abs=0.01)


def test_right_head_with_wide_dies_passes_and_its_field_is_not_that_of_points(tmp_path: Path) -> None:
    """Dies of 1 mm light a penumbra; a rule of 5 % about the 33.4 degrees of points would refuse this head."""
    tables = SCENE + "\n[sim.light]\nfalloff = true\n"
    text = small_head_toml("Small head", tables, exposure_s=EXPOSURE_S / 5)
    lit = text.replace('[light]\nbackend = "sim"', '[light]\nbackend = "sim"\nhead = "imx296_power"')
    (tmp_path / "head.toml").write_text(lit, encoding="utf-8")
    scene_files.simulate(load_head(tmp_path / "head.toml"), tmp_path)
    frame = ModelEyeFrame(tmp_path / "raw.tiff", tmp_path / "psf.tiff", None, EXPOSURE_S / 5)
    found = check_model_eye(tmp_path / "head.toml", frame)
    assert found.ok
    field = next(row for row in found.rows if row.name == "field")
    assert field.measured is not None
    assert field.measured > 1.05 * 33.4
    assert field.promised == pytest.approx(37.3, abs=0.1)


def test_another_scale_fails_on_scale_only(tmp_path: Path) -> None:
    """The head has an angular magnification of 0.70, and its file says 0.75."""
    short = simulated(tmp_path, "angular_magnification = 0.75", "angular_magnification = 0.70")
    head = (short / "head.toml").read_text(encoding="utf-8")
    (short / "head.toml").write_text(head.replace("= 0.70", "= 0.75"), encoding="utf-8")
    rows = checked(short, short)
    assert [name for name, ok in rows.items() if not ok] == ["scale"]


def test_blurred_head_fails_on_resolution(folder: Path, tmp_path: Path) -> None:
    """The eye's lens is astigmatic by 17 dioptres, which no scaling of the PSF takes away."""
    rows = checked(folder, simulated(tmp_path, tables="j0_dpt = 6\nj45_dpt = 6\n"))
    assert not rows["resolution"]
    assert rows["field"]
    assert rows["light"]


def test_frame_without_chart_is_an_error(folder: Path, tmp_path: Path) -> None:
    retina = simulated(tmp_path, 'kind = "chart"', 'kind = "retina"')
    with pytest.raises(FrameError, match="no chart of the model eye") as refused:
        checked(folder, retina)
    assert "step ring" in refused.value.remedy


def test_dark_saturated_and_foreign_frames_are_errors(folder: Path, tmp_path: Path) -> None:
    raw = tifffile.imread(folder / "raw.tiff")
    tifffile.imwrite(tmp_path / "raw.tiff", np.full_like(raw, 64) + (np.indices(raw.shape).sum(axis=0) % 2 == 0))
    with pytest.raises(FrameError, match="too dark") as dark:
        checked(folder, tmp_path)
    assert "longer exposure" in dark.value.remedy
    tifffile.imwrite(tmp_path / "raw.tiff", np.minimum(raw.astype(np.uint32) * 4, 4095).astype(np.uint16))
    with pytest.raises(FrameError, match="too bright"):
        checked(folder, tmp_path)
    tifffile.imwrite(tmp_path / "psf.tiff", tifffile.imread(folder / "psf.tiff")[:, ::-1])
    frame = ModelEyeFrame(folder / "raw.tiff", tmp_path / "psf.tiff", None, EXPOSURE_S)
    with pytest.raises(PsfError, match="PSF"):
        check_model_eye(folder / "head.toml", frame)


def test_good_head_takes_its_own_frame_and_passes(folder: Path) -> None:
    """Without files the head is opened and lit through the guard; the JSON has every figure with its reason."""
    result = CliRunner().invoke(app, ["check", "--model-eye", "--head", str(folder / "head.toml"), "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout[result.stdout.index("{") :])
    assert found["ok"]
    assert found["simulated"]
    by_name = {row["name"]: row for row in found["rows"]}
    assert list(by_name) == ["resolution", "scale", "field", "light", "grey"]
    assert by_name["scale"]["measured"] == pytest.approx(3.896, rel=0.005)
    assert by_name["field"]["measured"] == pytest.approx(33.4, rel=0.01)
    assert by_name["resolution"]["measured"] <= 500
    assert all(row["reason"] for row in found["rows"])


def test_files_go_with_the_model_eye_and_together(folder: Path) -> None:
    head = ["check", "--head", str(folder / "head.toml")]
    assert CliRunner().invoke(app, [*head, "--raw", str(folder / "raw.tiff")]).exit_code == 2
    assert CliRunner().invoke(app, [*head, "--model-eye", "--raw", str(folder / "raw.tiff")]).exit_code == 2


def test_command_draws_the_chart(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["chart", "-o", str(tmp_path / "chart.svg")])
    assert result.exit_code == 0
    assert (tmp_path / "chart.svg").read_text(encoding="utf-8") == chart_svg()
