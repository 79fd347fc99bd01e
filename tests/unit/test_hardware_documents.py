"""Consistency of the build documents (parts, wiring, assembly) with one another, the head files and the optics."""

import csv
import re
from collections import Counter
from dataclasses import replace
from functools import cache
from math import degrees, radians, sqrt, tan
from pathlib import Path
from xml.etree import ElementTree

import pytest

from device.config.head_file import ChainSpec, load_head
from device.config.radiometry import LED_FWHM_UM
from device.light_safety.hazard import light_limits
from device.optics.budget import design_of_head, optical_budget
from device.optics.light_path import load_light_path, relay_of
from device.optics.matrix import inner_ring_at_pupil_mm, ring, ring_at_pupil_mm, ring_for_pupil
from device.optics.ray_trace import Surface
from device.optics.traced_relay import traced_relay
from hardware.parts.dimensions import Dimensions
from services.workshop.light_path_plot import draw_light_path
from services.workshop.light_report import AXIS_DISTANCE_MM, AXIS_HOLE_MM, at_full_drive, expected_uw
from tests.drawings import boxes, overlapping
from tests.project_files import ROOT, text
from tests.test_project_files import code_in, unknown_words

HARDWARE = ROOT / "hardware"
INSTRUCTIONS = ("hardware/wiring.md", "hardware/assembly.md", "hardware/model-eye.md")  # of parts on the bill
PAPERS = (*INSTRUCTIONS, "hardware/lenslets.md")
RING = "hardware/decisions/0005-ring-of-10-mm.md"
HEADS = sorted((HARDWARE / "heads").glob("*.toml"))
HEADER: dict[int, str] = {  # pins of the 40-pin header of a Raspberry Pi
    1: "3.3 V",
    2: "5 V",
    3: "GPIO2",
    4: "5 V",
    5: "GPIO3",
    6: "ground",
    7: "GPIO4",
    8: "GPIO14",
    9: "ground",
    10: "GPIO15",
    11: "GPIO17",
    12: "GPIO18",
    13: "GPIO27",
    15: "GPIO22",
    16: "GPIO23",
    19: "GPIO10",
    21: "GPIO9",
    23: "GPIO11",
    24: "GPIO8",
    25: "ground",
}
BUSES = {
    "MOSI": ("GPIO10", "spidev0"),
    "SCLK": ("GPIO11", "spidev0"),
    "SDA": ("GPIO2", "i2c-1"),
    "SCL": ("GPIO3", "i2c-1"),
}
SHOWN_AS = {"edge capacitor": "100 pF", "pull-down": "10 k"}  # values in the drawing


@cache
def parts() -> dict[str, dict[str, str]]:
    with (HARDWARE / "parts.csv").open(encoding="utf-8", newline="") as lines:
        return {row["part"]: row for row in csv.DictReader(lines)}


@cache
def wires() -> dict[int, tuple[str, str, str, str]]:
    """Return line, signal, destination and head-file entry by pin."""
    rows = re.findall(r"^\| (\d+) \| (.*?) \| (.*?) \| (.*?) \| (.*?) ?\|$", text("hardware/wiring.md"), re.M)
    return {int(pin): (line, signal, to, entry) for pin, line, signal, to, entry in rows}


def wired_values(key: str) -> set[str]:
    """Return the values of a head-file key in the last column of the wiring table."""
    return {
        value.strip('"')
        for *_, entry in wires().values()
        for value in re.findall(rf"`{re.escape(key)} = ([^`]+)`", entry)
    }


def named(paper: str) -> set[str]:
    """Return the names in bold."""
    return set(re.findall(r"\*\*([^*]+)\*\*", text(paper)))


