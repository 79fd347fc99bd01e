"""Notation of a refraction: power vectors, minus cylinder, TABO axis, and the refused report."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.recon.estimation.refraction.estimator import Cylinder, NoRefraction, Refraction
from device.recon.estimation.refraction.field import FieldEdge
from device.recon.estimation.refraction.notation import REFRACTION_KEYS, report_of, sphere_cylinder

DPT = st.floats(-8, 8)


def found(m_dpt: float, cylinder: Cylinder | None) -> Refraction:
    return Refraction(m_dpt, 0.1, 1 - 0.003375 * m_dpt, 900.0, (), FieldEdge(33.4, 0, 0, 0.3, 0.02), 0.0, cylinder)


@pytest.mark.parametrize(
    ("axis_deg", "j0_dpt", "j45_dpt"), [(180, 0.5, 0.0), (90, -0.5, 0.0), (45, 0.0, 0.5), (135, 0.0, -0.5)]
)
def test_known_axes(axis_deg: float, j0_dpt: float, j45_dpt: float) -> None:
    """Thibos 1997: with the rule (minus cylinder x 180) J0 is positive, x 45 J45 is positive."""
    assert sphere_cylinder(-2.0, j0_dpt, j45_dpt) == pytest.approx((-1.5, -1.0, axis_deg))


@given(DPT, DPT, DPT)
def test_sphere_and_cylinder_have_the_power_vector_they_came_from(m_dpt: float, j0_dpt: float, j45_dpt: float) -> None:
    lens = sphere_cylinder(m_dpt, j0_dpt, j45_dpt)
    turn = math.radians(2 * lens.axis_deg)
    back = (
        lens.sphere_dpt + lens.cylinder_dpt / 2,
        -lens.cylinder_dpt / 2 * math.cos(turn),
        -lens.cylinder_dpt / 2 * math.sin(turn),
    )
    assert back == pytest.approx((m_dpt, j0_dpt, j45_dpt), abs=1e-9)  # rounding of float64
    assert lens.cylinder_dpt <= 0
    assert 0 < lens.axis_deg <= 180


def test_the_report_is_the_correcting_lens_as_the_examiner_sees_the_eye() -> None:
    """The wavefront has y down: M and J0 change their signs, J45 does not."""
    report = report_of(found(2.0, Cylinder(0.3, 0.05, 0.4, 0.06)))
    assert tuple(report) == REFRACTION_KEYS
    assert (report["sphere"], report["j0"], report["j45"]) == (-2.0, -0.3, 0.4)
    assert (report["sphere_sc"], report["cylinder"]) == pytest.approx((-1.5, -1.0))
    assert report["axis_deg"] == pytest.approx(math.degrees(math.atan2(0.4, -0.3)) / 2)
    assert report["field_deg"] == pytest.approx(33.4)
    assert report["refused"] is None
    assert report["zero"] == "relative"
    assert report_of(found(2.0, None), "trial lens")["zero"] == "trial lens"


def test_a_refused_refraction_has_no_number() -> None:
    report = report_of(NoRefraction("the frame does not show the structure of this PSF"))
    assert tuple(report) == REFRACTION_KEYS
    assert [key for key, value in report.items() if value is not None] == ["refused"]


def test_without_a_cylinder_only_its_figures_are_null() -> None:
    report = report_of(found(-1.0, None))
    assert report["sphere"] == 1.0
    assert {key for key, value in report.items() if value is None} == {
        "j0",
        "j0_sd",
        "j45",
        "j45_sd",
        "sphere_sc",
        "cylinder",
        "axis_deg",
        "refused",
    }
