"""The LEDs' cap: penumbra of die, hole and height against ray counts, and the tolerances of the documents."""

from math import cos, pi, radians, sin, sqrt, tan
from pathlib import Path

import numpy as np
import pytest

from device.config.head_file import load_head
from device.light_safety.hazard import light_limits
from device.optics.led_cap import LedCap, centre_over_mean, dark_deg, half_maximum_deg, relative_irradiance, seen_share
from device.optics.light_path import load_light_path
from device.optics.lit_angle import picture_field_deg, soft_edge_deg
from hardware.parts.dimensions import Fits, dimensions
from services.workshop.light_report import expected_beam, limit_shares
from services.workshop.light_tolerances import tolerances
from services.workshop.optics_report import design_of
from tests.project_files import text

HARDWARE = Path(__file__).parents[2] / "hardware"
POWER = design_of(load_head(HARDWARE / "heads" / "imx296_power.toml"))
CAP, RELAY = POWER.cap, 0.75


def counted(cap: LedCap, right: float, up: float) -> float:
    """Return the share of a die's places whose ray passes the hole's end, of 400 x 400."""
    steps = ((np.arange(400) + 0.5) / 400 - 0.5) * cap.emitter_mm
    at = np.hypot(steps[:, None] + cap.height_mm * right, steps[None, :] + cap.height_mm * up)
    return float((at <= cap.hole_mm / 2).mean())


@pytest.mark.parametrize(
    "cap", [CAP, LedCap(2.175, 4.9, 0.25), LedCap(0.8, 2.0, 1.0)], ids=["power", "apa102", "small"]
)
def test_share_of_the_die_is_that_of_counted_rays(cap: LedCap) -> None:
    for slope in (0.0, 0.1, 0.15, 0.22, 0.3, 0.4):
        for turn in (0.0, 0.4, pi / 4):
            way = slope * cos(turn), slope * sin(turn)
            assert seen_share(cap, *way) == pytest.approx(counted(cap, *way), abs=0.004)  # 400 x 400 places, 48 strips


def test_a_point_of_light_has_a_sharp_edge_at_the_field() -> None:
    point = LedCap(CAP.hole_mm, CAP.height_mm, 1e-3)
    assert half_maximum_deg(point, RELAY) == pytest.approx(33.4, abs=0.1)
    even = centre_over_mean(point, RELAY, 33.4)
    # Lambert's power in the cone, sin^2, spread over the disc, against the intensity on the axis.
    assert even == pytest.approx(RELAY**2 * tan(radians(16.7)) ** 2 / sin(radians(12.525)) ** 2, rel=0.01)


def test_a_cosine_ramp_describes_the_soft_edge_of_the_high_power_ring() -> None:
    edge = soft_edge_deg(load_head(HARDWARE / "heads" / "imx296_power.toml"))
    assert edge is not None
    diameter_deg, width_deg = edge
    off_deg = np.arange(0.0, 27.0)
    place = np.clip((diameter_deg / 2 - off_deg) / width_deg + 0.5, 0, 1)
    assert 0.5 - 0.5 * np.cos(pi * place) == pytest.approx(relative_irradiance(CAP, RELAY, off_deg), abs=0.06)
    assert soft_edge_deg(load_head(HARDWARE / "heads" / "imx296.toml")) is None


def test_little_light_comes_from_beyond_the_picture_of_the_high_power_ring() -> None:
    """Behind lenslets 2.6 % of the light looked like a second image."""
    field_deg = picture_field_deg(load_head(HARDWARE / "heads" / "imx296_power.toml"))
    assert field_deg is not None
    off_deg = np.arange(0.0, 27.0, 0.05)
    light = off_deg * relative_irradiance(CAP, RELAY, off_deg)
    assert light[off_deg > field_deg / 2].sum() < 0.006 * light.sum()


def test_penumbra_of_the_high_power_ring_is_that_of_an_independent_trace() -> None:
    """A trace by others gave .87, .59, .40 and .18, half at 30.5 degrees; 0.02 for its own relay."""
    found = relative_irradiance(CAP, RELAY, [0, 10, 14, 16.7, 20])
    assert found == pytest.approx([1, 0.87, 0.59, 0.40, 0.18], abs=0.02)
    assert half_maximum_deg(CAP, RELAY) == pytest.approx(30.5, abs=0.5)
    beyond = dark_deg(CAP, RELAY) / 2
    assert relative_irradiance(CAP, RELAY, beyond + 0.1) == 0
    assert seen_share(CAP, *(np.tan(radians(RELAY * (beyond - 0.5))) * np.array([1, 1]) / sqrt(2))) > 0


def test_nothing_is_brighter_than_the_axis() -> None:
    for hole_mm, height_mm, die_mm in ((2.275, 4.6, 1.1), (2.075, 5.2, 0.9), (2.175, 4.9, 0.25)):
        found = relative_irradiance(LedCap(hole_mm, height_mm, die_mm), RELAY, np.linspace(0, 30, 121))
        assert found[0] == pytest.approx(1)
        assert (np.diff(found) <= 0).all()


def test_holes_leave_a_wall_on_the_board() -> None:
    fit, path = Fits(), load_light_path(HARDWARE / "optics.toml")
    assert dimensions().led_hole_mm == pytest.approx(path.ring.pitch_mm - fit.baffle_mm - 2 * fit.slide_mm)


def test_document_has_the_edge_and_the_tolerances_of_the_command() -> None:
    limits, optics = light_limits(), text("device/optics/OPTICS.md")
    used = limit_shares(POWER, expected_beam(POWER), limits)[0].used
    found = tolerances(POWER, used, limits)
    for tolerance in found:
        half, centre = (
            (f"{low:.{n}f}", f"{high:.{n}f}") for (low, high), n in ((tolerance.half_deg, 1), (tolerance.centre, 2))
        )
        columns = (" to ".join(dict.fromkeys(ends)) for ends in (half, centre))
        size = tolerance.size.replace("%", " %")
        row = f"| {tolerance.name} | {size} | {100 * tolerance.used:.0f} % | {' | '.join(columns)} |"
        assert row.replace("|  |", "| |") in optics
    shares = [f"{share:.2g}" for share in relative_irradiance(CAP, RELAY, [0, 10, 14, 16.7, 20])]
    edge = [f"{half_maximum_deg(CAP, RELAY) / 2:.1f}", f"{dark_deg(CAP, RELAY) / 2:.1f}"]
    assert f"| {' | '.join([*shares, *edge])} |" in optics
    assert found[-1].centre[1] < 1.4, "readings of single LEDs count 1.4 times"
