"""Every figure that a command writes, of small and of large arms, of one run and of many."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch
from matplotlib.figure import Figure
from torch import Tensor

from apcc_torch.evaluation.leaderboard import Score
from apcc_torch.identification.intervals import Interval
from apcc_torch.model.arm import Arm
from apcc_torch.model.dynamics_regressor import PARAMETERS
from apcc_torch.report import dynamic, hero, identification, kinematic, state_feedback
from apcc_torch.report.animation import Stage
from apcc_torch.report.arm_drawing import arm_figure
from apcc_torch.report.arm_scene import ArmScene
from apcc_torch.report.backbone_drawing import Snapshots, marker_positions, stroboscopic_figure
from apcc_torch.report.dynamic import RunCurves
from apcc_torch.report.dynamics_parameters import dynamics_parameter_figure
from apcc_torch.report.evaluation import COLORS, Leaderboard
from apcc_torch.report.laws import law_figure, regret_figure
from apcc_torch.report.overlay import Overlay, error_figure, overlay_figure
from apcc_torch.report.replay import REASON_COLORS, ReplayCurves, replay_figure
from apcc_torch.report.space import Camera
from apcc_torch.report.style import warned
from apcc_torch.report.trade_off import TradeOff, trade_off_figure
from apcc_torch.simulation.kinematic import KinematicLog

D = torch.float64
ARMS = {
    "6cm": Arm(name="small", lengths=[0.025, 0.035], tendon_offset=0.003, mass=0.012),
    "60cm": Arm(lengths=[0.105, 0.255, 0.24]),
    "3m": Arm(
        name="boom", lengths=[0.6] * 5, sensors=[0.6, 1.2, 1.8, 2.9], tendon_offset=0.06, mass=9.0, base="standing"
    ),
}
WARNING = "1 of 32 rows diverged: the model's shape is farther off than a quarter of the arm, from 3.2 s on"

Draw = Callable[[], Figure]


def log_of(arm: Arm, rows: int = 1, T: int = 61) -> KinematicLog:
    """An arm that bends more and more while its model comes to fit it; rows differ in where they begin."""
    backbone, pi = arm.backbone(), arm.rest_lengths()
    n = arm.n_sections
    time = torch.linspace(0.0, 20.0, T, dtype=D)
    share = (time / 20.0)[:, None, None]
    g = torch.Generator().manual_seed(1)
    bend = torch.rand(n, 3, generator=g, dtype=D) * torch.tensor([1.2, 0.8, 0.05], dtype=D)
    bend[:, 2] *= pi
    q_true = (share * bend.flatten()).expand(T, rows, 3 * n)
    off = 0.15 * pi * (2.0 * torch.rand(rows, n, generator=g, dtype=D) - 1.0)
    left = (1.0 - share) ** 3 + 1e-6
    pi_hat = pi + left * off
    x = backbone.tip(q_true, pi)
    error = left * torch.rand(rows, len(arm.sensor_places()), generator=g, dtype=D) * 0.1 * float(pi.sum())
    x_d = x + left * 0.2 * float(pi.sum())
    q_bar = q_true + 0.2 * left * torch.tensor([1.0, 1.0, 0.1 * float(pi.mean())], dtype=D).repeat(n)
    return KinematicLog(
        time, x_d, x, q_true, q_bar, torch.zeros_like(q_bar), pi_hat, error, 2 * error, torch.zeros(T, rows).long()
    )


def kinematic_drawings(arm: Arm, rows: int) -> dict[str, Draw]:
    """Figures 7 to 9."""
    return kinematic.kinematic_figures(log_of(arm, rows), arm.rest_lengths(), arm.sensor_places(), arm.backbone())


def shots_of(arm: Arm, moments: int = 6) -> Snapshots:
    """Moments of an arm's and its model's shape."""
    log = kinematic.select_row(log_of(arm), 0)
    at = torch.linspace(0, len(log.time) - 1, moments).long()
    backbone, pi, places = arm.backbone(), arm.rest_lengths(), arm.sensor_places()
    return Snapshots(
        log.time[at],
        backbone.points(log.q_true[at], pi, 60),
        backbone.points(log.q_bar[at], log.pi_hat[at], 60),
        marker_positions(backbone, log.q_true[at], pi, places),
        marker_positions(backbone, log.q_bar[at], log.pi_hat[at], places),
        log.x_d[-1],
    )


def curves_of(arm: Arm, rows: int, seed: int = 0, adapts: bool = True, size: float = 0.01, T: int = 61) -> RunCurves:
    """Curves that settle, of so many rows."""
    g = torch.Generator().manual_seed(seed)
    time = torch.linspace(0.0, 10.0, T, dtype=D)
    length, k, n = float(arm.rest_lengths().sum()), len(arm.sensor_places()), arm.n_sections
    fall = torch.exp(-time / 2.0)[:, None] + 1e-3

    def draw(*shape: int) -> Tensor:
        return (
            size
            * length
            * (0.3 + torch.rand(rows, *shape, generator=g, dtype=D))
            * fall.reshape(T, *(1,) * (len(shape) + 1))
        )

    pi_hat = arm.rest_lengths() + (draw(n) if adapts else torch.zeros(T, rows, n, dtype=D))
    return RunCurves(time, draw(), draw(), draw(k), draw(k), draw(), pi_hat, draw(), torch.zeros(T, rows).long())


def dynamic_drawings(arm: Arm, rows: int, size: float = 0.01) -> dict[str, Draw]:
    """Section V-B's."""
    pair = {"standard": curves_of(arm, rows, 1, False, 3 * size), "adaptive": curves_of(arm, rows, 2, True, size)}
    alone = {"adaptive": pair["adaptive"]}
    true = arm.rest_lengths()
    drawings: dict[str, Draw] = {
        "shape_error": lambda: dynamic.shape_error_figure(pair, "run II, held out"),
        "psi": lambda: dynamic.psi_figure(alone),
        "mapping_error": lambda: dynamic.mapping_error_figure(alone),
        "parameters": lambda: dynamic.parameter_figure(alone, true=true),
        "parameters_of_two": lambda: dynamic.parameter_figure(pair, "run I: parameter estimates", true),
        "sensors": lambda: dynamic.sensor_figure(alone),
        "sensors_of_two": lambda: dynamic.sensor_figure(pair, "single run of run II"),
        "end_effector": lambda: dynamic.end_effector_figure(pair),
        "warned": lambda: warned(dynamic.shape_error_figure(alone), WARNING),
    }
    return drawings


