"""Recordings, sets of them and arms' files that are damaged or mean harm: each is read, or refused in one sentence."""

from __future__ import annotations

import shutil
from pathlib import Path
from random import Random

import pytest
import torch
import yaml
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from apcc_torch.composition.arm_file import arm_override
from apcc_torch.composition.evaluate import EvaluateSettings, recordings
from apcc_torch.composition.schema import sentence
from apcc_torch.errors import ApccError, DataError
from apcc_torch.files import LONGEST_NUMBER
from apcc_torch.model.arm import Arm
from apcc_torch.reading import plain
from apcc_torch.recordings.recording_file import load_recording
from composed import composed_evaluate
from odd_values import damaged_bytes, odd_text, odd_value, seeds
from rod_recordings import ARM, DATA, write_recordings

SECRET = "secret of the reader"
REFERENCES = ("${oc.env:APCC_SECRET}", "\\${oc.env:APCC_SECRET}", "${data.name}", "'${seed}", "../../out", "/out")
CELLS = ("", "nan", "inf", "-inf", "1e308", "-1e300", "=1+1", "\x1b[2J", '"', "\0", "1,2", "9" * 5000, "1_0", "\u0661")
KEYS = ("hydra.run.dir", "hydra.callbacks.x", "overwrite", "~data", "data", "+hydra", "kind", "_target_", "x},y:{z")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a set of two small recordings, their rest, and their arm."""
    return write_recordings(tmp_path_factory.mktemp("sound"), 40).parent


@pytest.fixture
def folder(sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The set once more, to be damaged."""
    monkeypatch.setenv("APCC_SECRET", SECRET)
    return Path(shutil.copytree(sound, tmp_path / "set"))


def mutated_table(text: str, random: Random) -> bytes:
    """The table with an odd cell, an odd name, a line too many or too few, or other bytes."""
    lines = [line.split(",") for line in text.splitlines()]
    row = random.choice((0, random.randrange(len(lines))))
    k = random.randrange(len(lines[row]))
    match random.randrange(7):
        case 0:
            return damaged_bytes(text.encode(), random)
        case 1 | 2:
            lines[row][k] = random.choice((*CELLS, odd_text(random)))
        case 3:
            lines[0][k] = random.choice(("u", "x", "phi", "u99999999999", "u" + "9" * 6000, "x" * 10**6, "u0", "time"))
        case 4:
            lines.insert(row, random.choice(([], [""], lines[row][:k], lines[row] * 2)))
        case 5:
            lines[0] += [f"u{i}" for i in range(random.choice((1, 2000)))]
        case _:
            del lines[row:]
    return "\n".join(",".join(line) for line in lines).encode("utf-8", "surrogatepass")


def mutated_mapping(values: dict[str, object], random: Random) -> bytes:
    """A YAML file of the values with something else in place of one of them, at any depth."""
    if random.random() < 0.15:
        return damaged_bytes(yaml.safe_dump(values).encode(), random)
    copy = yaml.safe_load(yaml.safe_dump(values))
    at = copy
    while True:
        key = random.choice(list(at) if isinstance(at, dict) else range(len(at)))
        if not isinstance(at[key], dict | list) or not at[key] or random.random() < 0.3:
            break
        at = at[key]
    match random.randrange(4):
        case 0 if isinstance(at, dict):
            at[random.choice((*KEYS, *REFERENCES))] = at.pop(key)
        case 1 if isinstance(at, dict):
            at[random.choice((*KEYS, odd_text(random)))] = odd_value(random)
        case _:
            at[key] = random.choice((random.choice(REFERENCES), odd_value(random)))
    try:
        return yaml.safe_dump(copy, allow_unicode=bool(random.getrandbits(1))).encode("utf-8", "surrogatepass")
    except (ValueError, yaml.YAMLError):  # a number too long to be written
        return b"data: " + b"9" * (2 * LONGEST_NUMBER)


def evaluated(folder: Path, settings: EvaluateSettings | None = None) -> str:
    """All that `evaluate` would use of the set, up to its methods."""
    settings = settings or composed_evaluate(f"data={folder / 'data.yaml'}")
    sessions, _ = recordings(settings)
    assert all(bool(torch.isfinite(session.frames.positions).all()) for session in sessions)
    return str(plain(settings))


def test_the_whole_set_is_read(folder: Path) -> None:
    assert "'empty'" in evaluated(folder) and len(load_recording_of(folder)) == 40


def load_recording_of(folder: Path) -> torch.Tensor:
    """The times of a recording in the layout that this package writes."""
    text = (folder / "empty.csv").read_text().replace("t,a,b,c,d,e,f,x1,y1,z1", "time,u1,u2,u3,u4,u5,u6,p_x,p_y,p_z")
    (folder / "own.csv").write_text(text)
    return load_recording(folder / "own.csv").times


