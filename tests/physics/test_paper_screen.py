"""The paper's objects on a screen: dots, a retina, and the flat-field correction (S1, S2, S2b).

The experiments are those of `diffuscope paper`, with 2 x 2 pixels merged, which still samples the caustic.
"""

import numpy as np
import pytest

from tests.paper.bench import Bench, rectangle
from tests.paper.report import EXPERIMENTS
from tests.paper.screen import CUT, HRF_DEG

pytestmark = pytest.mark.paper

BENCH = Bench(merged=2)


@pytest.mark.parametrize("key", ["S1", "S2", "S2b"])
def test_every_assertion_holds(key: str) -> None:
    claims = EXPERIMENTS[key].run(BENCH).claims
    wrong = [claim for claim in claims if claim.status == "does not hold"]
    broken = [f"{claim.what}: {claim.value:.4g}, not {claim.limit}" for claim in wrong]
    assert claims
    assert not broken, "\n".join(broken)


def test_the_flat_field_of_a_cut_picture_ends_at_its_outline() -> None:
    """An even cut picture stays even; inside the outline of the full disc its edges would be brightened by up to 2."""
    take = BENCH.expose("paper_retina", CUT)
    even = rectangle(take.truth.shape, HRF_DEG, take.px_per_deg).astype(np.float32)
    corrected = take.flat_field_corrected(even)[take.inside]
    assert np.ptp(corrected) < 1e-3 * corrected.mean(), "single precision"
