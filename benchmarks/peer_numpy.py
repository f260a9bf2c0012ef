"""The control step in plain NumPy, one arm at a time, as a careful engineer writes it from the paper without torch.

The same step as the toolkit's controller with poses and the estimator-aware law: algorithm 2 by damped least squares
with a step bound, Eq. (15) with normalisation and the reach, Eq. (16), Eq. (49). Savitzky-Golay by `numpy.polyfit`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
HANGING = np.diag([1.0, -1.0, -1.0])


def arc(x: float, y: float) -> tuple[Array, Array, Array, Array]:
    """R, u, W and U of a section: rotation, chord, and their derivatives by (x, y); see `model.arc`."""
    square = x * x + y * y
    D = np.sqrt(square)
    if D < 1e-3:
        c1, c2, c3, c4 = 1 - square / 6, 0.5 - square / 24, 1 / 6 - square / 120, 1 / 24 - square / 720
    else:
        c1, c2, c3 = np.sin(D) / D, (1 - np.cos(D)) / square, (D - np.sin(D)) / (square * D)
        c4 = (0.5 - c2) / square
    a1, b1 = c3 - c2, 2 * c4 - c3
    R = np.array([[1 - x * x * c2, -x * y * c2, x * c1], [-x * y * c2, 1 - y * y * c2, y * c1],
                  [-x * c1, -y * c1, 1 - square * c2]])  # fmt: skip
    u = np.array([x * c2, y * c2, c1])
    W = np.array([[-x * y * c3, -c1 - y * y * c3], [c1 + x * x * c3, x * y * c3], [-y * c2, x * c2]])
    U = np.array([[c2 + x * x * b1, x * y * b1], [x * y * b1, c2 + y * y * b1], [x * a1, y * a1]])
    return R, u, W, U


def forward(q: Array, lengths: Array, X: float, L0: Array) -> tuple[Array, Array, Array]:
    """Rotation, position and the twist columns (6, 9), world axes, of the material point at abscissa X."""
    ends = np.cumsum(L0)
    R, p = HANGING.copy(), np.zeros(3)
    blocks, at = [], []
    for i in range(len(L0)):
        start = ends[i] - L0[i]
        s = 1.0 if i == len(L0) - 1 and ends[i] <= X else float(np.clip((X - start) / L0[i], 0.0, 1.0))
        x, y, dL = q[3 * i : 3 * i + 3]
        E, u, W, U = arc(s * x, s * y)
        length = s * (lengths[i] + dL)
        p = p + R @ (length * u)
        blocks.append((R @ W * s, R @ U * (length * s), R @ u * s))
        at.append(p)
        R = R @ E
    J = np.zeros((6, q.size))
    for i, (spin, bend, chord) in enumerate(blocks):
        J[:3, 3 * i : 3 * i + 2] = spin
        J[3:, 3 * i : 3 * i + 2] = bend + np.cross(spin.T, p - at[i]).T
        J[3:, 3 * i + 2] = chord
    return R, p, J


def log(R: Array, p: Array) -> Array:
    """Twist of a rigid motion."""
    cos = np.clip((np.trace(R) - 1) / 2, -1.0, 1.0)
    angle = np.arccos(cos)
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    w = 0.5 * skew if angle < 1e-6 else angle / (2 * np.sin(angle)) * skew
    half = angle / 2
    factor = 1 / 12 if angle < 1e-4 else (1 - half / np.tan(half)) / angle**2
    return np.concatenate((w, p - 0.5 * np.cross(w, p) + factor * np.cross(w, np.cross(w, p))))


def left_jacobian_inverse(V: Array) -> Array:
    """Of SE(3) at a twist (angular, linear), by its series: residuals are small."""
    W, U = (np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) for x, y, z in (V[:3], V[3:]))
    ad = np.block([[W, np.zeros((3, 3))], [U, W]])
    square = ad @ ad
    return np.eye(6) - 0.5 * ad + square / 12 - square @ square / 720


class Controller:
    """The step with its state.

    Args:
        q: (9,) first configuration.
        pi_hat: (3,) first estimates, m.
        sensors: (3,) abscissae, m.
        B_rows: (9,) angles of the tendons, rad.
    """

    def __init__(self, q: Array, pi_hat: Array, sensors: Sequence[float], angles: Array, offset: float) -> None:
        self.q_bar, self.q_d, self.pi_hat = q.copy(), q.copy(), pi_hat.copy()
        self.qdot_bar = np.zeros_like(q)
        self.sensors, self.angles, self.offset = sensors, angles, offset
        self.samples: list[tuple[float, Array]] = []
        self.time = 0.0

    def residual(self, q: Array, T: Array) -> tuple[Array, Array]:
        """Stacked twists and body Jacobians."""
        twists, rows = [], []
        for X, seen in zip(self.sensors, T, strict=True):
            R, p, J = forward(q, self.pi_hat, X, self.pi_hat)
            V = log(R.T @ seen[:3, :3], R.T @ (seen[:3, 3] - p))
            twists.append(V)
            rows.append(left_jacobian_inverse(V) @ np.vstack((R.T @ J[:3], R.T @ J[3:])))
        return np.concatenate(twists), np.vstack(rows)

    def estimate(self, T: Array) -> Array:
        """Algorithm 2, at most 7 iterations; returns the body Jacobians at the end."""
        damping = 1e-8
        V, J = self.residual(self.q_bar, T)
        for _ in range(7):
            step = np.linalg.solve(J.T @ J + damping * np.eye(J.shape[1]), J.T @ V)
            step /= max(1.0, np.max(np.abs(step) / np.tile([0.6, 0.6, 0.1], 3)))
            later, J_later = self.residual(self.q_bar + step, T)
            settled = np.max(np.abs(step)) < 5e-6
            if settled or later @ later < V @ V:
                self.q_bar, V, J = self.q_bar + step, later, J_later
                damping = max(0.1 * damping, 1e-14)
            else:
                damping *= 10.0
            if settled or (
                np.abs(V.reshape(-1, 6)[:, 3:]).max() < 1e-4 and np.abs(V.reshape(-1, 6)[:, :3]).max() < 5e-3
            ):
                break
        return J

    def step(self, T: Array, time: float, x_d: Array, xdot_d: Array) -> Array:
        """One control step; returns the tendon length changes (9,), m."""
        dt = min(max(time - self.time, 0.0), 0.1)
        J_b = self.estimate(T)
        self.samples = [*self.samples[-14:], (time, self.q_bar)]
        if len(self.samples) > 2:
            stamps = np.array([t - time for t, _ in self.samples])
            fit = np.polyfit(stamps, np.array([q for _, q in self.samples]), 2)
            self.qdot_bar = fit[1]
        tip = float(np.sum(self.pi_hat))
        _, _, J = forward(self.q_bar, self.pi_hat, tip, self.pi_hat)
        J = J[3:]
        e = x_d - T[-1, :3, 3]
        dL = self.q_bar[2::3]
        descent = np.zeros(9)
        descent[2::3] = -0.2 * dL / np.sqrt(dL @ dL + 5e-3**2)
        pinv = J.T @ np.linalg.inv(J @ J.T + 1e-6 * np.eye(3))
        qdot = pinv @ (xdot_d + 1.8 * e - J @ descent) + descent
        self.q_d = self.q_d + dt * qdot
        self.q_d[2::3] = np.clip(self.q_d[2::3], -0.08, 0.08)
        # The total regressor by central differences of J qdot along q and along each parameter.
        Y = self.regressor(J_b)
        velocity = -(Y.T @ e) / (1.0 + 10.0 * np.sum(Y * Y))
        self.pi_hat = self.pi_hat + dt * velocity
        self.pi_hat = self.pi_hat + max(0.0, 0.6 - np.sum(self.pi_hat)) / 3.0
        self.time = time
        return self.tendons(self.q_d)

    def regressor(self, J_b: Array) -> Array:
        """Y_total (3, 3): d(J qdot)/d pi with the configuration following the parameters."""
        h = 1e-6
        qdot, columns = self.qdot_bar, []
        follow = np.zeros((9, 3))
        for i in range(3):
            moved = self.pi_hat.copy()
            moved[i] += h
            shifts = []
            for X in self.sensors:
                R, p, _ = forward(self.q_bar, self.pi_hat, X, self.pi_hat)
                R2, p2, _ = forward(self.q_bar, moved, X, moved)
                shifts.append(log(R.T @ R2, R.T @ (p2 - p)) / h)
            follow[:, i] = -np.linalg.lstsq(J_b, np.concatenate(shifts), rcond=1e-10)[0]
        for i in range(3):
            moved = self.pi_hat.copy()
            moved[i] += h
            J2 = forward(self.q_bar + h * follow[:, i], moved, float(np.sum(moved)), moved)[2][3:]
            J1 = forward(self.q_bar, self.pi_hat, float(np.sum(self.pi_hat)), self.pi_hat)[2][3:]
            columns.append((J2 - J1) @ qdot / h)
        return np.stack(columns, axis=1)

    def tendons(self, q: Array) -> Array:
        """B^T q with anchors at the sensors' abscissae, each tendon through all sections before its own."""
        ends = np.cumsum(self.pi_hat)
        y = np.zeros(len(self.angles))
        for k, angle in enumerate(self.angles):
            anchor = self.sensors[k // 3]
            for i in range(3):
                share = float(np.clip((anchor - ends[i] + self.pi_hat[i]) / self.pi_hat[i], 0.0, 1.0))
                x, w, dL = q[3 * i : 3 * i + 3]
                y[k] += share * (-self.offset * np.cos(angle) * x - self.offset * np.sin(angle) * w + dL)
        return y


def prepared(inputs: list[tuple[Any, ...]], sensors: Sequence[float], angles: Array, offset: float) -> tuple[
    Controller, list[tuple[Array, float, Array, Array]]
]:  # fmt: skip
    """The controller at the start of the toolkit's recorded steps, and these steps as arrays."""
    state = inputs[0][0]
    controller = Controller(state.q_bar.numpy(), state.pi_hat.numpy(), sensors, angles, offset)
    given = [(m.T.numpy(), float(m.time), t.x_d.numpy(), t.xdot_d.numpy()) for _, m, t in inputs]
    return controller, given
