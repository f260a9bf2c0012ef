"""A library's folder: it builds without a warning wherever it should, passes its own test, and needs nothing else."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from apcc_torch import export
from apcc_torch.composition.export import of_an_export
from apcc_torch.composition.unread import check_given
from apcc_torch.control.tendon_limits import SolverStatus
from apcc_torch.errors import ApccError, ConfigError
from apcc_torch.estimation.feedback import FeedbackStatus
from apcc_torch.exporting.folder import filled
from apcc_torch.exporting.library import LIMIT_WORDS, STATUS_WORDS
from apcc_torch.exporting.settings import LibrarySettings
from apcc_torch.exporting.structs import leaves
from apcc_torch.exporting.words import MEMBERS
from composed import composed_export
from exported_library import exported, needed, said

SMALL = (
    "arm.lengths=[0.2]",
    "arm.sensors=[0.2]",
    "controller.adaptive=false",
    "feedback.max_iterations=2",
    "plant.refine=1",
    "plant.settle=0.5",
)
STRICT = "-DCMAKE_CXX_FLAGS=-Werror"
OF_C = {"atan2", "cos", "sin", "exp", "expm1", "acos", "asin", "atan", "log", "pow", "tan", "tanh", "floor"}
"""What a library may ask of the C library beside the copying of memory: functions of numbers."""
COPYING = {"memcpy", "memset", "memmove", "__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A library of a small arm, with all that there is."""
    return exported(tmp_path_factory.mktemp("library"), *SMALL, "with_plant=true", "actuation=forces", "name=finger")


def built(folder: Path, build: str, *options: str) -> Path:
    """The library, its test and its example, built."""
    said([needed("cmake"), "-S", ".", "-B", build, STRICT, *options], folder)
    said(["cmake", "--build", build, "--parallel", "2"], folder)
    return folder / build


def passes(made: Path, *emulator: str) -> None:
    """Its test passes, and the tip of its example gets to its target."""
    told = said([*emulator, made / "test_vectors"], made)
    assert re.fullmatch(r"20 steps, 0 failures, largest difference \S+, 0 allocations\n", told), told
    last = said([*emulator, made / "example"], made).splitlines()[-1]
    found = re.search(r"error +(\S+) +(\S+) +(\S+) mm", last)
    assert found is not None and max(abs(float(e)) for e in found.groups()) < 0.5, last


def test_it_builds_passes_and_needs_nothing_else(folder: Path) -> None:
    made = built(folder, "build")
    passes(made)
    asked = set(re.findall(r" U (\w+)", said([needed("nm"), "-u", "libfinger.a"], made)))
    assert asked <= OF_C | COPYING, f"it asks for {asked - OF_C - COPYING}"
    written = set(re.findall(r" [BbDdCc] (\w+)", said(["nm", "libfinger.a"], made)))
    assert not written, f"it keeps {written} between calls"


@pytest.mark.parametrize(
    "options",
    [
        ("-DCMAKE_C_COMPILER=clang", "-DCMAKE_CXX_COMPILER=clang++"),
        ("-DFINGER_SANITIZE=address,undefined",),
    ],
    ids=["clang", "sanitized"],
)
def test_it_builds_elsewhere(folder: Path, options: tuple[str, ...]) -> None:
    if "clang" in options[0]:
        needed("clang++")
    passes(built(folder, f"build_{len(options)}", "-DCMAKE_BUILD_TYPE=Debug", *options))


def test_it_runs_on_another_processor(folder: Path) -> None:
    compiler, emulator = needed("aarch64-linux-gnu-g++"), needed("qemu-aarch64")
    target = (
        "-DCMAKE_SYSTEM_NAME=Linux",
        "-DCMAKE_SYSTEM_PROCESSOR=aarch64",
        f"-DCMAKE_C_COMPILER={compiler.replace('g++', 'gcc')}",
        f"-DCMAKE_CXX_COMPILER={compiler}",
    )
    passes(built(folder, "build_arm", "-DCMAKE_BUILD_TYPE=Debug", *target), emulator, "-L", "/usr/aarch64-linux-gnu")


def test_a_library_of_single_precision_passes_its_test(tmp_path: Path) -> None:
    made = built(exported(tmp_path, *SMALL, "precision=single", "vectors=8"), "build", "-DCMAKE_BUILD_TYPE=Debug")
    assert said([made / "test_vectors"], made).startswith("8 steps, 0 failures")
    text = (tmp_path / "include" / "apcc.h").read_text()
    assert "typedef float apcc_real;" in text and re.search(r"double +time;", text)


def test_a_wrong_number_is_found(folder: Path) -> None:
    """The folder's own test is one: it fails where a number of the source is another."""
    source = (folder / "src" / "finger.cpp").read_text()
    at = source.index("REAL numbers[", source.index("namespace of_step {"))
    begin, end = source.index("{", at) + 1, source.index("}", at)
    changed = source[:begin] + ", ".join(f"1.001 * {x}" for x in source[begin:end].split(",")) + source[end:]
    (folder / "wrong.cpp").write_text(changed)
    command = [needed("g++"), "-std=c++17", "-O0", "-Iinclude", "-Isrc", "wrong.cpp", "test/test_vectors.cpp"]
    said([needed("gcc"), "-Iinclude", "-c", "test/header_is_c.c", "-o", "header.o"], folder)
    said([*command, "header.o", "-o", "wrong"], folder)
    with pytest.raises(AssertionError, match="failures"):
        said([folder / "wrong"], folder)


