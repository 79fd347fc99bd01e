"""Second-order total variation, a prior compared with the default by the lesions' bench; a textbook version.

    min_x  1/2 sum W (y - b - crop(h * x))^2 + tau sum |D2 x|,   x >= 0 in the field, 0 outside

D2 has the second differences (xx, yy, sqrt 2 xy), so slopes cost nothing and no flat patches with edges appear.
Weights, splits, tau and start are those of `TotalVariation`, with |D2|^2 = |D|^4 in the place of |D|^2.
"""

import numpy as np
from scipy import fft

from device.recon.methods import METHODS, Method
from device.recon.model.preprocessing import Linear
from device.recon.solvers.tv import KAPPA, RHO, EvidenceWiener
from device.values import Image

SECOND_ORDER = "second-order"
MIXED = 2**0.5


def second_differences(x: Image) -> Image:
    """Return D2 x, periodic, (3, rows, cols)."""
    right, down = np.roll(x, -1, 1), np.roll(x, -1, 0)
    across, along = right - 2 * x + np.roll(x, 1, 1), down - 2 * x + np.roll(x, 1, 0)
    return np.stack([across, along, MIXED * (np.roll(right, -1, 0) - right - down + x)]).astype(np.float32)


def adjoint(z: Image) -> Image:
    """Return the adjoint of D2, (rows, cols), of a field (3, rows, cols)."""
    across, along, mixed = z
    left = np.roll(mixed, 1, 1)
    total = np.roll(across, -1, 1) - 2 * across + np.roll(across, 1, 1)
    total += np.roll(along, -1, 0) - 2 * along + np.roll(along, 1, 0)
    return np.asarray(total + MIXED * (np.roll(left - mixed, 1, 0) - left + mixed), np.float32)


class SecondOrderTotalVariation(EvidenceWiener):
    """ADMM from the Wiener solution; the attributes are named as the symbols of the docstring above."""

    kappa = KAPPA

    def start(self, frame: Linear) -> None:
        """Compute the Wiener solution, weights, tau and penalties."""
        super().start(frame)
        model, grid, noise = self.model, self.model.grid, self.detail.noise
        typical = 1 / noise.variance_dn2(0.5 * float(frame.y.max()))
        power = np.abs(model.otf) ** 2
        self.curvature = (model.row_gradient[:, None] + model.col_gradient[None]) ** 2
        weights = np.full(power.shape, 2.0)
        weights[:, 0] = 1
        dual = power / np.where(self.curvature > 0, self.curvature, np.inf) * weights / grid.size
        rejected = self.detail.reg / (power + self.detail.reg)
        self.tau = self.kappa * float(np.sqrt(typical * np.vdot(dual, rejected**2)))
        self.rho, self.r = max(RHO * self.tau / max(abs(self.level), 1e-12), 1e-30), typical
        self.hx = fft.irfft2(fft.rfft2(self.x) * model.otf, grid.shape)
        self.w = np.zeros(grid.shape, np.float32)
        seen_dn = np.maximum(self.hx[grid.slices], 0)
        self.w[grid.slices] = frame.good / (noise.per_dn * seen_dn + noise.floor_dn2)
        self.wy = np.zeros(grid.shape, np.float32)
        self.wy[grid.slices] = self.w[grid.slices] * (frame.y - self.stray)
        self.u = np.zeros((3, *grid.shape), np.float32)
        self.u_w, self.a = (np.zeros(grid.shape, np.float32) for _ in range(2))

    def step(self) -> None:
        """Run one ADMM round."""
        model, shape = self.model, self.model.grid.shape
        g = second_differences(self.x) + self.u
        z = np.maximum(0, 1 - self.tau / self.rho / np.sqrt((g**2).sum(axis=0) + 1e-30)) * g
        self.u = g - z
        q = self.x + self.u_w
        w = np.maximum(q, 0) * model.mask
        self.u_w = q - w
        picture = adjoint(z - self.u) + w - self.u_w
        p = self.hx + self.a
        v = (self.wy + self.r * p) / (self.w + self.r)
        self.a = p - v
        weight = self.r * np.abs(model.otf) ** 2 + self.rho * (self.curvature + 1)
        x = self.r * model.otf.conj() * fft.rfft2(v - self.a) + self.rho * fft.rfft2(picture)
        x /= weight
        self.x[:] = fft.irfft2(x, shape)
        self.hx = fft.irfft2(x * model.otf, shape)


def with_second_order(kappa: float = KAPPA) -> dict[str, Method]:
    """Return the built-in methods and this one."""
    solver = type("Solver", (SecondOrderTotalVariation,), {"kappa": kappa})
    built = Method(
        SECOND_ORDER,
        "second-order total variation",
        lambda model, calibration, planner: solver(model, calibration),
        start_pairs=METHODS["variation"].start_pairs,
        round_pairs=METHODS["variation"].round_pairs,
        rounds=METHODS["variation"].rounds,
        images=METHODS["variation"].images,
    )
    return {**METHODS, SECOND_ORDER: built}
