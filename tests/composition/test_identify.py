"""Settings of identification: every arm in conf composes, and wrong ones are refused by key."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore

from apcc_torch.composition.identify import BlockConfig, IdentifyConfig, arm_of, layout, parameters, read
from apcc_torch.composition.typed import typed
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ConfigError, DataError
from apcc_torch.identification.series import Series

ConfigStore.instance().store(name="identify_schema", node=IdentifyConfig)
ARMS = sorted(path.stem for path in (Path(conf_path()) / "arm").glob("*.yaml"))


def composed(*overrides: str) -> IdentifyConfig:
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return typed(compose("identify", list(overrides)), IdentifyConfig)


def recorded(m: int, k: int) -> Series:
    zeros = torch.zeros(2, dtype=torch.float64)
    return Series(zeros, torch.zeros(2, m).double(), torch.zeros(2, k, 3).double(), torch.zeros(2, dtype=torch.int64))


@pytest.mark.parametrize("name", ARMS)
def test_every_arm_composes_and_has_parameters(name: str) -> None:
    config = composed(f"arm={name}")
    found = layout(config, recorded(max(config.tendons.inputs) + 1, len(config.bodies)))
    blocks = parameters(config, found)
    assert len(blocks) > 40
    assert set(config.fit.geometric) <= set(blocks.blocks)
    assert config.name == name


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["blocks.offset.nominal=[1,2]"], r"blocks\.offset\.nominal must be a number or a list of 9, got 2"),
        (["blocks.offset.spread=much"], r"blocks\.offset\.spread must be a number or a list of 9, got 'much'"),
        (["~blocks.angle"], r"blocks\.angle is missing"),
        (["tendons.inputs=[0,1,2,3,4,5,6,7,9]"], "names input 9, the recording has 9"),
        (["bodies=[2,3]"], "bodies has 2 entries, the recording has 1"),
    ],
)
def test_settings_that_do_not_fit_are_refused(overrides: list[str], words: str) -> None:
    config = composed("arm=ftdcr_v6", *overrides)
    with pytest.raises(ConfigError, match=words):
        parameters(config, layout(config, recorded(9, 1)))


def test_a_block_that_is_none_is_refused() -> None:
    config = composed("arm=ftdcr_v6")
    config.blocks["colour"] = BlockConfig(1.0)
    with pytest.raises(ConfigError, match=r"blocks\.colour is not a block; there are rest_length"):
        parameters(config, layout(config, recorded(9, 1)))


def test_data_and_its_layout_must_be_given() -> None:
    with pytest.raises(ConfigError, match="data must name"):
        read(composed("arm=ftdcr_v6"))
    with pytest.raises(ConfigError, match=r"recording\.layout must be"):
        read(composed("arm=ftdcr_v6", "data=x.csv", "recording.layout=odd"))


def test_the_arm_is_told_by_the_recording(tmp_path: Path) -> None:
    table = tmp_path / "a.csv"
    table.write_text("timestamp,servo_1_mm,tip_x\n")
    assert arm_of(str(table)) == "ftdcr_v6"
    (tmp_path / "observations_x.csv").write_text("ID\n")
    assert arm_of(str(tmp_path)) == "trunk"
    table.write_text("a,b\n")
    with pytest.raises(ConfigError, match="arm must be named"):
        arm_of(str(table))
    with pytest.raises(DataError, match="no such file"):
        arm_of(str(tmp_path / "none.csv"))