def test_the_program_writes_a_folder_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["export", "out=mine", "vectors=3", "covariance=false", "feedback=position", *SMALL[:4]]
    monkeypatch.setattr(sys, "argv", words)
    export.main()
    there = {str(path.relative_to("mine")) for path in Path("mine").rglob("*") if path.is_file()}
    assert {"CMakeLists.txt", "README.md", "include/apcc.h", "include/apcc.hpp", "config.yaml"} <= there
    assert not re.search(r"@\w+@", "".join(Path("mine", name).read_text() for name in there if ".hydra" not in name))
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        export.main()
    assert ended.value.code == 2 and "mine holds results (CMakeLists.txt)" in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("change", "said_of_it"),
    [
        ({"name": "int"}, "name must be a word of C"),
        ({"name": "Mine"}, "name must be a word of C"),
        ({"vectors": 2}, r"vectors must be in \[3, 1000\]"),
        ({"precision": "half"}, "precision must be one of double, single"),
    ],
)
def test_what_is_no_library_is_refused(change: dict[str, Any], said_of_it: str) -> None:
    with pytest.raises(ApccError, match=said_of_it):
        LibrarySettings(**change)


@pytest.mark.parametrize(
    ("words", "said_of_it"),
    [
        (("experiment.payloads=[0.1]",), "experiment.payloads is read by nothing: the controller alone is exported"),
        (("plant.refine=3",), "plant.refine is read by nothing: with_plant is false"),
        (("actuation=forces", "plant.pid.K_P=2", "plant.backlash=1e-3"), "plant.backlash is read by nothing"),
        (("dtype=float32",), "dtype is read by nothing: precision says it"),
        (("angular_noise=0.1",), "angular_noise is read by nothing: the law of the shape has its own"),
    ],
)
def test_what_a_library_does_not_depend_on_is_refused(words: tuple[str, ...], said_of_it: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(said_of_it)):
        check_given(of_an_export, [composed_export(*words)], words)


def test_a_plant_has_one_payload(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"experiment.payloads must hold one payload for the plant, got \[0.0, 0.1\]"):
        exported(tmp_path, *SMALL, "with_plant=true", "experiment.payloads=[0.0,0.1]")


def test_every_status_has_words() -> None:
    assert STATUS_WORDS.keys() == FeedbackStatus.__members__.keys()
    assert LIMIT_WORDS.keys() == SolverStatus.__members__.keys()


def test_every_member_has_words(folder: Path) -> None:
    """So does what only some controllers remember."""
    text = (folder / "include" / "finger.h").read_text()
    members = re.findall(r"^ {4}(?:finger_real|double|bool|int32_t) (\w+)[^;]*;(.*)$", text, re.M)
    assert len(members) > 40 and all("/**<" in comment for _, comment in members), members
    for words in MEMBERS.values():
        assert words.meaning and words.unit.isascii()
    assert [path for path, _, _ in leaves((torch.zeros(1), None, (torch.zeros(2),)))] == [("0",), ("2", "0")]


def test_words_belong_to_fields() -> None:
    """A name that no tuple has any more has no words."""
    fields: dict[str, tuple[str, ...]] = {}
    waiting = [tuple]
    while waiting:
        for each in waiting.pop().__subclasses__():
            waiting.append(each)
            if each.__module__.startswith("apcc_torch."):
                fields[each.__name__] = getattr(each, "_fields", ())
    for key in MEMBERS:
        kind, _, name = key.partition(".")
        assert name in fields[kind], key


def test_templates_are_filled() -> None:
    assert filled("a @x@ @y@\n", {"x": "1", "y": "2"}, {}) == "a 1 2\n"
    with pytest.raises(KeyError):
        filled("@z@", {}, {})
    assert LibrarySettings(name="arm_1").name == "arm_1"
    assert composed_export("arm=arm_2").arm.lengths == (0.15, 0.15, 0.15)


def test_a_library_of_an_arm_with_chambers_tells_pressures(tmp_path: Path) -> None:
    """In its command, its plant and its example, which reaches its target; each member has words."""
    small = ("arm=soft_trunk", "feedback.max_iterations=2", "plant.refine=1", "plant.settle=0.5")
    folder = exported(tmp_path, *small, "with_plant=true", "covariance=false", "name=air")
    passes(built(folder, "build"))
    assert re.search(r"status \d  pressures( +\d+\.\d){6} kPa", said([folder / "build" / "example"], folder))
    header = (folder / "include" / "air.h").read_text(encoding="utf-8")
    command = header[header.index("typedef struct air_command") : header.index("} air_command")]
    assert re.search(r"air_real pressure\[6\]; +/\*\*< \[Pa\]", command)
    assert not re.findall(r"^    \w+ \w+(?:\[\d+\])*;$", header, re.M), "members without words"
    assert "send(command.pressure);" in (folder / "README.md").read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match="actuation=forces is a loop on tendons, and arm has chambers"):
        exported(tmp_path / "other", "arm=soft_trunk", "actuation=forces")