def stroboscopes(arm: Arm) -> dict[str, Draw]:
    """One controller's and two's, and a film's picture."""
    shots = shots_of(arm)
    readouts = {"shape error (mm)": torch.linspace(12.0, 0.3, 61), "end-effector error (mm)": torch.linspace(80, 1, 61)}
    return {
        "stroboscopic": lambda: stroboscopic_figure({"adaptive": shots}),
        "stroboscopic_of_two": lambda: stroboscopic_figure({"standard": shots, "adaptive": shots}, title="single run"),
        "film": lambda: Stage(shots_of(arm, 61), readouts, Camera(), WARNING).figure,
        "scene": partial(scene, arm),
        "new_arm": lambda: arm_figure(arm),
    }


def scene(arm: Arm) -> Figure:
    """An environment's picture."""
    shots = shots_of(arm)
    stage = ArmScene(float(arm.rest_lengths().sum()), arm.base == "standing")
    points = shots.true_points[-1]
    text = "t = 12.34 s   distance 0.1234 m   reward -0.123"

    class Picture:
        backbone, tendons, sensors, goal = points, points.expand(3, -1, -1) + 0.01, shots.true_markers[-1], points[-1]

    Picture.text = text  # type: ignore[attr-defined]
    stage.frame(Picture)  # type: ignore[arg-type]
    return stage.figure


