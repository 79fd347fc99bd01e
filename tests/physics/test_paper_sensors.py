"""The paper's experiments: sensors smaller than the light, and frames with known faults (S10, S12).

The experiments are those of `diffuscope paper`, with 2 x 2 pixels merged, which still samples the caustic.
"""

import pytest

from tests.paper.bench import Bench
from tests.paper.report import EXPERIMENTS

pytestmark = pytest.mark.paper

BENCH = Bench(merged=2)


@pytest.mark.parametrize("key", ["S10", "S12"])
def test_every_assertion_holds(key: str) -> None:
    claims = EXPERIMENTS[key].run(BENCH).claims
    broken = [f"{claim.what}: {claim.value:.4g}, not {claim.limit}" for claim in claims if not claim.holds]
    assert claims
    assert not broken, "\n".join(broken)
