"""The scale factor per dioptre of heads with other optics, a wide source or a shifted diffuser, and its refractions."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from device.calibration.archive import Archive
from device.calibration.procedure.calibration_sequence import CalibrationJob, CalibrationSequence, Operator
from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec
from device.head import target_placer
from device.recon.estimation.refraction.estimator import Refraction, RefractionEstimator
from device.recon.model.fft_plans import Planner
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.world import World
from device.values import Calibration, ExposureSettings, Illumination
from tests.simulated import with_keys

EYES_DPT = (-6.0, -4.0, -2.0, -0.5, 0.5, 2.0, 4.0, 6.0)
MAX_RMS_DPT = 0.1
HEADS: dict[str, tuple[dict[str, float], dict[str, float]]] = {
    "the paper's, dot of 275 um": ({}, {"source_um": 275.0}),
    "z 8 mm, a 0.6, iris 2.6 mm": (
        {"diffuser_to_sensor_um": 8000.0, "angular_magnification": 0.6, "iris_um": 2600.0},
        {},
    ),
    "diffuser 0.3 mm off its place": ({"diffuser_to_sensor_um": 6300.0}, {}),
}


def factors(drawn: InstrumentSpec, planner: Planner) -> list[tuple[str, float, float]]:
    """Return name, value and limit of each figure.

    The figures are the factor of each head, and refractions of heads that deviate from `drawn`.
    """
    figures = []
    for name, (optics, source) in HEADS.items():
        assert drawn.optics is not None
        made = drawn.model_copy(update={"optics": drawn.optics.model_copy(update=optics)})
        world = World(with_keys(made, calibration=source), VirtualClock())
        found = measured(world, drawn if "off its place" in name else made)
        assert found.geometry is not None
        error = abs(found.geometry.scale_per_dpt / world.geometry.nominal_scale_per_dpt - 1)
        figures.append((f"factor: {name}", error, 0.01))
    figures.append(("refraction there, dpt RMS", refracted(world.spec, found, planner), MAX_RMS_DPT))
    by_drawing = replace(found, geometry=replace(found.geometry, measured_scale_per_dpt=None))
    figures.append(("... and by the drawings, dpt RMS", refracted(world.spec, by_drawing, planner), float("inf")))
    return figures


def measured(world: World, drawn: InstrumentSpec) -> Calibration:
    """Return the calibration of a world's head by a technician with the drawings `drawn`."""
    assert world.spec.sim is not None
    source_deg = float(np.degrees(world.spec.sim.calibration.source_um / world.spec.sim.eye.focal_length_um))
    job = CalibrationJob(drawn, "D-1", "bench", "0", source_deg=source_deg, dioptres=True)
    with tempfile.TemporaryDirectory() as folder:
        archive, operator = Archive(Path(folder)), Operator(target_placer(world), lambda line: None)
        id = CalibrationSequence(job, SimCamera(world), operator, world.clock, Path(folder) / ".steps").run(archive)
        return archive.load(id).calibration


def refracted(spec: InstrumentSpec, found: Calibration, planner: Planner) -> float:
    """Return the RMS error of the refraction over simulated retinas, dpt."""
    errors = []
    refractor = RefractionEstimator(found, found.psfs[0].shape, planner, 0)
    for m_dpt in EYES_DPT:
        world = World(with_keys(spec, eye={"m_dpt": m_dpt}), VirtualClock())
        camera, shot = SimCamera(world), ExposureSettings(spec.camera.exposure_s)
        with SimLight(world).on(Illumination(spec.light.colour)):
            frame = camera.expose(shot).counts.copy()
        seen = refractor.find(frame, camera.expose(shot).counts)
        errors.append(seen.m_dpt - m_dpt if isinstance(seen, Refraction) else np.nan)
    return float(np.sqrt(np.mean(np.square(errors))))
