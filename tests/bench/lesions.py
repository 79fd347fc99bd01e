"""`make bench-lesions`: lesions that a reader would see against false grains, for each head and number of frames.

Three pictures of each drawn eye at the light of a human eye, by the default solver with the calibrated PSF: with round
lesions; without lesions, for false grains beside the vessels; and without retinal vessels, with a few short vessels of
known width. The eyes are still and emmetropic. The detector is one matched filter for each kind (`matched_filter.py`).
Figures of each eye are kept in the output folder, and measured once.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from device.clock import VirtualClock
from device.config.head_file import load_head
from device.errors import FrameError
from device.recon.burst_reconstructor import BurstReconstructor
from device.recon.model.fft_plans import Planner
from device.recon.model.resampling import to_sensor
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.sim.eyes import lit_deg
from device.sim.fundus import Fundus
from device.sim.objects import draw_object
from device.sim.plan import build_setup
from device.sim.render import convolved, crop_or_pad, psf, zones
from device.sim.scene_files import SimulatedExposure
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Counts, Image, Mask, Reconstruction
from tests.bench.candidates import Start, wavelets
from tests.bench.drawn_lesions import SPOTS, VESSELS, Kind, Lesion, scattered, with_lesions
from tests.bench.lesion_report import HEADS, TRUTH, write_report
from tests.bench.matched_filter import MatchedFilter, relative
from tests.bench.second_order_tv import SECOND_ORDER, with_second_order
from tests.simulated import SCENES, coarse

SHRINKAGE = "shrinkage"
PRIORS = ("wiener", SHRINKAGE, SECOND_ORDER)  # compared with the default one: "4 second-order" is of four frames
SUMMED = 2  # pixels of a sample, of 6.9 um with the IMX296: 26 um on the retina
USED_SHARE, DISC_DEG, FOVEA_DEG = 0.92, 4.0, 1.0
VESSEL_UM = 150.0  # from a drawn vessel: nearer places hold no lesion and no false grain
MOST_FALSE = 60  # false grains kept of a picture, the highest
PLANNER = Planner(folder=None, effort="FFTW_ESTIMATE")
FIRST_EYE = 100  # seed of the first drawn eye


class Bench:
    """One head before drawn eyes: its calibration, its reconstructors, and the masks of the lit field."""

    def __init__(self, head: str) -> None:
        spec = coarse(load_head(SCENES / f"human_eye_{head}.toml"), SUMMED)
        self.world = World(spec, VirtualClock())
        self.scene, self.colour = self.world.scene, spec.light.colour
        self.calibration = simulated_calibration(self.world)
        self._planned: dict[str, BurstReconstructor] = {}
        self.burst("")
        px_per_deg = self.scene.geometry.px_per_deg
        self.um_per_px = self.scene.sim.eye.focal_length_um * float(np.radians(1 / px_per_deg))

    def retina(self, seed: int, *, vessels: bool) -> Fundus:
        """Return a drawn retina without lesions, on the grid of the simulator's object."""
        what = self.scene.sim.object.model_copy(
            update={"haemorrhages": 0, "microaneurysms": 0, "exudates": 0, "haemoglobin": float(vessels)}
        )
        sim = self.scene.sim.model_copy(update={"seed": seed, "object": what})
        shape, light_deg = self.world.retina.field.shape, lit_deg(self.scene, self.world.plan)
        return draw_object(
            sim, self.scene.optics, "OD", (shape[0], shape[1]), self.scene.geometry.px_per_deg, lit_deg=light_deg
        )

    def allowed(self, retina: Fundus, *, vessels: bool) -> Mask:
        """Return where lesions and false grains are looked for: off the edge, the disc, the fovea and the vessels."""
        rows, cols = np.ogrid[: retina.field.shape[0], : retina.field.shape[1]]
        px_per_deg = self.scene.geometry.px_per_deg
        middle = [(n - 1) / 2 for n in retina.field.shape]
        radius_px = USED_SHARE * self.scene.half_field_deg * px_per_deg
        mask = np.hypot(rows - middle[0], cols - middle[1]) <= radius_px
        assert retina.disc is not None
        assert retina.fovea is not None
        for (row, col), away_deg in ((retina.disc, DISC_DEG), (retina.fovea, FOVEA_DEG)):
            mask &= np.hypot(rows - row, cols - col) > away_deg * px_per_deg
        if vessels:
            assert retina.vessels is not None
            mask &= ndimage.distance_transform_edt(~retina.vessels) * self.um_per_px > VESSEL_UM
        return np.asarray(mask)

    @cached_property
    def points(self) -> list[Image]:
        """PSFs of the zones of the field: those of curved lenses take longer than all else, and serve all eyes."""
        setup = self.world.setup(self.colour)
        return [psf(setup, zone.place) for zone in zones(setup)]

    def electrons(self, retina: Fundus) -> Image:
        """Return the expected electrons of one exposure, (rows, cols), as of `render.electrons_per_s` by a budget."""
        setup, budget = build_setup(self.scene, retina, self.world.plan), self.scene.budget
        assert budget is not None
        parts = [(zone.object, point) for zone, point in zip(zones(setup), self.points, strict=True)]
        image = convolved(parts, setup.shape, setup.drift_px)
        image *= np.float32(budget.mean_e * budget.disc_px / setup.object.sum(dtype=np.float64))
        return image

    def expose(self, retina: Fundus, seed: tuple[int, ...], count: int) -> list[Counts]:
        """Return `count` frames of a still retina."""
        electrons = self.electrons(retina)
        return [self.world.sensor.read(electrons, (*seed, number)) for number in range(count)]

    def burst(self, prior: str) -> BurstReconstructor:
        """Return the planned reconstructor of bursts with the default prior, "" or another one of PRIORS."""
        if prior not in self._planned:
            n = self._planned[""].single.stages[-1].recipe.bin if prior else 1
            look = Recipe("evidence", 2 * n)
            recipes = {
                "": (),
                "wiener": (look, Recipe("evidence", n)),
                SECOND_ORDER: (look, Recipe(SECOND_ORDER, n)),
            }[prior]
            single = Reconstructor(
                self.calibration,
                self.world.shape,
                PLANNER,
                VirtualClock(),
                recipes,
                refract=False,
                timed=False,
                methods=with_second_order(),
            )
            self._planned[prior] = BurstReconstructor(single, PLANNER, timed=False)
        return self._planned[prior]

    def picture(self, way: str, frames: Sequence[Counts]) -> Image:
        """Return the picture of a way, number of frames and prior; FrameError if it is refused or not joined."""
        number, _, prior = way.partition(" ")
        if prior == SHRINKAGE:
            return self.shrunk(frames[0])
        burst, count = self.burst(prior), int(number)
        if count == 1:
            return burst.single(frames[0], simulated=True).picture
        *_, made = burst.steps(frames[:count], None, simulated=True)
        assert isinstance(made, Reconstruction)
        if sum(use.used for use in made.report.frames or ()) != count:
            raise FrameError("not all frames were joined")
        return made.picture

    def shrunk(self, counts: Counts) -> Image:
        """Return the Wiener picture of a frame with its detail shrunk scale by scale (`candidates.wavelets`)."""
        exposure = SimulatedExposure(counts, self.world.truth(self.colour), None, self.calibration)
        start = Start.of(exposure, self.burst("").single.stages[-1].recipe.bin, PLANNER)
        return to_sensor(wavelets(start, 1), start.solver.model.grid)

    def on_object(self, picture: Image) -> Image:
        """Return a picture of the sensor on the grid of the object."""
        shape = self.world.retina.field.shape
        return crop_or_pad(picture, (shape[0], shape[1]))

    @cached_property
    def filters(self) -> dict[str, MatchedFilter]:
        """Matched filters by kind."""
        return {kind.name: MatchedFilter(kind, self.um_per_px) for kind in (*SPOTS, *VESSELS)}


