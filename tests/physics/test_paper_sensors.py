"""Sensors that are too small for the light, and frames that are bad in known ways (S10, S12).

The experiments are those of `diffuscope paper`, with 2 x 2 pixels merged: the caustic has nothing finer.
"""

import pytest

from services.instrument.paper.bench import Bench
from services.instrument.paper.report import EXPERIMENTS

pytestmark = pytest.mark.paper

BENCH = Bench(merged=2)


@pytest.mark.parametrize("key", ["S10", "S12"])
def test_every_assertion_holds(key: str) -> None:
    claims = EXPERIMENTS[key].run(BENCH).claims
    broken = [f"{claim.what}: {claim.value:.4g}, not {claim.limit}" for claim in claims if not claim.holds]
    assert claims
    assert not broken, "\n".join(broken)