def replay_drawings(sensors: int, sections: int) -> dict[str, Draw]:
    """A replayed recording, in which the gate holds back for every reason."""
    g = torch.Generator().manual_seed(0)
    time = torch.linspace(0.0, 60.0, 121, dtype=D)
    reason = torch.zeros(121, sensors, dtype=torch.int64)
    for i, code in enumerate(REASON_COLORS):
        reason[10 * i : 10 * i + 4, i % sensors] = code
    error = torch.rand(121, sensors, generator=g, dtype=D)
    q = torch.randn(121, 3 * sections, generator=g, dtype=D)
    curves = ReplayCurves(time, q, error, 0.1 * error, reason, reason.flip(0))
    names = [f"disk_{i + 1}" for i in range(sensors)]
    return {"replay": lambda: replay_figure(curves, names, "trunk, session 3, payload 100 g, 121 frames")}


def identification_drawings(parameters: int, length: float) -> dict[str, Draw]:
    """An identification's, with so many parameters."""
    g = torch.Generator().manual_seed(0)
    measured = length * torch.randn(200, 2, 3, generator=g, dtype=D)
    predicted = {
        name: measured + 0.05 * length / (k + 1) * torch.randn(200, 2, 3, generator=g, dtype=D)
        for k, name in enumerate(identification.LABELS)
    }
    names = ["rest length: section", "angle: tendon", "offset: tendon", "input scale: input", "base position:"]
    rows = [
        Interval(
            f"{names[i % 5]} {i // 5 + 1}", "m", 0.005, 0.006 + 1e-4 * i, 0.0055, 0.0065 + 2e-4 * i, 0.9 / (1 + i % 7)
        )
        for i in range(parameters)
    ]
    validation = torch.cat((torch.arange(10, 60), torch.arange(120, 160)))
    outcome = identification.Outcome(measured, predicted, validation, torch.randn(200, 6, generator=g, dtype=D), rows)
    return {
        f"identify_{name.removesuffix('.png')}": draw
        for name, draw in identification.identification_figures(outcome, 1e3 * length, "a nine-tendon arm").items()
    }


def evaluation_drawings() -> dict[str, Draw]:
    """A leaderboard's: many methods on one session, and fewer on three."""
    families = list(COLORS)
    few = [f"session with {grams} g" for grams in (0, 100, 200)]
    scores = [
        Score("motors", f"method number {m} with a long name", families[m % 3], session, body, (3.0 + m,), 1.0)
        for m in range(9)
        for session in few
        for body in (1, 2, 3)
    ]
    scores += [Score("one pose", f"method {m}", families[m % 3], "only", 2, (0.1 * 3**m,), 1.0) for m in range(12)]
    board = Leaderboard("Trunk under payload, three disks, twelve tendons", scores, [], [])
    return {f"evaluate_{name.removesuffix('.png')}": draw for name, draw in board.figures().items()}


def estimator_drawings(arm: Arm) -> dict[str, Draw]:
    """Experiment I's: figures 23 to 26."""
    g = torch.Generator().manual_seed(0)
    shots = shots_of(arm, 12)
    k = shots.true_markers.shape[1]
    cases = [(case, mode) for case in ("non-decoupled", "decoupled") for mode in ("pose", "position")]

    def run() -> state_feedback.Estimates:
        errors = [torch.rand(12, k, generator=g, dtype=D) for _ in range(2)]
        return {
            key: state_feedback.Estimate(shots.time, shots.model_points, shots.true_markers, *errors) for key in cases
        }

    runs = [run() for _ in range(3)]
    ends = {f"run_{r}": (shots.true_points[-1], shots.true_markers[-1]) for r in (4, 8)}
    return {
        "figure_23": lambda: state_feedback.four_panel_figure(runs[0], 6, "run 4"),
        "figure_25": lambda: state_feedback.final_figure(ends),
        "figure_26": lambda: state_feedback.norm_figure(runs),
    }