class Eye:
    """One drawn eye: its three retinas with their lesions, and where they are looked for."""

    def __init__(self, bench: Bench, seed: int) -> None:
        self.bench, self.seed = bench, seed
        rng = np.random.default_rng((seed, 45))
        healthy, bare = bench.retina(seed, vessels=True), bench.retina(seed, vessels=False)
        self.allowed = {"healthy": bench.allowed(healthy, vessels=True), "bare": bench.allowed(bare, vessels=False)}
        self.spots = scattered(SPOTS, self.allowed["healthy"], bench.um_per_px, rng)
        self.vessels = scattered(VESSELS, self.allowed["bare"], bench.um_per_px, rng)
        self.retinas = {
            "lesions": self._drawn(healthy, self.spots),
            "healthy": healthy,
            "bare": self._drawn(bare, self.vessels),
        }
        places = np.ones(healthy.field.shape, bool)
        for lesion in self.vessels:
            places[round(lesion.row), round(lesion.col)] = False
        away_um = ndimage.distance_transform_edt(places) * bench.um_per_px
        self.allowed["bare"] &= away_um > 2 * VESSELS[0].reach_um

    def _drawn(self, retina: Fundus, lesions: Sequence[Lesion]) -> Fundus:
        plane = with_lesions(retina.plane(self.bench.colour), lesions, self.bench.um_per_px)
        return replace(retina, reflectance={**retina.reflectance, self.bench.colour: plane})

    def figures(self, pictures: dict[str, Image]) -> dict[str, Any]:
        """Return by kind the contrasts found at the lesions, and those of false grains with their share of the field.

        `pictures` has the three pictures on the grid of the object.
        """
        bench = self.bench
        field = self.retinas["healthy"].field
        details = {name: relative(picture, field, bench.um_per_px) for name, picture in pictures.items()}
        return {kind.name: self._of_kind(kind, details, float(field.sum())) for kind in (*SPOTS, *VESSELS)}

    def _of_kind(self, kind: Kind, details: dict[str, Image], field_px: float) -> dict[str, Any]:
        finder, um_per_px = self.bench.filters[kind.name], self.bench.um_per_px
        lesions, shown = (self.vessels, "bare") if kind.length_um else (self.spots, "lesions")
        found = finder.candidates(details[shown])
        false = {}
        for name in ("bare",) if kind.length_um else ("healthy", "bare"):
            grains = np.sort(finder.candidates(details[name]).inside(self.allowed[name]))[::-1][:MOST_FALSE]
            false[name] = {"contrasts": grains.round(5).tolist(), "share": float(self.allowed[name].sum()) / field_px}
        return {
            "lesions": [round(found.best_near(lesion, um_per_px), 5) for lesion in lesions if lesion.kind == kind],
            "false": false,
        }


