"""What counts as having run away: each cause by hand, on an arm of any size, row by row."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from apcc_torch.control.controller import APCCController
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.model.arm import Arm
from apcc_torch.simulation.divergence import Cause, Divergence, at_bound, sentence, stretch

D = torch.float64
TIME = torch.linspace(0.0, 10.0, 101, dtype=D)
LENGTH = torch.tensor(0.6, dtype=D)
JUDGE = Divergence()


def healthy(rows: int) -> dict[str, Any]:
    """Rows whose tips come near while the model fits."""
    decay = torch.exp(-TIME).unsqueeze(-1).expand(-1, rows)
    return {
        "stretches": 0.5 * decay.unsqueeze(-1).expand(-1, -1, 3),
        "gap": 0.03 * decay,
        "e": 0.5 * decay,
        "at_bound": torch.zeros(len(TIME), rows, dtype=torch.bool),
        "left_at": torch.full((rows,), torch.inf, dtype=D),
    }


def ill(cause: Cause, rows: dict[str, Any], row: int) -> None:
    """Makes one row run away from the middle of the run on."""
    late = slice(40, None)
    rows |= {name: value.clone() for name, value in rows.items()}
    if cause is Cause.NOT_FINITE:
        rows["stretches"][late, row, 1] = torch.nan
    elif cause is Cause.LEFT_BOUNDS:
        rows["left_at"][row] = 4.0
    elif cause is Cause.SHAPE:
        rows["gap"][late, row] = 0.3
    elif cause is Cause.ELONGATION:
        rows["stretches"][late, row, 2] = -1.6
    elif cause is Cause.LENGTHS:
        rows["at_bound"][late, row], rows["gap"][late, row] = True, 0.05
    else:
        rows["e"][late, row] = 0.3


@pytest.mark.parametrize("cause", Cause)
def test_each_cause_is_seen_in_its_row_alone_and_when_it_began(cause: Cause) -> None:
    rows = healthy(3)
    assert not JUDGE(TIME, LENGTH, **rows).any()
    ill(cause, rows, 1)
    causes = JUDGE(TIME, LENGTH, **rows)
    assert causes[-1].tolist() == [0, int(cause), 0]
    # What has to last counts from the end of the run on that is looked at.
    begin = 5.0 if cause in (Cause.LENGTHS, Cause.TIP) else 4.0
    assert float(TIME[int((causes[:, 1] > 0).int().argmax())]) == pytest.approx(begin)
    text = sentence(TIME, causes)
    assert text is not None and text.startswith(f"1 of 3 rows diverged: row 1 from {begin:g} s (")


@given(
    scale=st.floats(0.01, 100.0),
    causes=st.lists(st.sampled_from([None, *Cause]), min_size=1, max_size=6),
)
@settings(max_examples=40, deadline=None)
def test_an_arm_of_any_size_is_judged_alike_and_rows_do_not_mix(scale: float, causes: list[Cause | None]) -> None:
    rows = healthy(len(causes))
    for row, cause in enumerate(causes):
        if cause is not None:
            ill(cause, rows, row)
    once = JUDGE(TIME, LENGTH, **rows)
    assert once[-1].tolist() == [int(cause or 0) for cause in causes]
    larger = {**rows, "gap": scale * rows["gap"], "e": scale * rows["e"]}
    assert torch.equal(JUDGE(TIME, scale * LENGTH, **larger), once)
    alone = [{name: v[..., k : k + 1] if v.dim() < 3 else v[:, k : k + 1] for name, v in rows.items()} for k in (0, -1)]
    alone[1] = {name: v[..., -1:] if v.dim() < 3 else v[:, -1:] for name, v in rows.items()}
    assert torch.equal(JUDGE(TIME, LENGTH, **alone[0]), once[:, :1])
    assert torch.equal(JUDGE(TIME, LENGTH, **alone[1]), once[:, -1:])


@pytest.mark.parametrize(
    ("e", "lost"),
    [
        (0.5 * torch.exp(-0.5 * TIME), False),  # on its way, slowly
        (0.02 * torch.ones_like(TIME), False),  # held off by a load, but there
        (0.3 + 0.3 * torch.cos(2.0 * TIME), False),  # a sine that it passes again and again
        (0.2 * torch.ones_like(TIME), True),  # never comes
        (0.05 * TIME, True),  # goes away
    ],
)
def test_a_tip_that_never_arrives_is_lost(e: Tensor, lost: bool) -> None:
    causes = JUDGE(TIME, LENGTH, torch.zeros(len(TIME), 1, 3, dtype=D), e=e.unsqueeze(-1))
    assert causes[-1].tolist() == [int(Cause.TIP) * lost]
    # A run of a moment does not tell.
    moment = JUDGE(0.1 * TIME, LENGTH, torch.zeros(len(TIME), 1, 3, dtype=D), e=e.unsqueeze(-1))
    assert not moment.any()


def test_a_length_at_its_bound_and_a_section_inside_out() -> None:
    bounds = LengthBounds(torch.tensor([0.2, 0.25], dtype=D), lower=0.5, upper=1.5, reach="free")
    pi_hat = bounds(torch.tensor([[0.2, 0.25], [0.01, 0.25], [0.2, 0.9]], dtype=D))
    assert at_bound(pi_hat, bounds).tolist() == [False, True, True]
    assert at_bound(pi_hat, None).tolist() == [False] * 3
    q = torch.tensor([0.1, 0.0, -0.4, 0.0, 0.1, 0.25], dtype=D)
    assert stretch(q, torch.tensor([0.2, 0.25], dtype=D)).tolist() == [-2.0, 1.0]
    assert int(JUDGE.now(LENGTH, stretch(q, torch.tensor([0.2, 0.25], dtype=D)))) == Cause.ELONGATION


def test_a_sentence_names_a_few_rows_and_counts_the_others() -> None:
    causes = torch.zeros(2, 30, dtype=torch.int64)
    assert sentence(TIME[:2], causes) is None
    causes[1, ::3] = int(Cause.SHAPE | Cause.TIP)
    assert sentence(TIME[:2], causes) == (
        "10 of 30 rows diverged: row 0 from 0.1 s (shape error, tip error), row 3 from 0.1 s (shape error, tip error), "
        "row 6 from 0.1 s (shape error, tip error), row 9 from 0.1 s (shape error, tip error), "
        "row 12 from 0.1 s (shape error, tip error), and 5 more"
    )


def test_where_the_true_arm_is_not_known_the_model_is_judged_at_the_sensors() -> None:
    controller = APCCController.for_arm(Arm(lengths=[0.2, 0.25]))
    length, T = torch.tensor(0.45, dtype=D), len(TIME)
    q, pi_hat = torch.zeros(T, 6, dtype=D), torch.tensor([0.2, 0.25], dtype=D).expand(T, 2)
    linear = torch.full((T, 2), 0.002, dtype=D)
    linear[50:60] = torch.nan  # no sensor counts for a while

    def verdict(**changed: Tensor) -> int:
        values = {"q_bar": q, "pi_hat": pi_hat, "linear": linear, **changed}
        return int(JUDGE.of_model(controller, length, TIME, **values)[-1, 0])

    assert verdict() == 0 and verdict(e=0.5 * torch.exp(-TIME)) == 0
    assert verdict(linear=100 * linear) == Cause.SHAPE
    assert verdict(e=torch.full_like(TIME, 0.2)) == Cause.TIP
    assert verdict(q_bar=q + 0.5) == Cause.ELONGATION
    assert controller.bounds is not None
    longest = controller.bounds(10 * pi_hat)
    assert verdict(pi_hat=longest) == 0
    assert verdict(pi_hat=longest, linear=20 * linear.nan_to_num(0.002)) == Cause.LENGTHS
