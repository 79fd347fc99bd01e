"""M: the paper's solver under its own rule for the weight mu, and under ours, beside the other solvers."""

from typing import NamedTuple

import numpy as np

from device.recon.closed import ClosedForm, Prior
from device.recon.methods import METHODS
from device.recon.prepare import Preparer
from device.recon.upsample import to_sensor
from device.values import Image
from services.instrument.paper.bench import Bench, Take
from services.instrument.paper.outcome import Experiment, Outcome, Sheet

SCENES = ("diabetic", "paper_print", "paper_heine")
FLAT_FIRST = Prior(slope=0.0, floor=1.0, psf_error=0.0, subtract_flat=True)
NOTE = (
    "The paper chose mu by eye. The best mu is chosen by an oracle, which no instrument has; cross-validation chooses "
    "from the frame alone. Most of what `gradient` gains comes from taking the flat field out first."
)


class Rules(NamedTuple):
    """PSNR in dB of one scene: the paper's solver at the best mu of its range, and the others at theirs by GCV."""

    scene: str
    best_mu: float
    best_db: float
    validated_db: float
    flat_first_db: float
    gradient_db: float

    @property
    def gain_db(self) -> float:
        """What `gradient` gains over the paper's solver at its best mu."""
        return self.gradient_db - self.best_db


def rules(bench: Bench, name: str) -> Rules:
    """Solve one frame of a shipped scene by the paper's solver under both rules, and by `gradient`."""
    take = bench.take(name)
    mu, _, best = bench.best(take)
    validated, gradient = (take.score(bench.solve(take, method)) for method in ("tikhonov", "gradient"))
    flat_first = take.score(_flat_first(bench, take))
    return Rules(take.name, mu, best.psnr_db, validated.psnr_db, flat_first.psnr_db, gradient.psnr_db)


def _flat_first(bench: Bench, take: Take) -> Image:
    """The picture with the L2 prior of the paper, but on the grid and with the flat field of `gradient`."""
    model = METHODS["gradient"].model(take.calibration, take.shape, take.samples_px, bench.planner, 0)
    solver, out = ClosedForm(model, FLAT_FIRST), np.zeros(model.grid.shape, np.float32)
    solver.start(Preparer(take.calibration, model.grid)(take.staged.counts))
    solver.finish(out)
    return take.sampled(to_sensor(out, model.grid))


def run_rules(bench: Bench) -> Outcome:
    """Three scenes under both rules; a table, and nothing is asserted."""
    bench.say("M: two rules for mu")
    every = [rules(bench, name) for name in SCENES]
    rows = tuple(
        (one.scene, f"{one.best_mu:.0e}", f"{one.best_db:.2f}", f"{one.validated_db:.2f}", f"{one.flat_first_db:.2f}",
         f"{one.gradient_db:.2f}", f"{one.gain_db:.1f}") for one in every
    )  # fmt: skip
    head = ("scene", "best mu", "paper's solver, best mu, dB", "paper's solver, GCV, dB",
            "L2, flat field first, GCV, dB", "gradient, GCV, dB", "gradient over best mu, dB")  # fmt: skip
    return Outcome((), (), (Sheet(head, rows),), (NOTE,))


EXPERIMENTS = (
    Experiment(
        "M", "Two rules for mu", "PSNR of the paper's solver at the best mu of its range, and by cross-validation.",
        "Section \"Algorithm\": \"picking the visually-optimal reconstruction when varying mu\".", run_rules,
    ),
)  # fmt: skip
