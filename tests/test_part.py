"""Parts: settings as attributes, shown, copied, saved and restored with the tensors, and what is derived from them."""

from __future__ import annotations

import copy
import inspect
import io
import pickle
from collections.abc import Callable, Iterator
from dataclasses import Field, dataclass, fields
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from apcc_torch.control.adaptation import AdaptiveLaw, NormalisedLaw
from apcc_torch.control.adaptive_dynamics import AdaptiveDynamics
from apcc_torch.control.composite_controller import CompositeController
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.lookahead import Lookahead
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.pid import TendonPID, TendonPIDSettings
from apcc_torch.control.predicted_loop import PredictedLoop
from apcc_torch.control.pressure import PressureControl
from apcc_torch.control.shape_law import ShapeLaw
from apcc_torch.control.task_controller import TaskController
from apcc_torch.control.task_integral import TaskIntegral, TaskIntegralSettings
from apcc_torch.errors import ConfigError
from apcc_torch.estimation.arc_fit import ArcFit
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.pose_filter import PoseFilter
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.sensor_gate import SensorGate
from apcc_torch.estimation.soft_window import SoftWindow
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_changes import ArmChanges
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.constant_strain import ConstantStrainBackbone
from apcc_torch.model.friction import TendonTransmission, TendonTransmissionSettings
from apcc_torch.part import Configurable, Part, part_of, row_tensors
from apcc_torch.settings import Setting, Settings, about_of, default_of, resolved, setting
from apcc_torch.simulation.curvature_sensors import CurvatureSensors, CurvatureSensorsSettings
from apcc_torch.simulation.divergence import Divergence
from apcc_torch.simulation.events import ArmEvents, ArmEventsSettings
from apcc_torch.simulation.inertial_units import InertialUnits, InertialUnitsSettings
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.rod_plant import RodPlant, RodPlantSettings
from apcc_torch.simulation.sensors import PoseSensors
from apcc_torch.simulation.true_places import PlaceErrors
from apcc_torch.spread import Numbers
from arms import HANGING_BASE, PI
from chambered import chambered, pushing, together
from every_class import needed, settings_classes, subclasses
from parts import dynamics as small

D = torch.float64
X = PI.cumsum(0)
ARM = Arm(lengths=PI.tolist())


@dataclass(frozen=True, kw_only=True)
class GainSettings(Settings):
    """Settings of `Gain`."""

    gain: Setting = setting(2.0, "1/s", meaning="of the error", rows="number", above=0)
    weights: Numbers | None = setting(None, meaning="of the entries; null: one", rows="sections", least=0)
    mode: str = setting("plain", meaning="plain or squared", choices=("plain", "squared"))


class Gain(Part):
    """A part of one's own, with what follows from its settings."""

    settings_type = GainSettings
    gain: Setting
    weights: Numbers | None
    mode: str

    def __init__(self, size: int, *given: Any, **changes: Any) -> None:
        super().__init__()
        self.size = size
        self.hold(resolved(GainSettings, given, changes))

    def derive(self) -> None:
        self.power = 2 if self.mode == "squared" else 1


class Louder(Gain):
    """Inherits the settings."""


