"""Accuracy against computing time on this device: measurement, new reconstruction of captures, time budget.

    FOLDER/frontier.json    the last measurement (services/research/frontier.py)
    FOLDER/frontier.svg     its plot
    FOLDER/choice.json      the selected time budget: grey, quick or standard

Before a measurement the simulated head shows the one in `simulated_frontier/`, which `make frontier` writes.

The module does not use the head: it simulates a scene with the same camera, and it reads stored captures.
"""

import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Thread

from pydantic import JsonValue, ValidationError

from device import atomic_io
from device.clock import Clock, SystemClock
from device.config.head_file import InstrumentSpec, load_head
from device.config.shipped_heads import HEADS
from device.errors import DiffuscopeError, SettingError
from device.recon.methods import METHODS
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_box
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.values import Calibration
from services.errors import Busy, RecordNotFound
from services.imaging import picture_files
from services.instrument.background import run_in_subprocess
from services.instrument.measured_frontier import MeasuredFrontier
from services.instrument.time_budget import PACES_S, Pace

log = logging.getLogger(__name__)

SCENE = Path(__file__).parents[2] / "device" / "sim" / "scenes" / "diabetic.toml"
BUDGET_S = 0.26  # the paper's time budget, for the choice from one frame
REPEATS = 2  # timed turns of every point: a measurement takes about a minute
LARGEST_BIN = 16
SHIPPED = Path(__file__).parent / "simulated_frontier"  # of the head below
SHIPPED_HEAD = HEADS / "sim.toml"
Measure = Callable[[InstrumentSpec, Path, float, int, Callable[[str], None]], tuple[MeasuredFrontier, str]]


@dataclass(frozen=True)
class StoredCapture:
    """Stored capture for another reconstruction: lit and dark frame (TIFF) and the calibration of the head."""

    raw_tiff: bytes
    dark_tiff: bytes
    calibration: Calibration
    simulated: bool


@dataclass(frozen=True)
class ExplorerState:
    """Last measurement (None before it), selected time budget, progress of a running computation, and last error.

    `shipped`: the measurement was made on another computer, which it names. `paces_s`: time budgets in seconds by name.
    `busy`: a computation is running, with the progress text `progress`. `scene`: name of the simulated scene.
    """

    measured: MeasuredFrontier | None
    shipped: bool
    pace: Pace
    paces_s: Mapping[Pace, float]
    busy: bool
    progress: str
    scene: str
    problem: DiffuscopeError | None