def measured(bench: Bench, seed: int, ways: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield for each way to a picture, as of `Bench.picture`, the figures of one eye; of the truth without optics, too.

    A refused frame has its message as its figures.
    """
    eye = Eye(bench, seed)
    bursts = {name: bench.expose(retina, (seed, k), 8) for k, (name, retina) in enumerate(eye.retinas.items())}
    for way in ways:
        try:
            made = {name: bench.picture(way, burst) for name, burst in bursts.items()}
        except FrameError as error:
            yield way, {"refused": error.message}
        else:
            yield way, eye.figures({name: bench.on_object(picture) for name, picture in made.items()})
    yield TRUTH, eye.figures({name: retina.plane(bench.colour) for name, retina in eye.retinas.items()})


def measure(head: str, seeds: Sequence[int], ways: Sequence[str], folder: Path) -> None:
    """Write the figures of each eye that has no file yet."""
    missing = [seed for seed in seeds if not (folder / f"{head}-{seed}.json").is_file()]
    bench = Bench(head) if missing else None
    for seed in missing:
        assert bench is not None
        path = folder / f"{head}-{seed}.json"
        path.write_text(json.dumps(dict(measured(bench, seed, ways))), encoding="utf-8")
        print(path, flush=True)


def main() -> None:
    """Measure the heads on the eyes that have no figures yet, and write table and plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--heads", nargs="*", choices=list(HEADS), default=list(HEADS))
    parser.add_argument("--eyes", type=int, default=20)
    parser.add_argument("--ways", nargs="*", default=["1", "4", "8"], help=f"number of frames, or with one of {PRIORS}")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/lesions"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for head in arguments.heads:
        measure(head, range(FIRST_EYE, FIRST_EYE + arguments.eyes), arguments.ways, arguments.out)
    write_report(arguments.out)


if __name__ == "__main__":
    main()