@pytest.mark.parametrize("what", ["table", "own", "trunk", "arm", "data"])
def test_whatever_a_file_holds_it_is_read_or_refused_by_its_name(folder: Path, what: str) -> None:
    refused = set()
    load_recording_of(folder)
    (folder / "observations_1.csv").write_text(
        (folder / "empty.csv").read_text().replace("t,a,b,c,d,e,f", "ID,a,b,c,d,e,f")
    )
    name = {"table": "empty.csv", "own": "own.csv", "trunk": "observations_1.csv", "arm": "arm.yaml"}.get(
        what, "data.yaml"
    )
    sound, before = (folder / name).read_bytes(), sorted(folder.iterdir())
    composed = composed_evaluate(f"data={folder / 'data.yaml'}")
    tried = seeds(30 if what == "data" else 60)
    for seed in tried:
        random = Random(seed)
        if what in ("arm", "data"):
            (folder / name).write_bytes(mutated_mapping(ARM if what == "arm" else DATA, random))
        else:
            (folder / name).write_bytes(mutated_table(sound.decode(), random))
        try:
            match what:
                case "own" | "trunk":
                    load_recording(folder / name, layout="trunk" if what == "trunk" else "table")
                    said = ""
                case "arm":
                    said = str(Arm.load(folder / name)) + str(arm_override([f"arm={folder / name}"]))
                case _:
                    said = evaluated(folder, composed if what == "table" else None)
        except ApccError as error:
            said = str(error)
            refused.add(seed)
            assert len(said) < 20_000 and all(map(str.strip, said.splitlines())), (seed, said)
            assert name in said or what == "data", (seed, said)
        except (HydraException, OmegaConfBaseException) as error:
            said = sentence(error)
            refused.add(seed)
            assert what == "data" and "\n" not in said, (seed, said)
        except Exception as error:
            raise AssertionError(f"seed {seed}: {type(error).__name__}: {error}") from error
        assert SECRET not in said, seed
        assert sorted(folder.iterdir()) == before and not (folder.parent.parent / "out").exists()
    assert len(refused) > 5 and (len(refused) < len(tried) or what == "data")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"hydra.callbacks.x": {"_target_": "os.system"}}, "'hydra.callbacks.x' is nothing that a data set says"),
        ({"overwrite": True}, "'overwrite' is nothing that a data set says"),
        (
            {"files": {"../../up.csv": {}}, "source": "http://localhost:9"},
            "files must be a path inside the set's folder",
        ),
        ({"files": {"/up.csv": {}}, "source": "http://localhost:9"}, "files must be a path inside the set's folder"),
        ({"place": "../up"}, "place must be a path inside the set's folder"),
        ({"commit": "a/../../up"}, "commit must have no slash"),
        ({"sessions": {"one": {"file": "../up.csv"}}}, "sessions.*.file must be a path inside the set's folder"),
        ({"sessions": {"\x1b[2J": {"file": "a.csv"}}}, "is no name that a setting can have"),
    ],
)
def test_a_set_leads_nowhere_but_into_its_folder(folder: Path, change: dict[str, object], said: str) -> None:
    values = {**DATA, **change} if next(iter(change)) not in DATA["data"] and "." in next(iter(change)) else None
    if values is None:
        values = {**DATA, **change} if "overwrite" in change else {**DATA, "data": {**DATA["data"], **change}}
    (folder / "data.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(ApccError) as caught:
        composed_evaluate(f"data={folder / 'data.yaml'}")
    assert said in str(caught.value) and str(caught.value).startswith(f"{folder / 'data.yaml'}: ")


def test_nothing_in_a_set_is_resolved(folder: Path) -> None:
    (folder / "data.yaml").write_text(
        yaml.safe_dump(
            {**DATA, "data": {**DATA["data"], "licence": "a '${oc.env:APCC_SECRET}' \\${b}", "source": "\\"}}
        )
    )
    settings = composed_evaluate(f"data={folder / 'data.yaml'}")
    assert settings.data.licence == "a '${oc.env:APCC_SECRET}' \\${b}" and settings.data.source == "\\"


def test_links_in_circles_and_other_files_are_named(folder: Path) -> None:
    for name in ("empty.csv", "arm.yaml"):
        (folder / name).unlink()
        (folder / name).symlink_to(name)
        with pytest.raises(DataError, match=f"{name}.* Too many levels of symbolic links"):
            evaluated(folder)
        (folder / name).unlink()
        (folder / name).write_text(yaml.safe_dump(ARM))
