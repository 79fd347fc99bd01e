"""The kept page of results against experiments that are run again at full size."""

import pytest

from tests.paper.bench import Bench
from tests.paper.report import EXPERIMENTS
from tests.paper.results_page import PAGE, kept_values
from tests.project_files import text

pytestmark = pytest.mark.paper


@pytest.mark.parametrize("key", ["T", "S1", "S3"])
def test_the_kept_page_has_the_values_of_the_quick_experiments(key: str) -> None:
    """Within two units of the last digit: another processor sums in another order, and the solvers iterate."""
    kept = kept_values(text(PAGE), key)
    claims = EXPERIMENTS[key].run(Bench()).claims
    assert list(kept) == [claim.what for claim in claims]
    for claim in claims:
        assert float(kept[claim.what]) == pytest.approx(claim.value, abs=2 * 10**-claim.digits), claim.what
