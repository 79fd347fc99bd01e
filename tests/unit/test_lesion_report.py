"""Figures of the lesions' bench: sensitivity at a rate of false grains, its sampling error, and the compared prior."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.bench.drawn_lesions import SPOTS, VESSELS
from tests.bench.lesion_report import Found, in_words, table, write_report
from tests.bench.second_order_tv import adjoint, second_differences

KIND = SPOTS[1]


def figures(rng: np.random.Generator, seen: float) -> dict[str, object]:
    """Return figures of one eye: lesions above all but one of ten false grains with probability `seen`."""
    return {
        kind.name: {
            "lesions": np.where(rng.random(kind.count) < seen, 0.15, 0.05).tolist(),
            "false": {"bare": {"contrasts": [0.2, *[0.1] * 9], "share": 1.0}},
        }
        for kind in (*SPOTS, *VESSELS)
    }


def test_the_threshold_leaves_the_stated_number_of_false_grains() -> None:
    found = Found([np.array([0.05, 0.15, 0.25])], [[(np.array([0.2, 0.1]), 0.5), (np.array([0.12]), 0.5)]])
    assert found.sensitivity(0) == pytest.approx(1 / 3)
    assert found.sensitivity(1) == pytest.approx(2 / 3)
    assert found.sensitivity(3) == 1


def test_half_of_the_field_searched_allows_half_of_the_false_grains() -> None:
    found = Found([np.array([0.15])], [[(np.array([0.2, 0.1]), 0.5)]])
    assert found.sensitivity(1) == 0
    assert found.sensitivity(2) == 1


def test_the_sampling_error_is_that_of_independent_eyes() -> None:
    rng = np.random.default_rng(0)
    found = Found.of([figures(rng, 0.7) for _ in range(40)], KIND)
    expected = (0.7 * 0.3 / (40 * KIND.count)) ** 0.5
    assert found.sensitivity(1) == pytest.approx(0.7, abs=4 * expected)
    assert found.error(1) == pytest.approx(expected, rel=0.35)


def test_the_sampling_error_of_lesions_that_were_all_found_is_not_zero() -> None:
    found = Found.of([figures(np.random.default_rng(0), 1.0)], KIND)
    assert found.sensitivity(1) == 1
    assert 0.03 < found.error(1) < 1 / KIND.count


def test_no_lesion_is_found_in_a_refused_frame() -> None:
    rng = np.random.default_rng(0)
    assert Found.of([figures(rng, 1.0), {"refused": "too dark"}], KIND).sensitivity(1) == pytest.approx(0.5)


def test_table_and_plot_have_every_head_and_way_that_was_measured(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    (tmp_path / "imx296-100.json").write_text(json.dumps({"1": figures(rng, 1.0), "4 second-order": figures(rng, 0)}))
    lines = table(tmp_path).splitlines()
    assert lines[2].startswith("| diffuser | 1 frame | 1 | 1.00 ± 0.05")
    assert lines[3].startswith("| diffuser | 4 frames, second-order | 1 | 0.00 ± 0.05")
    write_report(tmp_path)
    assert in_words("1") in (tmp_path / "lesions.svg").read_text(encoding="utf-8")


def test_adjoint_of_the_second_differences() -> None:
    rng = np.random.default_rng(3)
    x, z = rng.standard_normal((6, 9)), rng.standard_normal((3, 6, 9))
    assert np.vdot(second_differences(x), z) == pytest.approx(np.vdot(x, adjoint(z)), rel=1e-5)
