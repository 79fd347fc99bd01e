"""Suitability of the output of `make parts` for a slicer, checked with an independent library."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from build123d import import_step
from manifold3d import CrossSection, JoinType, Manifold, Mesh

from hardware.parts.assembly import printed
from hardware.parts.dimensions import Dimensions
from hardware.parts.export import export

pytestmark = pytest.mark.parts

NAMES = sorted(printed())
BED_MM = 120.0
THIN = {"LED cap": 0.6, "iris": 0.6}  # the pitch of the LEDs limits the baffles between them


@pytest.fixture(scope="module")
def folder(d: Dimensions, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("parts")
    files = export(d, out)
    assert len(files) == 2 * len(NAMES)
    return out


def mesh_of(folder: Path, name: str) -> trimesh.Trimesh:
    return trimesh.load_mesh(folder / f"{name.replace(' ', '-').lower()}.stl")


@pytest.mark.parametrize("name", NAMES)
def test_part_is_watertight_in_one_piece_and_on_the_bed(folder: Path, name: str) -> None:
    mesh = mesh_of(folder, name)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert mesh.volume > 0
    assert mesh.bounds[0] == pytest.approx([-mesh.extents[0] / 2, -mesh.extents[1] / 2, 0], abs=0.01)
    assert max(mesh.extents) < BED_MM


@pytest.mark.parametrize("name", NAMES)
def test_step_and_stl_hold_the_same_part(d: Dimensions, folder: Path, name: str) -> None:
    """Rotation for the printer leaves a part unchanged, and neither file loses a hole."""
    shape = printed()[name].shape(d)
    step = import_step(folder / f"{name.replace(' ', '-').lower()}.step")
    assert step.volume == pytest.approx(shape.volume, rel=1e-6)
    mesh = mesh_of(folder, name)
    assert mesh.volume == pytest.approx(shape.volume, rel=5e-3)
    assert sorted(mesh.extents) == pytest.approx(sorted(shape.bounding_box().size), abs=0.02)


@pytest.mark.parametrize("name", NAMES)
def test_walls_have_the_minimum_thickness(d: Dimensions, folder: Path, name: str) -> None:
    """Layer by layer, an opening by the minimum wall thickness removes nothing."""
    mesh = mesh_of(folder, name)
    body = Manifold(Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)))
    least = 0.97 * THIN.get(name, d.fit.wall_mm)  # corners of a polygonal circle are slightly closer
    for height in np.arange(0.1, mesh.extents[2], 0.4):
        layer = body.slice(height).simplify(0.01)
        opened = layer.offset(-least / 2, JoinType.Miter).offset(least / 2, JoinType.Miter)
        for lost in (layer - opened).decompose():
            assert lost.area() < 1.2, f"{height:.1f} mm above the bed, around {_middle(lost)}"


def _middle(lost: CrossSection) -> list[float]:
    return [round(v, 1) for v in np.concatenate(lost.to_polygons()).mean(axis=0)]
