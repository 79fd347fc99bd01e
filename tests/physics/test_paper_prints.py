"""The paper's printed and lit objects: rulers, a retina at three places, and its field (S3, S4, S7).

The experiments are those of `diffuscope paper`, with 2 x 2 pixels merged, which still samples the caustic.
"""

import pytest

from services.lab.paper.bench import Bench
from services.lab.paper.edges import edge_signs
from services.lab.paper.report import EXPERIMENTS

pytestmark = pytest.mark.paper

BENCH = Bench(merged=2)


@pytest.mark.parametrize("key", ["S3", "S4", "S7"])
def test_every_assertion_holds(key: str) -> None:
    claims = EXPERIMENTS[key].run(BENCH).claims
    wrong = [claim for claim in claims if claim.status == "does not hold"]
    broken = [f"{claim.what}: {claim.value:.4g}, not {claim.limit}" for claim in wrong]
    assert claims
    assert not broken, "\n".join(broken)


def test_a_negative_picture_has_inverted_edges() -> None:
    take = BENCH.expose("paper_print")
    edges, same = edge_signs(take, -take.truth, 0.0)
    assert edges > 5
    assert same == 0
    assert edge_signs(take, take.truth, 0.0) == (edges, edges)
