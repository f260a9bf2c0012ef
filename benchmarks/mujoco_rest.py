"""An arm's model in MuJoCo at rest, found by Newton's method on MuJoCo's own forces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

LARGEST = 0.1
"""Largest change of a joint in one step, rad or m."""


class AtRest:
    """A model at rest under tensions and a force.

    Args:
        model: Of mujoco's, whose joints are hinges and slides.
        tensions: What its motors are told, N.
        force: (3,) at the site `tip`, N, world axes.

    Attributes:
        data: At rest.
        residual: Largest force that nothing balances, N m or N.
    """

    def __init__(self, model: Any, tensions: Sequence[float] = (), force: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        self.model, self.force = model, np.array(force, dtype=float)
        self.data = mujoco.MjData(model)
        if len(tensions):
            self.data.ctrl[:] = tensions
        q = self.data.qpos.copy()
        r = self.unbalanced(q)
        for _ in range(60):
            step = np.linalg.solve(self.slope(q, r), -r)
            step *= min(1.0, LARGEST / np.abs(step).max())
            for _ in range(12):
                ahead = self.unbalanced(q + step)
                if np.abs(ahead).max() < np.abs(r).max() or np.abs(step).max() > 0.99 * LARGEST:
                    break
                step *= 0.5
            q, r = q + step, ahead
            if np.abs(r).max() < 1e-10:
                break
        self.residual = float(np.abs(self.unbalanced(q)).max())

    def unbalanced(self, q: np.ndarray) -> np.ndarray:
        """Generalized forces (nv,) at rest at q."""
        data = self.data
        data.qpos[:], data.qvel[:] = q, 0.0
        mujoco.mj_forward(self.model, data)
        loaded = np.zeros(self.model.nv)
        body = int(self.model.site("tip").bodyid[0])
        mujoco.mj_applyFT(self.model, data, self.force, np.zeros(3), data.site("tip").xpos.copy(), body, loaded)
        return data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias + loaded

    def slope(self, q: np.ndarray, r: np.ndarray, step: float = 1e-6) -> np.ndarray:
        """Derivative (nv, nv) of `unbalanced` by q, by differences."""
        columns = [(self.unbalanced(q + step * e) - r) / step for e in np.eye(len(q))]
        return np.stack(columns, axis=-1)