class AccuracyExplorer:
    """Measurement of accuracy against time, and reconstruction by recipe; the mutex `_busy` admits one at a time.

    `plans`: folder of the FFT plans. `publish`: publisher of the event bus. `scene`: head file with the simulated eye.
    """

    def __init__(
        self,
        folder: Path,
        plans: Path,
        clock: Clock,
        spec: InstrumentSpec,
        publish: Callable[..., None],
        measure: Measure,
        scene: Path = SCENE,
    ) -> None:
        self.folder, self.plans, self.clock, self.publish = folder, plans, clock, publish
        self._measure_frontier = measure
        self._scene = simulated_head(spec, load_head(scene))
        self._is_shipped_head = spec == load_head(SHIPPED_HEAD)
        self._busy = Lock()
        self._message = ""
        self._problem: DiffuscopeError | None = None

    @property
    def pace(self) -> Pace:
        """The selected time budget by name; `standard` without a selection."""
        pace = _read_json(self.folder / "choice.json").get("pace")
        return next((name for name in PACES_S if name == pace), "standard")

    @property
    def budget_s(self) -> float:
        """The selected time budget, seconds."""
        return PACES_S[self.pace]

    def choose(self, pace: Pace) -> None:
        """Select a time budget for the following captures, and log it."""
        log.info("time budget set to %g s (%s; before: %s)", PACES_S[pace], pace, self.pace)
        _write(self.folder / "choice.json", json.dumps({"pace": pace}, indent=1))

    def state(self) -> ExplorerState:
        """Return the last measurement, the selected time budget, the progress and the last error."""
        folder = self._measured_folder()
        return ExplorerState(
            None if folder is None else _measured_in(folder),
            folder == SHIPPED,
            self.pace,
            PACES_S,
            self._busy.locked(),
            self._message,
            self._scene.name,
            self._problem,
        )

    def plot(self) -> str:
        """Return the plot of the measurement as SVG; RecordNotFound before it."""
        folder = self._measured_folder()
        if folder is None:
            raise RecordNotFound("accuracy against time is not measured on this device", "Measure it first.")
        return (folder / "frontier.svg").read_text(encoding="utf-8")

    def measure(self) -> None:
        """Start the measurement of every method in a background thread and return; Busy during another computation."""
        self._acquire()
        self._problem = None
        Thread(target=self._run_measurement, name="frontier", daemon=True).start()

    def _run_measurement(self) -> None:
        try:
            frontier, plot = run_in_subprocess(
                self._measure_frontier, self._scene, self.plans, BUDGET_S, REPEATS, report=self._report
            )
            write_measurement(self.folder, frontier, plot, self.clock)
        except DiffuscopeError as error:
            log.warning("measurement of accuracy against time failed: %s", error)
            self._problem = error
        finally:
            self._end()

    def reconstruct(self, kept: StoredCapture, recipe: Recipe) -> bytes:
        """Return the picture of a capture reconstructed by `recipe`, as PNG cropped to the illuminated field.

        Raises Busy during another computation, SettingError for an unknown method or bin.
        """
        if recipe.method not in METHODS or recipe.bin not in range(1, LARGEST_BIN + 1):
            raise SettingError(f"there is no method {recipe.method} at bin {recipe.bin}")
        self._acquire()
        try:
            made: bytes = run_in_subprocess(_reconstruct, kept, recipe, self.plans, report=self._report)
        finally:
            self._end()
        return made

    def _acquire(self) -> None:
        if not self._busy.acquire(blocking=False):
            raise Busy("another picture or measurement is computed", "Wait until it is done.")

    def _end(self) -> None:
        self._report("")  # first: a computation that begins at once keeps its own text
        self._busy.release()

    def _report(self, message: str) -> None:
        self._message = message
        self.publish("accuracy", progress=message)

    def _measured_folder(self) -> Path | None:
        """Return the folder of the last measurement, else of the shipped one if it is of this head."""
        if (self.folder / "frontier.svg").is_file() and _measured_in(self.folder) is not None:
            return self.folder
        return SHIPPED if self._is_shipped_head else None


def write_measurement(folder: Path, frontier: MeasuredFrontier, plot: str, clock: Clock) -> None:
    """Write a measurement with its plot (SVG) and the time of `clock` as the last one of a folder."""
    measured = frontier.model_copy(update={"measured_at": clock.wall().isoformat()})
    _write(folder / "frontier.svg", plot)
    _write(folder / "frontier.json", json.dumps(measured.model_dump(mode="json"), indent=1))


def _write(path: Path, content: str) -> None:
    atomic_io.make_folder(path.parent)
    atomic_io.write_atomically(path, content.encode())


def _measured_in(folder: Path) -> MeasuredFrontier | None:
    stored = _read_json(folder / "frontier.json")
    try:
        return MeasuredFrontier.model_validate(stored) if stored else None
    except ValidationError:
        log.warning("%s is not a measurement; measure again", folder / "frontier.json")
        return None


def _read_json(path: Path) -> Mapping[str, JsonValue]:
    try:
        read = json.loads(path.read_bytes())
    except FileNotFoundError:
        return {}
    except ValueError:
        log.warning("%s is not valid JSON; measure or choose again", path)
        return {}
    return read if isinstance(read, dict) else {}


def simulated_head(spec: InstrumentSpec, scene: InstrumentSpec) -> InstrumentSpec:
    """Return a simulated head: camera and optics of `spec`, eye of `scene`; `scene` itself if `spec` has no optics."""
    if spec.optics is None:
        return scene
    camera = spec.camera.model_copy(update={"backend": "sim"})
    return scene.model_copy(update={"name": f"{scene.name} on {spec.name}", "camera": camera, "optics": spec.optics})


def _reconstruct(kept: StoredCapture, recipe: Recipe, plans: Path, report: Callable[[str], None]) -> bytes:
    (counts, _) = picture_files.read_raw_tiff(kept.raw_tiff)
    (dark, _) = picture_files.read_raw_tiff(kept.dark_tiff)
    shape = (counts.shape[0], counts.shape[1])
    report("making plans")
    steps = (recipe,)
    maker = Reconstructor(kept.calibration, shape, Planner(plans), SystemClock(), steps, refract=False)
    report("computing")
    made = maker(counts, dark, simulated=kept.simulated)
    shown = made.picture[field_box(kept.calibration, shape)]
    return picture_files.to_png(shown, made.simulated, f"{recipe.method}, bin {recipe.bin}")
