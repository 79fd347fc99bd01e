"""The paper's experiments: its numbers, the ray trace, its caustic and the beam walk (N, T, S0, S8).

The experiments are those of `diffuscope paper`, with 2 x 2 pixels merged, which still samples the caustic.
"""

import pytest

from tests.paper.bench import Bench
from tests.paper.report import EXPERIMENTS

pytestmark = pytest.mark.paper

BENCH = Bench(merged=2)


@pytest.mark.parametrize("key", ["N", "T", "S0", "S8"])
def test_every_assertion_holds(key: str) -> None:
    claims = EXPERIMENTS[key].run(BENCH).claims
    wrong = [claim for claim in claims if claim.status == "does not hold"]
    broken = [f"{claim.what}: {claim.value:.4g}, not {claim.limit}" for claim in wrong]
    assert claims
    assert not broken, "\n".join(broken)
