"""The solvers by name, with what they cost: asked before they run, printed by `diffuscope methods`."""

from dataclasses import dataclass

from device.errors import SettingError
from device.recon.closed import GRADIENT, TIKHONOV, Prior
from device.recon.plan import RealFft


@dataclass(frozen=True)
class Method:
    """A way from a frame to a picture: its name, one sentence, its cost in FFT pairs, and its prior."""

    name: str
    sentence: str
    fft_pairs: float
    prior: Prior

    def memory_bytes(self, shape: tuple[int, int], n: int = 1) -> int:
        """What its arrays take for a (rows, cols) sensor at bin n: dark, gain, picture, the plan and the model."""
        rows, cols = shape
        grid = (rows // n, cols // n)
        plan = RealFft.memory_bytes(grid)
        spectrum = 8 * grid[0] * (grid[1] // 2 + 1)
        return 3 * 4 * rows * cols + plan + spectrum + 5 * 4 * grid[0] * grid[1]


METHODS = {
    method.name: method
    for method in (
        Method("tikhonov", "the paper's closed form: periodic, L2 prior, mu by cross-validation", 1, TIKHONOV),
        Method(
            "gradient",
            "flat field taken out first, gradient prior with an L2 floor, mu by cross-validation",
            1,
            GRADIENT,
        ),
    )
}
DEFAULT = "gradient"


def method_named(name: str) -> Method:
    """The method of that name; SettingError lists what there is."""
    if name not in METHODS:
        raise SettingError(f"there is no method '{name}'", f"Choose one of: {', '.join(METHODS)}.")
    return METHODS[name]
