"""What hangs on the arm, and what touches it where: `python examples/contact_force.py`.

The arm knows its tendons' tensions and sees three poses, both with noise. First the tip is weighed. Then something
pushes the arm at a place that nobody told: the force is estimated for every place, and the place is where the balance
of forces leaves least. The true arm has six sections and more, the model three, whose curvature varies along them. What
the unloaded arm shows in the same posture is taken off first, as a scale is tared.

Prints truth and estimate, and writes runs/contact_force.png; `--quick` draws nothing. Try `--place 0.1`: near
the base a force moves little, and the interval says so; or `--force 0.2`, which the noise hides.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch import PCCBackbone, SoftArmDynamics, StateFeedback
from apcc_torch.estimation.contact import Contact, ContactSearch
from apcc_torch.estimation.external_force import BalanceNoise, ForceBalance, Tare, tare
from apcc_torch.estimation.posture import Posture
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import HANGING
from apcc_torch.model.loads import Loads
from apcc_torch.model.static_body import StaticBody
from apcc_torch.model.statics import equilibrium
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import rack_routing
from apcc_torch.report import style
from apcc_torch.report.backbone_drawing import draw_base, draw_markers
from apcc_torch.report.space import Camera, Space, bounding_box
from apcc_torch.simulation.sensors import PoseSensors

D = torch.float64
BASE = torch.tensor(HANGING, dtype=D)
RACKS = torch.tensor([0.105, 0.36, 0.60], dtype=D)
LENGTHS = torch.tensor([0.105, 0.255, 0.240], dtype=D)
ROUTING = rack_routing(RACKS)
DENSITY, EA, EI = 1.0 / 0.6, 10.0, 0.0778
HELD = torch.tensor([-2.0, 3.0, -1.0, -21.0, 12.0, 8.0, -24.0, -3.0, 26.0], dtype=D) * 1e-3
"""Length changes at which the tendons are held, m."""
DIRECTION = torch.tensor([-0.75, 0.35, 0.56], dtype=D)
READINGS = 20
READING = BalanceNoise(position=2e-4, angle=8.7e-3, tension=0.05)
NOISE = BalanceNoise(*(value / READINGS**0.5 for value in READING[:3]))
"""Of the mean of the readings."""
BEND_ERROR, LENGTH_ERROR = 0.01, 0.1
"""How wrong the tared model is taken to be, N m and N."""
PAYLOAD = 0.25


class Arm(NamedTuple):
    """The true arm at rest: q, its sections' lengths (m), and what is seen of it: T (K, 3, 4, 4) and u (9,)."""

    q: Tensor
    lengths: Tensor
    T: Tensor
    u: Tensor


def at_rest(place: float, force: Tensor, payload: float, generator: torch.Generator) -> Arm:
    """The arm with its tendons held, a payload at its tip and a force (3,) at a place, m."""
    ends = torch.tensor(sorted({0.0525, 0.105, 0.2325, 0.36, 0.48, 0.60, place}), dtype=D)
    lengths = ends.diff(prepend=torch.zeros(1, dtype=D))
    axial, bending = scaled_stiffness(lengths)
    dynamics = SoftArmDynamics(lengths, DENSITY * lengths, axial, bending, base_rotation=BASE)
    touch = torch.zeros(len(lengths), 6, dtype=D)
    touch[int((ends - place).abs().argmin()), 3:] = force
    rest = equilibrium(
        dynamics, routing=ROUTING, tendon_lengths=HELD, payload=payload, loads=Loads(section_wrenches=touch),
        tolerance=1e-9,
    )  # fmt: skip
    if rest.u is None or not bool(rest.converged):
        raise SystemExit("the arm finds no rest under this force")
    T = PCCBackbone(len(lengths), BASE).pose(rest.q, lengths, *decouple(RACKS, lengths))
    sensors = PoseSensors(READING.position, READING.angle)
    repeated = T.expand(READINGS, *T.shape)
    _, seen, _ = sensors(sensors.initial_state(repeated), repeated, generator)
    u = rest.u + NOISE.tension * torch.randn(9, dtype=D, generator=generator)
    return Arm(rest.q, lengths, seen, u)


def posture(balance: ForceBalance, arm: Arm) -> Posture:
    """What the model makes of the readings."""
    q = torch.zeros(balance.body.backbone.n, dtype=D)
    for _ in range(2):  # from the straight arm to the shape, then on
        q = balance.feedback(q, LENGTHS, arm.T).q_bar.mean(0)
    return Posture(q, LENGTHS, arm.u)


