"""What the paper printed and lit: rulers, a retina at three places, and how wide that is (S3, S4, S7).

The experiments are those of `diffuscope paper`, with 2 x 2 pixels merged: the caustic has nothing finer.
"""

import pytest

from services.instrument.paper.bench import Bench
from services.instrument.paper.printed import edge_signs
from services.instrument.paper.report import EXPERIMENTS

pytestmark = pytest.mark.paper

BENCH = Bench(merged=2)


@pytest.mark.parametrize("key", ["S3", "S4", "S7"])
def test_every_assertion_holds(key: str) -> None:
    claims = EXPERIMENTS[key].run(BENCH).claims
    broken = [f"{claim.what}: {claim.value:.4g}, not {claim.limit}" for claim in claims if not claim.holds]
    assert claims
    assert not broken, "\n".join(broken)


def test_every_edge_of_a_negative_goes_the_wrong_way() -> None:
    take = BENCH.take("paper_print")
    asked, same = edge_signs(take, -take.truth, 0.0)
    assert asked > 5
    assert same == 0
    assert edge_signs(take, take.truth, 0.0) == (asked, asked)
