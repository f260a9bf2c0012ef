"""Settings are flat, compared by value, and swept where runs differ in them for no other reason."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.report import settings

names = st.text("abcxyz_", min_size=1, max_size=4)
leaves = st.one_of(
    st.integers(), st.floats(allow_nan=False), st.booleans(), st.none(), st.lists(st.integers(), max_size=3)
)
trees = st.recursive(leaves, lambda inner: st.dictionaries(names, inner, min_size=1, max_size=3), max_leaves=8)


@given(st.dictionaries(names, trees, max_size=4))
def test_flat_keys_lead_to_their_values(tree: dict[str, object]) -> None:
    flat = settings.flatten(tree)

    def leaf_count(node: object) -> int:
        return sum(map(leaf_count, node.values())) if isinstance(node, dict) else 1

    assert len(flat) == leaf_count(tree)
    for key, value in flat.items():
        node: object = tree
        for part in key.split("."):
            assert isinstance(node, dict)
            node = node[part]
        assert node is value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("2.5E+2", 250.0),
        ("7", 7),
        ("0.1", 0.1),
        ("true", True),
        ("pose", "pose"),
        ("[0.1, 0.2]", [0.1, 0.2]),
        ("null", None),
        ("{", "{"),
    ],
)
def test_text_of_an_override_becomes_its_value(text: str, value: object) -> None:
    assert settings.scalar(text) == value and type(settings.scalar(text)) is type(value)


def test_overrides_are_split_at_their_first_sign() -> None:
    lines = ["a.b=x=y", "+c=1", "++d=2", "~e", "~f=3", "group@pkg=z"]
    assert settings.split_overrides(lines) == {"a.b": "x=y", "c": "1", "d": "2", "group": "z"}


def test_a_number_is_compared_by_its_value_and_a_truth_by_its_kind() -> None:
    assert settings.comparable(1) == settings.comparable(1.0) != settings.comparable(True)
    assert settings.comparable([1, 2.0]) == settings.comparable((1.0, 2))


def test_what_differs_or_was_asked_for_is_swept() -> None:
    runs: list[dict[str, object]] = [
        {"a": 1, "b.c": 0.1, "b.d": 5, "progress": True},
        {"a": 1.0, "b.c": 0.2, "b.d": 5, "progress": False},
    ]
    assert settings.swept_keys(runs, [{}, {}]) == ["b.c"]
    assert settings.swept_keys(runs, [{"b.d": "5"}, {"progress": "false", "hydra.run.dir": "x"}]) == ["b.c", "b.d"]
    assert settings.swept_keys(runs, [{}, {}], own=("a",)) == ["a", "b.c"]


def test_how_a_run_is_computed_is_no_setting_of_it() -> None:
    how = ("progress", "hydra.run.dir", "hydra/launcher", "batch", "batch_kept", "prune.after", "threads")
    assert all(map(settings.is_how, how))
    assert not any(map(settings.is_how, ("seed", "device", "experiment", "velocity_filter.window")))


def test_what_follows_from_a_chosen_group_is_not_swept_beside_it() -> None:
    runs: list[dict[str, object]] = [
        {"arm.mass": 1, "arm.name": "one", "gain": 0.1},
        {"arm.mass": 2, "arm.name": "two", "gain": 0.1},
        {"arm.mass": 2, "arm.name": "two", "gain": 0.3},
    ]
    chosen = [{"arm": "first"}, {"arm": "second"}, {"arm": "second"}]
    assert settings.swept_keys(runs, chosen) == ["arm", "gain"]
    # Without the choice there is nothing that the settings could follow from.
    assert settings.swept_keys(runs, [{}, {}, {}]) == ["arm.mass", "arm.name", "gain"]


def test_a_part_that_some_runs_lack_is_swept() -> None:
    runs: list[dict[str, object]] = [{"law": None, "gain": 1}, {"law.kind": "a.B", "law.rate": 2, "gain": 1}]
    assert settings.swept_keys(runs, [{}, {}]) == ["law.kind"]
    assert settings.swept_keys(runs, [{"law": "none"}, {"law": "b"}]) == ["law"]


def test_what_follows_from_the_experiments_name_is_not_swept_beside_it() -> None:
    runs: list[dict[str, object]] = [{"experiment.name": name, "rate": rate} for name, rate in (("a", 1), ("b", 2))]
    assert settings.swept_keys(runs, [{}, {}]) == ["experiment.name"]
    # A choice of the group says the same, once.
    assert settings.swept_keys(runs, [{"experiment": "a"}, {"experiment": "b"}]) == ["experiment"]
    assert settings.swept_keys([*runs, {"experiment.name": "a", "rate": 3}], [{}] * 3) == ["experiment.name", "rate"]