def test_bill_of_materials_is_complete() -> None:
    with (HARDWARE / "parts.csv").open(encoding="utf-8", newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert len(rows) == len(parts()) > 20, "a part has two rows"
    for row in rows:
        assert None not in row, f"{row['part']}: a comma too many"
        assert int(row["quantity"]) > 0
        assert float(row["estimate_eur_each"]) > 0
        assert row["status"] in {"paper", "data sheet", "never built"}
        assert row["what_for"]
        assert row["from"]


def test_order_lists_have_the_right_sums() -> None:
    """Each list is the bill without the rows that the table leaves out."""
    rows = re.findall(r"^\| `heads/(\w+)\.toml` \| ([^|]+) \| (\d+) \|$", text("hardware/ordering.md"), re.M)
    assert [name for name, *_ in rows] == ["imx296", "imx296_power"]
    for _, without, claimed in rows:
        left_out = {name.strip() for name in without.split(",")}
        assert left_out <= set(parts())
        kept = [row for name, row in parts().items() if name not in left_out]
        total = sum(int(row["quantity"]) * float(row["estimate_eur_each"]) for row in kept)
        assert float(claimed) == pytest.approx(total, abs=5)


def test_sum_of_the_bill_is_that_of_the_readme() -> None:
    total = sum(int(row["quantity"]) * float(row["estimate_eur_each"]) for row in parts().values())
    claimed = re.search(r"about (\d+) EUR", text("hardware/README.md"))
    assert claimed is not None
    assert float(claimed[1]) == pytest.approx(total, abs=10)


@pytest.mark.parametrize("paper", INSTRUCTIONS)
def test_every_named_part_is_on_the_bill(paper: str) -> None:
    assert len(named(paper)) > 5
    assert named(paper) - set(parts()) == set()


def test_every_part_of_the_bill_is_used() -> None:
    """A part on the bill that no instruction uses is either not needed or forgotten."""
    assert set(parts()) - set.union(*map(named, INSTRUCTIONS)) == set()


def test_pins_of_the_wiring_match_the_header() -> None:
    assert len(wires()) >= 9
    for pin, (line, signal, *_) in wires().items():
        assert HEADER[pin] == line, f"pin {pin}"
        if signal in BUSES:
            assert BUSES[signal][0] == line
    once = Counter(line for line, *_ in wires().values() if line.startswith("GPIO"))
    assert max(once.values()) == 1


def test_signal_is_on_the_bus_of_its_device() -> None:
    for line, signal, _, entry in wires().values():
        if signal in BUSES:
            assert BUSES[signal][1] in entry, f"{line} is no line of {entry}"


def test_heartbeat_line_is_pulled_down_from_reset() -> None:
    """GPIO 9 to 27 are pulled down from reset; a heartbeat on another line would be high before any software runs."""
    (heartbeat,) = wired_values("gpio.heartbeat")
    assert 9 <= int(heartbeat) <= 27
    assert "**pull-down**" in next(to for line, _, to, _ in wires().values() if line == f"GPIO{heartbeat}")


@pytest.mark.parametrize("head", HEADS, ids=lambda path: path.stem)
def test_wiring_matches_the_head_file(head: Path) -> None:
    spec = load_head(head)
    if spec.light.chain is not None:
        assert wired_values("light.chain.device") == {spec.light.chain.device}
    if spec.bus is not None:
        assert wired_values("bus.device") == {spec.bus.device}
        sda = wires()[3][2]
        for part, address in (
            ("thermometer", spec.bus.thermometer),
            ("fuel gauge", spec.bus.battery),
            ("head memory", spec.bus.memory),
        ):
            assert address is None or f"**{part}** 0x{address:02x}" in sda
    if spec.gpio is not None:
        assert wired_values("gpio.heartbeat") == {str(spec.gpio.heartbeat)}
        assert wired_values("gpio.button") == {str(spec.gpio.button)}


@pytest.mark.parametrize("head", HEADS, ids=lambda path: path.stem)
def test_no_head_file_names_a_gauge_that_is_not_ordered(head: Path) -> None:
    """Defect 4: a gauge that does not answer refuses every press."""
    [gauge] = [line for line in text("hardware/parts.csv").splitlines() if line.startswith("fuel gauge,")]
    assert "not yet ordered" in gauge
    bus = load_head(head).bus
    assert bus is None or bus.battery is None


def test_head_file_lines_of_the_instructions_load(tmp_path: Path) -> None:
    lines = re.findall(r"^```\n(\[gpio\]\n.*?)^```", text("hardware/wiring.md"), re.M | re.S)
    (head := tmp_path / "head.toml").write_text(text("hardware/heads/imx296.toml") + "\n" + lines[0])
    gpio = load_head(head).gpio
    assert gpio is not None
    assert {str(gpio.heartbeat)} == wired_values("gpio.heartbeat")
    assert {str(gpio.button)} == wired_values("gpio.button")


def test_dead_man_gate_closes_in_time_with_the_parts_of_the_bill() -> None:
    """0.3 to 0.5 s (hardware/dead-man.md): R C for the 74LVC1G123, TI's SLVA720A; 0.45 R C for the alternative."""
    uf = float(re.findall(r"([\d.]+) uF", parts()["timing capacitor"]["what_for"])[0])
    ours_k, others_k = map(float, re.findall(r"(\d+) k\b", parts()["timing resistor"]["what_for"]))
    assert "74LVC1G123" in parts()["one-shot"]["from"]
    assert 0.3 < ours_k * uf / 1000 < 0.5
    assert 0.3 < 0.45 * others_k * uf / 1000 < 0.5
    assert f"{ours_k:g} k, {uf:g} uF" in text("hardware/pictures/wiring.svg")
    assert f"C {uf:g} uF, and R {ours_k:g} k for a 74LVC1G123" in text("hardware/dead-man.md")


def test_wiring_drawing_shows_the_table() -> None:
    root = ElementTree.fromstring(text("hardware/pictures/wiring.svg"))
    found = boxes(root)
    assert overlapping(found) == []
    lines = {re.sub(r"\s+", " ", box.words) for box in found}
    for pin, (line, signal, to, _) in wires().items():
        words = next((words for words in lines if re.match(rf"pin {pin} ", words)), "")
        assert line in words, f"pin {pin}"
        assert signal in ("supply", "ground") or signal in words
        for part in re.findall(r"\*\*([^*]+)\*\*", to):
            assert any(SHOWN_AS.get(part, part) in words for words in lines), part
    assert {"0x48", "0x36", "0x50"} <= lines


def test_light_path_drawing_is_up_to_date() -> None:
    """Made by `diffuscope optics --head hardware/heads/imx296.toml --svg hardware/pictures/light-path.svg`."""
    design = design_of_head(load_light_path(HARDWARE / "optics.toml"), load_head(HARDWARE / "heads" / "imx296.toml"))
    assert text("hardware/pictures/light-path.svg") == draw_light_path(design)


def test_figures_of_the_assembly_match_the_optics() -> None:
    path = load_light_path(HARDWARE / "optics.toml")
    design = design_of_head(path, load_head(HARDWARE / "heads" / "imx296.toml"))
    budget, relay = optical_budget(design), design.relay
    small = optical_budget(replace(design, pupil_mm=3.0))
    wide = optical_budget(replace(design, optics=path.optics.model_copy(update={"field_deg": 50.0})))
    beside = ChainSpec(axis=(3, 3), leds=(18, 19, 20, 26, 28, 34, 35, 36))
    figures = [
        f"{relay.first_mm:g} mm before the first",
        f"second lens are {relay.first_mm + relay.second_mm:g} mm apart",
        f"{relay.second_mm:g} mm behind the second lens",
        f"10 mm measure {10 * relay.pupil_magnification:.1f} mm",
        f"the iris is {budget.iris_at_eye_mm:.2f} mm wide",
        f"has {budget.pupil_margin_mm:.2f} mm of margin",
        f"one of 3 mm has {small.pupil_margin_mm:.2f} mm",
        f"0.1 mm are {10 / relay.diffuser_to_sensor_mm:.1f} %",
        f"{path.relay.splitter_to_iris_mm:g} mm before the iris",
        f"beam is {budget.splitter_mm:.1f} mm wide there",
        f"plate shows {path.relay.splitter_mm / 2**0.5:.1f} mm",
        f"ring of {budget.ring_at_pupil_mm:.2f} mm",
        f"full cone of {budget.led_cone_deg:.2f} degrees",
        f"{budget.light.cornea_mw:.3f} mW of green",
        f"about {200 * tan(radians(budget.field_deg / 2)) + budget.ring_at_pupil_mm:.1f} mm",
        f"LEDs {', '.join(map(str, ring(path.ring)))}",
        f"reflex ({2 * budget.reflex_free_mm:.2f} mm)",
        f"36: {ring_at_pupil_mm(beside, 0.75):.2f} mm",
        f"and {inner_ring_at_pupil_mm(beside, 0.75):.2f} mm at its",
        f"the inner four: {ring_at_pupil_mm(ring_for_pupil(path.ring, 7, 0.75), 0.75):.2f} mm at the pupil",
        f"its beam is {wide.splitter_mm:.1f} mm wide",
    ]
    guide = " ".join(f"{text('hardware/assembly.md')} {text(RING)}".split())
    assert [figure for figure in figures if figure not in guide] == []


def test_faces_of_the_lens_rims_in_the_guide_are_those_of_the_lens_data() -> None:
    """Rims by the makers' radii in tubes of 152.4 mm, the same room at both ends; the gaps are those of step 1."""
    path = load_light_path(HARDWARE / "optics.toml")

    def rim_mm(name: str) -> float:
        lens = path.lens[name]
        first, last = (
            abs(radius) - sqrt(radius**2 - (lens.diameter_mm / 2) ** 2)
            for radius in (lens.radii_mm[0], lens.radii_mm[-1])
        )
        return sum(lens.thick_mm) - first - last

    wide, long = rim_mm("AC508-075-A"), rim_mm("AC508-100-A")
    steps = [wide, 14.6, wide, 64.1, long, 10.4, long]
    faces = [(152.4 - sum(steps)) / 2 + sum(steps[:n]) for n in range(len(steps) + 1)]
    *begin, last = [f"{face:.1f}" for face in faces]
    guide = " ".join(text("hardware/assembly.md").split())
    assert f"are {wide:.1f} mm (75) and {long:.1f} mm (100) thick" in guide
    assert f"from the eye's end, at {', '.join(begin)} and {last} mm" in guide


def test_expected_readings_in_the_guide_are_those_of_the_budget() -> None:
    path = load_light_path(HARDWARE / "optics.toml")
    design = design_of_head(path, load_head(HARDWARE / "heads" / "imx296_power.toml"))
    full, first = expected_uw(design), 0.252 * expected_uw(design)
    guide = " ".join(text("hardware/assembly.md").split())
    assert f"{full:.2f} uW at full drive, so {first:.2f} uW lit and {first / 2:.2f} uW as the mean" in guide
    weight = light_limits().photochemical_weight
    times = weight.of_spectrum(0.525, LED_FWHM_UM) / weight.at(0.525)
    assert f"{1000 * LED_FWHM_UM:.0f} nm counts {times:.2f} times its peak" in guide
    assert f"as {100 * at_full_drive(design).no_go:.0f} % of builds" in guide


def test_dioptre_steps_of_the_model_eye_match_the_guide() -> None:
    """The guide has the vergence 1/s - 1/f at 21 and 29 mm behind a 25 mm lens, and the caustic's width."""
    relay = relay_of(path := load_light_path(HARDWARE / "optics.toml"), path.optics)
    guide = " ".join(text("hardware/assembly.md").split())
    shrinks_per_dpt = relay.diffuser_to_sensor_mm * relay.angular_magnification**2 / 1000
    for distance_mm, kind, goes in ((21, "hyperopia", "wider"), (29, "myopia", "narrower")):
        dpt = abs(1000 / distance_mm - 1000 / 25)
        assert re.search(rf"{dpt:.2f}( dioptres)? of {kind}", guide)
        assert re.search(rf"{100 * shrinks_per_dpt * dpt:.1f} % {goes}", guide)
    assert f"bright disc, {7.7 * relay.pupil_magnification:.1f} mm" in guide


def test_frame_of_a_torch_in_the_guide_matches_the_optics() -> None:
    """A torch 18 cm off the axis at 1 m moves the disc of the caustic by that tangent through relay and diffuser."""
    relay = relay_of(path := load_light_path(HARDWARE / "optics.toml"), path.optics)
    moved_um = 0.18 * relay.angular_magnification * path.optics.diffuser_to_sensor_um
    guide = text("hardware/assembly.md")
    shift = re.search(r"1 m before the head: 18 cm to the right.*? is about (\d+) pixels right", guide)
    assert shift is not None
    assert float(shift[1]) == pytest.approx(moved_um / 3.45, rel=0.03)  # rounded to ten pixels


def test_other_pinholes_of_the_guide_match_the_optics() -> None:
    """Width over focal length, and the first null of a disc (OPTICS.md 2.5) in the field."""
    relay = relay_of(path := load_light_path(HARDWARE / "optics.toml"), path.optics)
    guide = " ".join(text("hardware/assembly.md").split())
    mm_per_deg = relay.diffuser_to_sensor_mm * tan(radians(relay.angular_magnification))
    widths_deg = {um: degrees(um / 25_000) for um in (200, 250, 275, 300)}
    nulls = [
        1.22 / (path.optics.diffuser_to_sensor_um / 1000 * relay.angular_magnification * radians(deg)) * mm_per_deg
        for deg in widths_deg.values()
    ]
    first, *others = [f"{deg:.2f} for {um}" for um, deg in widths_deg.items()]
    assert f"in degrees: {first} um, {', '.join(others)}." in guide
    assert f"{(275 / 200) ** 2:.1f} times for 200 um" in guide
    *begin, last = [f"{null:.2f}" for null in nulls]
    assert f"end at {', '.join(begin)} and {last} cycles" in guide


def test_width_of_the_meter_in_the_guide_matches_the_optics() -> None:
    """Behind the hole the light spreads as the ring of spots is seen from it, by the widest emitter of a head."""
    path = load_light_path(HARDWARE / "optics.toml")
    design = design_of_head(path, load_head(HARDWARE / "heads" / "imx296_power.toml"))
    spots_mm = ring_at_pupil_mm(design.chain, 0.75) + 0.75 * design.emitter_mm
    spread = (spots_mm + AXIS_HOLE_MM) / AXIS_DISTANCE_MM
    claim = f"a sensor of {AXIS_HOLE_MM + 8 * spread:.0f} mm or more that lies at most 8 mm behind the hole"
    assert claim in " ".join(text("hardware/assembly.md").split())


def test_drawing_of_the_meter_has_the_hole_of_the_command() -> None:
    drawn, guide = text("hardware/pictures/power-meter.svg"), text("hardware/assembly.md")
    assert "(pictures/power-meter.svg)" in guide
    for figure in (f"hole of {AXIS_HOLE_MM:g} mm", f"{AXIS_DISTANCE_MM:g} mm"):
        assert figure in drawn
        assert figure in guide


def printed() -> set[str]:
    """Return the names of the printed parts, one per file of models."""
    stems = {path.stem for path in (HARDWARE / "parts" / "printed").glob("[a-z]*.py")}
    return {stem.replace("_", " ").replace("led ", "LED ") for stem in stems}


def test_bill_lists_exactly_the_printed_parts() -> None:
    assert len(printed()) > 10
    assert {name for name, row in parts().items() if row["from"].startswith("printed")} == printed()
    guide = re.search(r"The (\w+) printed parts", text("hardware/assembly.md"))
    assert guide is not None
    assert {"seventeen": 17}[guide[1]] == len(printed())


def test_distances_of_glass_in_the_guide_are_those_of_the_ray_trace() -> None:
    path = load_light_path(HARDWARE / "optics.toml")
    traced, guide = traced_relay(path), " ".join(text("hardware/assembly.md").split())
    faces, half, built = traced.lamp_surfaces, len(traced.lamp_surfaces) // 2, Dimensions(path)
    stop_mm = -built.tube_stop_z_mm
    between = f"{faces[half].at_mm - faces[half - 1].at_mm:.1f} mm"
    last_mm, along = traced.iris_at_mm - faces[-1].at_mm, path.optics.angular_magnification**2

    def rims_mm(left: Surface, right: Surface) -> float:
        sags = [
            abs(surface.radius_mm) - (surface.radius_mm**2 - (path.relay.lens_mm / 2) ** 2) ** 0.5
            for surface in (left, right)
        ]
        return right.at_mm - left.at_mm + sum(sags)

    figures = [
        f"rims {rims_mm(*faces[2:4]):.1f} mm (75) and {rims_mm(*faces[8:10]):.1f} mm (100)",
        f"{rims_mm(*faces[5:7]):.1f} mm from rim to rim",
        f"are {between}, measured on the axis",
        f"no nearer to the iris than {stop_mm:.1f} mm",
        f"last glass {last_mm:.1f} mm before the iris",
        f"pupil {faces[0].at_mm:.1f} mm before the first glass",
        f"is {stop_mm - last_mm:.1f} mm more",
        f"by {along:.2f} mm towards the glass for each",
        f"It is {built.pupil_to_glass_mm:.1f} mm, within",
    ]
    assert [figure for figure in figures if figure not in guide] == []
    assert built.pupil_to_glass_mm == pytest.approx(faces[0].at_mm - (stop_mm - last_mm) * along)
    shown = re.findall(r">([\d.]+ mm)<", text("hardware/pictures/parts-step-relay.svg"))
    assert shown == [f"{built.pupil_to_glass_mm:.1f} mm", between, f"{stop_mm:.1f} mm"], "as built, not as laid out"


def test_guide_turns_the_lenses_as_the_layout_does() -> None:
    """Inner faces of each pair are the most curved, outer ones the flattest."""
    faces = traced_relay(load_light_path(HARDWARE / "optics.toml")).lamp_surfaces
    for pair in (faces[:6], faces[6:]):
        radii = [abs(face.radius_mm) for face in pair]
        assert max(radii[2:4]) < min(radii[0], radii[5]) / 2
    assert "the two strongly curved faces look at each other" in text("hardware/assembly.md")


def test_each_step_has_its_picture() -> None:
    """A picture's names are parts that the row of its step names, or those that a step before has put together."""
    guide = text("hardware/assembly.md")
    steps = dict(re.findall(r"^\| \d (\w+) \| (.*)$", guide, re.M))
    assert list(steps) == ["relay", "iris", "sensor", "splitter", "polariser", "gate", "ring", "tubes"]
    built = set[str]()
    for name, words in steps.items():
        built |= set(re.findall(r"\*\*([^*]+)\*\*", words))
        if name in ("relay", "gate"):  # lenses have no parts; a board is drawn by KiCad
            continue
        file = f"pictures/parts-step-{name}.svg"
        assert f"({file})" in guide
        root = ElementTree.fromstring(text(f"hardware/{file}"))
        found = boxes(root)
        assert overlapping(found) == []
        assert max(box.right for box in found) <= float(root.attrib["width"]), "a name is cut off"
        assert {box.words for box in found} & {*parts(), *printed()} <= built, name
    assert "(pictures/parts-step-relay.svg)" in guide


@pytest.mark.parametrize("name", ["printed", "exploded", "section", "eye", "chart-eye"])
def test_part_pictures_are_legible(name: str) -> None:
    """The guide shows each picture; its names are on the bill, no name covers another, and the file is small."""
    file = f"hardware/pictures/parts-{name}.svg"
    assert f"(pictures/parts-{name}.svg)" in text("hardware/assembly.md") + text("hardware/model-eye.md")
    found = boxes(ElementTree.fromstring(text(file)))
    assert overlapping(found) == []
    assert len({box.words for box in found} & {*parts(), *printed()}) >= 4
    assert len(text(file)) < 150_000


def test_every_printed_part_has_pictures() -> None:
    """Each part is shown alone as printed, and in its place."""
    shown = {name: text(f"hardware/pictures/parts-{name}.svg") for name in ("printed", "exploded", "eye", "chart-eye")}
    assert not [part for part in printed() if f">{part}<" not in shown["printed"]]
    together = shown["exploded"] + shown["eye"] + shown["chart-eye"]
    assert [part for part in printed() if f">{part}<" not in together] == ["dust cap"]


@pytest.mark.parametrize("ring_mm", [4.49, 10.04, 13.47, 16.19])
def test_rings_of_the_led_board_match_the_guide(ring_mm: float) -> None:
    """The rings lie on the board's own grid, 3.175 mm; neither 8 nor 9.5 mm lies on it."""
    count = len(ring(ChainSpec(ring_mm=ring_mm, tolerance_mm=0.02)))
    assert re.search(rf"{ring_mm:.2f} mm \({count}", text(RING))


@pytest.mark.parametrize("paper", PAPERS)
def test_commands_and_links_of_the_documents_exist(paper: str) -> None:
    assert not [word for line in code_in(text(paper)) for word in unknown_words(line)]
    for link in re.findall(r"\]\(([^)]+)\)", text(paper)):
        assert (HARDWARE / link).is_file(), link
    for name in re.findall(r"`([\w/-]+\.(?:md|csv|toml))`", text(paper)):
        assert (HARDWARE / name).is_file(), name
