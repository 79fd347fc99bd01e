"""The paper's printed and lit objects: rulers, a retina at three places, and its field (S3, S4, S7).

The experiments are those of `diffuscope paper`, with 2 x 2 pixels merged, which still samples the caustic.
"""

import numpy as np
import pytest

from device.optics.light_path import load_light_path
from services import resources
from tests.paper.bench import Bench
from tests.paper.edges import edge_signs
from tests.paper.printed import WIDE_LATTICE, field_to_rims_deg, lattice_deg
from tests.paper.relay_figures import built_relay
from tests.paper.report import EXPERIMENTS
from tests.paper.screen import FLOOR

pytestmark = pytest.mark.paper

BENCH = Bench(merged=2)


@pytest.mark.parametrize("key", ["S3", "S4", "S7"])
def test_every_assertion_holds(key: str) -> None:
    claims = EXPERIMENTS[key].run(BENCH).claims
    wrong = [claim for claim in claims if claim.status == "does not hold"]
    broken = [f"{claim.what}: {claim.value:.4g}, not {claim.limit}" for claim in wrong]
    assert claims
    assert not broken, "\n".join(broken)


def test_the_half_width_of_a_lattice_is_that_of_its_falloff() -> None:
    """Dots that are even within 10 degrees and fall to half at 14; they are 2.2 degrees apart."""
    take = BENCH.expose("paper_dots", WIDE_LATTICE)
    right_deg = (np.arange(take.truth.shape[1]) - (take.truth.shape[1] - 1) / 2) / take.px_per_deg
    light = np.float32(0.5) ** np.maximum((np.abs(right_deg) - 10) / 4, 0).astype(np.float32)
    found_deg, half_deg = lattice_deg(take, take.truth * light)
    assert half_deg == pytest.approx(28, abs=0.5)
    floor_deg = 10 + 4 * np.log2(1 / FLOOR)  # the angle with the least brightness of a dot
    assert found_deg / 2 == pytest.approx(floor_deg, abs=2.2)


def test_the_rims_end_the_field_of_an_led_without_a_cap() -> None:
    relay = built_relay(load_light_path(resources.LIGHT_PATH))
    field_deg = field_to_rims_deg(relay, 4.75)
    half_cone_deg = field_deg / 2 * relay.first.focal_mm / relay.second.focal_mm
    assert np.isfinite(relay.lamp_ray(4.75, half_cone_deg - 1)[1])
    assert not np.isfinite(relay.lamp_ray(4.75, half_cone_deg + 1)[1])


def test_a_negative_picture_has_inverted_edges() -> None:
    take = BENCH.expose("paper_print")
    edges, same = edge_signs(take, -take.truth, 0.0)
    assert edges > 5
    assert same == 0
    assert edge_signs(take, take.truth, 0.0) == (edges, edges)