def comparison_drawings(arm: Arm) -> dict[str, Draw]:
    """Experiment II's and the benchmark's."""
    shots = shots_of(arm)
    moment = Overlay(shots.true_points[-1], shots.true_markers[-1], shots.model_points[-1], shots.true_points[-1, -1])
    pair = {"standard": curves_of(arm, 1), "adaptive": curves_of(arm, 1, 3)}
    laws = {f"the law number {i} with a name": (2.0 + 8.0 * i**1.5, 0.5 + 7.0 * i) for i in range(7)}
    off = {"standard": (4.2, 2.9), "adaptive": (2.9, 2.4)}
    fronts = {"standard": [(2.0, 20.0), (2.5, 3.0), (3.9, 2.1)], "adaptive": [(1.9, 2.2), (2.0, 2.1)]}
    trade = {name: TradeOff(fronts, 1.8, off) for name in ("run 1", "run 2", "robot 2")}
    theta = torch.tensor([[0.08, 10.0, 200.0, m, 1.0] for m in (0.0, 0.25, 0.5) * 10], dtype=D)
    found = theta * (
        1.0 + 0.2 * torch.rand(41, 30, len(PARAMETERS), generator=torch.Generator().manual_seed(0), dtype=D)
    )
    time = torch.linspace(0.0, 10.0, 41, dtype=D)
    poses = shots.true_points[[1, 3, 5]]
    models = {"fixed model": shots.model_points[[1, 3, 5]], "adapted model": poses}
    errors = {name: torch.linspace(0.02, 0.001, 61, dtype=D) for name in models}
    grid = {f"variation number {i}": (4.0 + i, 2.0 + 0.3 * i, 2.2 + 0.2 * i) for i in range(21)}
    clock = torch.linspace(0.0, 20.0, 61, dtype=D)
    return {
        "overlay": lambda: overlay_figure({"standard": moment, "adaptive": moment}),
        "errors": lambda: error_figure(pair, 1e-3),
        "laws": lambda: law_figure(dict.fromkeys(("run 1", "run 2", "robot 2"), laws), "held out, "),
        "regret": lambda: regret_figure(grid),
        "trade_off": lambda: trade_off_figure(trade),
        "dynamics": lambda: dynamics_parameter_figure(time, found, theta, "composite"),
        "hero": lambda: hero.hero_figure(
            poses, models, shots.true_markers[[1, 3, 5]], clock, errors, shots.true_points[:, -1]
        ),
    }


def everything() -> Iterator[tuple[str, Draw]]:
    """Name -> what draws it."""
    small, middle, large = ARMS.values()
    few = {name: draw for name, draw in dynamic_drawings(small, 1, 1e-5).items() if name in ("sensors", "parameters")}
    warnings = {
        f"warned {name}": partial(lambda draw: warned(draw(), WARNING), draw)
        for name, draw in {**kinematic_drawings(middle, 1), **stroboscopes(large)}.items()
        if name in ("figure_7.png", "stroboscopic")
    }
    sets: dict[str, dict[str, Draw]] = {
        **{
            f"{name}, kinematic": kinematic_drawings(arm, rows)
            for (name, arm), rows in zip(ARMS.items(), (1, 32, 2), strict=True)
        },
        **{f"{name}, shapes": stroboscopes(arm) for name, arm in ARMS.items()},
        "6cm, one run": few,
        "3m, 32 runs": dynamic_drawings(large, 32),
        "warnings": warnings,
        "comparisons": comparison_drawings(middle),
        "estimators, 6cm": estimator_drawings(small),
        "estimators, 3m": estimator_drawings(large),
        "1 section, 1 sensor": replay_drawings(1, 1),
        "5 sections, 7 sensors": replay_drawings(7, 5),
        "4 parameters of 6 cm": identification_drawings(4, 0.06),
        "60 parameters of 3 m": identification_drawings(60, 3.0),
        "leaderboard": evaluation_drawings(),
    }
    for name, drawings in sets.items():
        yield from ((f"{name}, {each}", draw) for each, draw in drawings.items())