def draw(arm: Arm, place: float, force: Tensor, found: Contact, curve: tuple[Tensor, Tensor], file: Path) -> Path:
    """The arm with both forces, and how badly every place explains what is seen."""
    figure = style.new_figure(10.0, 5.2)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.6))
    backbone = PCCBackbone(len(arm.lengths), BASE)
    shape = style.values(backbone.points(arm.q, arm.lengths, 121))

    def at(X: Tensor) -> style.Array:
        return style.values(backbone.pose(arm.q, arm.lengths, *decouple(X.reshape(-1), arm.lengths))[..., :3, 3])

    estimated = found.estimate.value
    arrows = [(torch.tensor(place, dtype=D), force, style.TRUE), (found.abscissa, estimated, style.VERMILION)]
    ends = [at(X)[0] - 0.1 * style.values(f) for X, f, _ in arrows]
    box = bounding_box(shape, *(end[None] for end in ends), margin=0.05)
    space = Space(left, box, Camera(12.0, -70.0), frame=False)
    draw_base(space)
    space.plot(shape, color=style.EDGE, linewidth=7.0, solid_capstyle="round")
    likely = torch.linspace(float(found.interval[0]), float(found.interval[1]), 30, dtype=D)
    space.plot(at(likely), color=style.faded(style.VERMILION, 0.5), linewidth=7.0)
    draw_markers(space, at(RACKS))
    for (X, _, color), end in zip(arrows, ends, strict=True):
        tail, head = space.camera.project(end), space.camera.project(at(X)[0])
        look = {"arrowstyle": "-|>", "color": color, "linewidth": 2.4, "mutation_scale": 18.0}
        left.annotate("", head, tail, arrowprops=look, zorder=8)
    left.set_title("true (grey), found (orange)", fontsize=style.TITLE, color=style.INK, loc="left")
    X, misfit = (style.values(v) for v in curve)
    right.plot(1e2 * X, misfit, color=style.VERMILION, linewidth=style.LINE, label="misfit of the best force there")
    right.axvline(1e2 * place, color=style.TRUE, linewidth=style.LINE, linestyle=":", label="true place")
    low, high = (1e2 * float(v) for v in found.interval)
    right.axvspan(low, high, color=style.faded(style.VERMILION, 0.2), label="places not refuted")
    right.set_yscale("log")
    right.set_ylim(top=12.0 * float(misfit.max()))
    style.dress(right, "abscissa of the force (cm)", "misfit (chi-square)", "where it touches")
    style.legend(right, loc="upper right")
    return style.save_figure(figure, file, dpi=110)


def main() -> None:
    """Weighs, searches, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--force", type=float, default=1.5, help="size of the push, N (default: %(default)s)")
    parser.add_argument("--place", type=float, default=0.30, help="where, m from the base (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="no figure")
    options = parser.parse_args()
    if not 0.01 <= options.place <= 0.6 or options.force <= 0.0:
        parser.error("--place must be between 0.01 and 0.6 m, --force positive")
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(options.seed)
    force = options.force * DIRECTION / DIRECTION.norm()
    model = AffineBackbone(3, BASE)
    feedback = StateFeedback(model, RACKS, angular_weight=0.03, max_iterations=40)
    balance = ForceBalance(StaticBody(model, DENSITY, EA, EI), ROUTING, feedback, NOISE)
    with torch.no_grad():
        none = torch.zeros(3, dtype=D)
        empty = posture(balance, at_rest(options.place, none, 0.0, generator))
        spread = model.coordinates.per_unit(BEND_ERROR, LENGTH_ERROR, model.n, empty.q_bar)
        zero: Tare = tare(balance.imbalance(empty).unsqueeze(0), spread)
        weighed = balance.payload(posture(balance, at_rest(options.place, none, PAYLOAD, generator)), zero)
        arm = at_rest(options.place, force, 0.0, generator)
        seen = posture(balance, arm)
        found = ContactSearch(balance)(seen, zero)
        X = torch.linspace(0.05, 0.6, 111, dtype=D)
        misfit = torch.stack([balance.force(seen, at.reshape(1), zero).misfit for at in X])
    low, high = (1e2 * float(v) for v in found.interval)
    sure = "located" if bool(found.located) else "not located"
    error = float((found.estimate.value - force).norm())
    mass, give = 1e3 * float(weighed.value), 1e3 * float(weighed.deviation)
    print(f"payload      true {1e3 * PAYLOAD:.0f} g, estimated {mass:.1f} g, give or take {give:.1f} g")
    print(f"place        true {1e2 * options.place:.1f} cm, estimated {1e2 * float(found.abscissa):.1f} cm, between"
          f" {low:.1f} and {high:.1f} cm: {sure}")  # fmt: skip
    print(f"force        true {_listed(force)} N, estimated {_listed(found.estimate.value)} N, error {error:.2f} N")
    print(f"evidence     chi-square {float(found.evidence):.0f} for a contact, {float(found.gain):.0f} against the tip")
    if not options.quick:
        folder = Path("runs")
        print(draw(arm, options.place, force, found, (X, misfit), folder / "contact_force.png"))


def _listed(v: Tensor) -> str:
    return "(" + ", ".join(f"{float(x):.2f}" for x in v) + ")"


if __name__ == "__main__":
    main()
