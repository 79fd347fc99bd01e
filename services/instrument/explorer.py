"""Accuracy against time on this very device: measured when a technician asks, seen on a capture, chosen as a time.

    FOLDER/frontier.json    what was measured last (frontier.py)
    FOLDER/choice.json      how long a picture may take: quick, standard or best

Nothing here touches the head: a scene like it is simulated, and captures are made again from what was kept of them.
"""

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from device.calibration.archive import write_synced
from device.clock import Clock, SystemClock
from device.errors import Busy, DiffuscopeError, SettingError
from device.recon.methods import METHODS
from device.recon.model import field_box
from device.recon.plan import Planner
from device.recon.reconstructor import Recipe, Reconstructor
from device.spec import InstrumentSpec, load_head
from device.values import Calibration
from services.instrument import frontier
from services.instrument.apart import apart
from services.instrument.pace import PACES_S, Pace
from services.records import picture

log = logging.getLogger(__name__)

SCENE = Path(__file__).parents[2] / "device" / "sim" / "scenes" / "diabetic.toml"
BUDGET_S = 0.26  # the paper's: it marks where this device's own choice stands
REPEATS = 5


@dataclass(frozen=True)
class Kept:
    """A capture to be made again: its frames as they were kept (TIFF), and what the head was calibrated as."""

    raw_tiff: bytes
    dark_tiff: bytes
    calibration: Calibration
    simulated: bool


class Explorer:
    """What accuracy costs in time on this device; one computation at a time."""

    def __init__(
        self, folder: Path, plans: Path, clock: Clock, spec: InstrumentSpec, tell: Callable[..., None],
        scene: Path = SCENE,
    ) -> None:  # fmt: skip
        self.folder, self.plans, self.clock, self.tell = folder, plans, clock, tell
        self._like = like(spec, load_head(scene))
        self._busy = Lock()
        self._said = ""
        self._problem: DiffuscopeError | None = None

    @property
    def pace(self) -> Pace:
        """What was chosen; at first standard."""
        said = self._read("choice.json").get("pace", "standard")
        return said if said in PACES_S else "standard"

    @property
    def budget_s(self) -> float:
        """How long a picture may take by that choice."""
        return PACES_S[self.pace]

    def choose(self, pace: Pace) -> None:
        """From the next press on; logged."""
        log.info("pictures may take %g s from now on (%s; before: %s)", PACES_S[pace], pace, self.pace)
        self._write("choice.json", {"pace": pace})

    def state(self) -> dict[str, Any]:
        """What was measured, what is chosen, and how a measurement goes."""
        problem = self._problem
        return {
            "measured": self._read("frontier.json") or None, "pace": self.pace, "paces_s": PACES_S,
            "busy": self._busy.locked(), "said": self._said, "scene": self._like.name,
            "problem": None if problem is None else {"code": problem.code, "message": problem.message,
                                                    "remedy": problem.remedy},
        }  # fmt: skip

    def measure(self) -> None:
        """Begin to measure every method on this device; Busy while something is computed."""
        self._occupy()
        self._problem = None
        Thread(target=self._measured, name="frontier", daemon=True).start()

    def _measured(self) -> None:
        try:
            found = apart(_frontier, self._like, self.plans, say=self._say)
            self._write("frontier.json", found | {"measured_at": self.clock.wall().isoformat()})
        except DiffuscopeError as error:
            log.warning("frontier: %s", error)
            self._problem = error
        finally:
            self._busy.release()
            self._say("")

    def picture(self, kept: Kept, recipe: Recipe) -> bytes:
        """A capture as that recipe makes it, as PNG; Busy, or SettingError for a method that is not there."""
        if recipe.method not in METHODS or recipe.bin not in range(1, frontier.MOST_BIN * 4 + 1):
            raise SettingError(f"there is no method {recipe.method} at bin {recipe.bin}")
        self._occupy()
        try:
            made: bytes = apart(_made_again, kept, recipe, self.plans, say=self._say)
        finally:
            self._busy.release()
        return made

    def _occupy(self) -> None:
        if not self._busy.acquire(blocking=False):
            raise Busy("another picture or measurement is computed", "Wait until it is done.")

    def _say(self, said: str) -> None:
        self._said = said
        self.tell("explorer", said=said)

    def _read(self, name: str) -> dict[str, Any]:
        path = self.folder / name
        try:
            read = json.loads(path.read_bytes())
        except FileNotFoundError:
            return {}
        except ValueError:
            log.warning("%s cannot be read; measure or choose again", path)
            return {}
        return read if isinstance(read, dict) else {}

    def _write(self, name: str, content: dict[str, Any]) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        part = self.folder / f".{name}"
        write_synced(part, json.dumps(content, indent=1).encode())
        part.replace(self.folder / name)


def like(spec: InstrumentSpec, scene: InstrumentSpec) -> InstrumentSpec:
    """A simulated head with the camera and the optics of `spec`, before the eye of `scene`."""
    if spec.optics is None:
        return scene
    camera = spec.camera.model_copy(update={"backend": "sim"})
    return scene.model_copy(update={"name": f"{scene.name} on {spec.name}", "camera": camera, "optics": spec.optics})


def _frontier(spec: InstrumentSpec, plans: Path, say: Callable[[str], None]) -> dict[str, Any]:
    return frontier.measured(frontier.scene_case(spec), plans, BUDGET_S, REPEATS, say)


def _made_again(kept: Kept, recipe: Recipe, plans: Path, say: Callable[[str], None]) -> bytes:
    (counts, _), (dark, _) = picture.read_raw_tiff(kept.raw_tiff), picture.read_raw_tiff(kept.dark_tiff)
    shape = (counts.shape[0], counts.shape[1])
    say("making plans")
    steps = (recipe,)
    maker = Reconstructor(kept.calibration, shape, Planner(plans), SystemClock(), steps, refract=False)
    say("computing")
    made = maker(counts, dark, simulated=kept.simulated)
    shown = made.picture[field_box(kept.calibration, shape)]
    return picture.to_png(shown, made.simulated, f"{recipe.method}, bin {recipe.bin}")