def through_a_file(item: Any) -> Any:
    file = io.BytesIO()
    torch.save(item, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def test_numbers_stay_numbers_and_tensors_move_with_their_part() -> None:
    rows, weights = torch.tensor([1.0, 2.0], dtype=D), torch.tensor([1.0, 0.5, 2.0], dtype=D)
    part = Gain(3, rows, weights=weights).to(torch.float32)
    assert isinstance(part.gain, Tensor) and part.gain.dtype == torch.float32 and part.mode == "plain"
    assert dict(part.named_buffers()).keys() == {"gain", "weights"} and not list(part.parameters())
    assert row_tensors(part) == {"gain": (part.gain, 0)}, "the weights are one set for all rows"
    assert row_tensors(Gain(3, weights=torch.ones(2, 3))).keys() == {"weights"}
    rows.zero_()  # the caller's may change
    assert part.gain.tolist() == [1.0, 2.0]
    plain = Gain(3)
    assert (plain.gain, plain.weights) == (2.0, None) and not list(plain.buffers()) and not row_tensors(plain)


def test_a_graph_is_kept_and_a_parameter_stays_one() -> None:
    leaf = torch.ones((), dtype=D, requires_grad=True)
    part = Gain(3, 2.0 * leaf)
    assert isinstance(part.gain, Tensor)
    (slope,) = torch.autograd.grad(part.gain, leaf)
    assert float(slope) == 2.0
    trained = nn.Parameter(torch.tensor(1.5))
    part = Gain(3, trained)
    assert part.gain is trained and list(part.parameters()) == [trained] and not list(part.buffers())


def test_settings_come_in_order_by_name_whole_or_whole_with_changes() -> None:
    whole = GainSettings(gain=1.5, mode="squared")
    for part in (Gain(3, 1.5, None, "squared"), Gain(3, 1.5, mode="squared"), Gain(3, whole), Gain(3, gain=1.5,
                 mode="squared"), Gain(3, GainSettings(mode="squared"), gain=1.5)):  # fmt: skip
        assert part.settings == whole and part.power == 2
    assert Gain(3).settings == GainSettings()
    assert Gain(3, Louder(3, 5.0).settings).settings == GainSettings(gain=5.0), "of a derived class"


def test_what_follows_is_derived_when_settings_are_held_and_restored() -> None:
    part, other = Gain(3), Gain(3, mode="squared")
    assert (part.power, other.power) == (1, 2)
    part.load_state_dict(other.state_dict())
    assert part.power == 2
    short, even = SavitzkyGolay(5, 2, period=0.01), SavitzkyGolay(9, 3, period=0.02)
    short.load_state_dict(even.state_dict())
    assert short.length == 9 and short.table is not None and even.table is not None
    assert torch.equal(short.table, even.table)
    short.load_state_dict(SavitzkyGolay(torch.tensor([3, 7])).state_dict())
    assert short.length == 7 and short.table is None and short.newest is not None
    assert short.newest.sum(-1).tolist() == [3, 7]


def test_print_shows_every_setting_of_every_part() -> None:
    assert repr(Gain(3, 1.5, torch.ones(3))) == "Gain(gain=1.5, weights=tensor(3,), mode='plain')"
    controller = APCCController.for_arm(ARM, mode="position", null_weights=(1.0, 0.5, 0.2))
    shown = repr(controller)
    for part in controller.modules():
        if isinstance(part, Part):
            assert type(part).__name__ in shown
            for each in fields(type(part).settings_type):
                assert f"{each.name}=" in shown
    assert "mode='position'" in shown and "null_weights=tensor(3,)" in shown and "reach='free'" in shown


def test_help_shows_settings_where_the_constructor_takes_them() -> None:
    parameters = inspect.signature(Gain).parameters
    assert list(parameters) == ["size", "gain", "weights", "mode"]
    assert parameters["gain"].default == 2.0 and parameters["size"].default is inspect.Parameter.empty
    assert list(inspect.signature(SoftWindow).parameters) == ["weights", "order", "derivative"]
    for part in subclasses(Configurable):
        took = inspect.signature(part).parameters
        if any(each.kind is each.VAR_KEYWORD for each in inspect.signature(part.__init__).parameters.values()):
            for each in fields(part.settings_type):
                assert each.name in took, f"{part.__name__}.{each.name}"


def test_a_part_that_inherits_settings_has_a_class_of_its_own() -> None:
    assert Louder.settings_type is not GainSettings and issubclass(Louder.settings_type, GainSettings)
    assert part_of(GainSettings()) is Gain and part_of(Louder.settings_type()) is Louder
    assert isinstance(Louder(3, 3.0).settings, Louder.settings_type) and Louder(3, 3.0).gain == 3.0
    assert (
        part_of(AdaptiveLaw.settings_type()) is AdaptiveLaw and part_of(NormalisedLaw.settings_type()) is NormalisedLaw
    )
    assert part_of(TaskController.settings_type()) is TaskController
    for part in subclasses(Configurable):
        assert part.settings_type.part is part, part.__name__


def test_a_copy_of_computed_tensors_is_made_of_leaves() -> None:
    leaf = torch.tensor([10.0, 20.0], dtype=D, requires_grad=True)
    pid = TendonPID(K_P=leaf * 75.0, K_D=5.0)
    with pytest.raises(RuntimeError, match=r"created explicitly"):
        copy.deepcopy(pid.K_P)
    plant = Plant(ARM.dynamics(), ARM.routing(), pid, torch.zeros(2, dtype=D), substeps=3)
    for whole in (plant, nn.Sequential(plant)):
        copied = copy.deepcopy(whole)
        other = copied[0] if isinstance(copied, nn.Sequential) else copied
        assert isinstance(other, Plant) and other.substeps == 3
        for name, value in plant.named_buffers():
            twin = other.get_buffer(name)
            assert torch.equal(twin, value) and twin is not value and twin.is_leaf, name
            assert twin.requires_grad == value.requires_grad, name
    # The original's graph is as it was.
    assert isinstance(plant.pid.K_P, Tensor)
    (slope,) = torch.autograd.grad(plant.pid.K_P.sum(), leaf)
    assert slope.tolist() == [75.0, 75.0]


def controller(kind: type[APCCController] = APCCController, **settings: Any) -> APCCController:
    feedback = StateFeedback(PCCBackbone(3, HANGING_BASE), X)
    parts = feedback.backbone, feedback, SavitzkyGolay(), InverseKinematics()
    return kind(*parts, NormalisedLaw(3), routing=ARM.routing(), **settings)


def predicted(**settings: Any) -> PredictedLoop:
    model = PCCBackbone(3, HANGING_BASE), InverseKinematics(n_sections=3), ARM.dynamics(), ARM.routing()
    return PredictedLoop(*model, **settings)


def feedback() -> StateFeedback:
    return StateFeedback(PCCBackbone(3, HANGING_BASE), X)


FIVE = torch.tensor([0.1, 14.0, 30.0, 0.1, 1.0], dtype=D)

MAKE: dict[type[Part], Callable[..., Part]] = {
    AdaptiveDynamics: lambda **s: AdaptiveDynamics(FIVE, 0.1 * FIVE, **s),
    ArmEvents: lambda **s: ArmEvents(3, **s),
    AdaptiveLaw: lambda **s: AdaptiveLaw(3, **s),
    AffineBackbone: lambda **s: AffineBackbone(3, HANGING_BASE, **s),
    APCCController: controller,
    ArcFit: lambda **s: ArcFit(PCCBackbone(3, HANGING_BASE), PI, **s),
    CompositeController: lambda **s: CompositeController(controller(), **s),
    ConstantStrainBackbone: lambda **s: ConstantStrainBackbone(3, HANGING_BASE, **s),
    CurvatureSensors: CurvatureSensors,
    Divergence: Divergence,
    InertialUnits: InertialUnits,
    InverseKinematics: lambda **s: InverseKinematics(n_sections=3, **s),
    LengthBounds: lambda **s: LengthBounds(PI, X, **s),
    LoadedShape: lambda **s: LoadedShape.on(ARM, LoadedShapeSettings(**s)),
    Lookahead: lambda **s: Lookahead(predicted(), **s),
    LookaheadController: lambda **s: controller(LookaheadController, of=ARM, **s),
    NormalisedLaw: lambda **s: NormalisedLaw(3, **s),
    Plant: lambda **s: Plant(ARM.dynamics(), ARM.routing(), None, torch.zeros(2, dtype=D), PlantSettings(**s)),
    RodPlant: lambda **s: RodPlant.on(ARM, torch.zeros(2, dtype=D), RodPlantSettings(**s)),
    PoseFilter: PoseFilter,
    PoseSensors: PoseSensors,
    SavitzkyGolay: SavitzkyGolay,
    SensorGate: lambda **s: SensorGate(X, **s),
    ShapeLaw: lambda **s: ShapeLaw(PI, feedback(), **s),
    StateFeedback: lambda **s: StateFeedback(PCCBackbone(3, HANGING_BASE), X, **s),
    TaskController: lambda **s: controller(TaskController, **s),
    TaskIntegral: TaskIntegral,
    TendonPID: TendonPID,
    PredictedLoop: predicted,
    PressureControl: lambda **s: PressureControl(small(), chambered(), pushing(), together(), **s),
    TendonTransmission: lambda **s: TendonTransmission(ARM.routing(), **s),
}
"""Every part with settings, made with some of them changed."""

OTHER: dict[str, Any] = {
    "CompositeController.lower": (0.01, 1.0, 0.0, 0.0, 0.5),
    "CompositeController.upper": (1.0, 99.0, 900.0, 1.0, 2.0),
    "ConstantStrainBackbone.strains": ("bend_x", "bend_y", "torsion", "elongation"),
    "arm": ArmChanges(mass=2.0),
    "curvature": CurvatureSensorsSettings(noise=0.1),
    "events": ArmEventsSettings(taken=-0.1, growth=0.1),
    "inertial": InertialUnitsSettings(tilt_noise=0.02),
    "pid": TendonPIDSettings(K_P=700.0, force_limit=40.0),
    "places": PlaceErrors(sensors=-0.01),
    "spheres": ((0.1, 0.0, -0.3, 0.05),),
    "window": 9,
}
"""Values of settings for which one more, or another choice, is none."""


def others(part: type[Part], each: Field[Any]) -> Iterator[Any]:
    """Values of a setting other than its default: plain, and where rows or entries may differ as a tensor."""
    about, default, annotation = about_of(each), default_of(each), str(each.type)
    told = OTHER.get(f"{part.__name__}.{each.name}", OTHER.get(each.name))
    if told is not None:
        yield told
    elif about.choices:
        yield next(choice for choice in about.choices if choice != default)
    elif annotation == "bool":
        yield not default
    elif annotation.startswith("int"):
        yield default + 1
    else:
        number = next(
            value for value in (1.5 * (default or 0.0), 0.5, 2.0) if value != default and within(about, value)
        )
        yield number
        spread = {"number": (2,), "sections": (3,), "gain": (3, 3), "task": (3, 3)}.get(about.rows)
        if spread is not None:
            row = torch.full(spread[:1], number, dtype=D)
            yield torch.diag_embed(row) if len(spread) == 2 else row
            yield row.tolist() if about.rows != "number" else torch.tensor(number, dtype=D)
    if each.name == "window":
        yield torch.tensor([3, 9])


def within(about: Any, value: float) -> bool:
    try:
        about.check("value", value)
    except Exception:
        return False
    return True


PARTS_MORE = ((Plant, "transmission"), (RodPlant, "transmission"), (PredictedLoop, "spheres"))
"""Settings with which a part has a part more."""

CASES = [
    (part, each, i, value)
    for part in MAKE
    for each in fields(part.settings_type)
    if (part, each.name) not in PARTS_MORE
    for i, value in enumerate(others(part, each))
    # Whose settings are those of all rows.
    if part is not LookaheadController or not isinstance(value, Tensor) or not value.dim()
]


def alike(a: Any, b: Any) -> bool:
    """Whether settings, or values in them, are the same: of tensors every bit, of lists the numbers."""
    if isinstance(a, Settings):
        return type(a) is type(b) and all(alike(getattr(a, e.name), getattr(b, e.name)) for e in fields(a))
    if isinstance(a, Tensor) or isinstance(b, Tensor):
        return isinstance(a, Tensor) and isinstance(b, Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    return bool(a == b)


def test_every_part_with_settings_is_tried() -> None:
    rooms = ("control", "estimation", "model", "simulation")
    names = tuple(f"apcc_torch.{room}." for room in rooms)
    inside = [part for part in subclasses(Part) if part.__module__.startswith(names)]
    assert {part for part in inside if fields(part.settings_type)} == {*MAKE, SoftWindow}


@pytest.mark.parametrize(
    ("part", "each", "i", "value"), CASES, ids=[f"{p.__name__}.{e.name}-{i}" for p, e, i, _ in CASES]
)
def test_a_state_dict_restores_the_setting(part: type[Part], each: Field[Any], i: int, value: Any) -> None:
    source, target = MAKE[part](**{each.name: value}), MAKE[part]()
    assert not alike(source.settings, target.settings)
    restored = target.load_state_dict(through_a_file(source.state_dict()))
    assert not restored.missing_keys and not restored.unexpected_keys
    assert alike(target.settings, source.settings)
    # What is derived from it comes along, saved or not.
    have, want = dict(target.named_buffers()), dict(source.named_buffers())
    assert have.keys() == want.keys()
    for name, buffer in want.items():
        assert have[name].dtype == buffer.dtype and torch.equal(have[name], buffer), name


def test_a_state_dict_restores_the_settings_of_parts_within() -> None:
    rubbing = TendonTransmissionSettings(friction=0.3, slack=False)
    source = MAKE[Plant](transmission=rubbing, pid=TendonPIDSettings(K_I=3.0))
    target = MAKE[Plant](transmission=TendonTransmissionSettings())
    target.load_state_dict(source.state_dict())
    assert alike(target.settings, source.settings) and target.settings.transmission == rubbing  # type: ignore[attr-defined]
    changed = APCCController.for_arm(
        ARM,
        mode="position",
        window=9,
        K=2.0,
        time_constant=2.0,
        lower=0.7,
        reach="last",
        integral=TaskIntegralSettings(gain=0.3),
    )
    plain = APCCController.for_arm(ARM, integral=TaskIntegralSettings())
    plain.load_state_dict(through_a_file(changed.state_dict()))
    assert repr(plain) == repr(changed)
    for (name, a), (_, b) in zip(plain.named_modules(), changed.named_modules(), strict=True):
        assert not isinstance(a, Part) or alike(a.settings, b.settings), name  # type: ignore[union-attr]


def test_a_state_of_another_form_is_refused_by_name() -> None:
    state = Gain(3).state_dict()
    state["_extra_state"]["values"]["speed"] = 1.0
    with pytest.raises(ConfigError, match="hold speed differently"):
        Gain(3).load_state_dict(state)
    with pytest.raises(ConfigError, match="one of Louder, this part is Gain"):
        Gain(3).load_state_dict(Louder(3).state_dict())


@pytest.mark.parametrize("kind", [*settings_classes(), *(part.settings_type for part in subclasses(Configurable))])
def test_settings_are_pickled_copied_and_compared(kind: type[Settings]) -> None:
    settings = kind(**needed(kind))
    for twin in (pickle.loads(pickle.dumps(settings)), copy.deepcopy(settings), settings.changed()):
        assert twin == settings and type(twin) is kind
    assert hash(GainSettings()) == hash(GainSettings())


def test_settings_of_a_class_that_has_none_are_pickled_too() -> None:
    assert not fields(PCCBackbone.settings_type)
    twin = pickle.loads(pickle.dumps(PCCBackbone.settings_type()))
    assert type(twin) is PCCBackbone.settings_type and part_of(twin) is PCCBackbone


def test_what_torch_makes_while_it_exports_is_not_loaded_in_place_of_a_part() -> None:
    proxy = type("SavitzkyGolay", (SavitzkyGolay,), {"__module__": "torch.fx.experimental.proxy_tensor"})
    proxy.__module__, proxy.__qualname__ = SavitzkyGolay.__module__, SavitzkyGolay.__qualname__
    assert type(through_a_file(SavitzkyGolay(5, 2))) is SavitzkyGolay
    proxy.__module__ = __name__  # other tests take it for one of theirs
