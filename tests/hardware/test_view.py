"""The live view: its picture, and that it leaves the terminal as it was."""

from __future__ import annotations

import io
import time
from dataclasses import replace

from apcc_torch.hardware.states import State
from apcc_torch.hardware.view import OTHER_SCREEN, OWN_SCREEN, TerminalView, bar, picture
from fake_devices import Fault
from fake_runs import fake_run


def test_the_picture_shows_the_last_turn() -> None:
    run = fake_run([Fault("read_fails", 0.5, 0.53)])
    tick = next(t for t in reversed(run.witness.ticks) if t.decision is not None)
    text = "\n".join(picture(tick, tick, run.witness.events[-1]))
    assert "DISARMED" in text and "1.5 s are over" in text
    assert "173.21 mm" in text, "the error's norm"
    assert "105.00   255.00   240.00 mm" in text, "pi-hat"
    assert text.count("5.00") >= 9 and "missed deadlines 0, failed exchanges 0" in text
    assert all(len(line) < 130 for line in text.splitlines())


def test_the_picture_can_be_drawn_at_any_moment() -> None:
    run = fake_run([Fault("read_fails", 0.0)])
    assert "connecting" in "\n".join(picture(None, None, None))
    assert "FAULT" in "\n".join(picture(None, None, run.witness.events[-1]))
    blind = fake_run([Fault("read_fails", 0.5), Fault("untracked", 0.4)]).witness.ticks[-1]
    assert "tension" not in "\n".join(picture(blind, None, None))


def test_a_bar_is_full_at_its_end_and_beyond_and_without_a_number() -> None:
    assert bar(0.0, 0.3, 10) == "·" * 10
    assert bar(0.15, 0.3, 10) == "#####" + "·" * 5
    assert bar(3.0, 0.3, 10) == bar(float("nan"), 0.3, 10) == "#" * 10


def test_the_view_draws_and_gives_the_terminal_back() -> None:
    terminal = io.StringIO()
    with TerminalView(terminal) as view:
        fake_run(observers=(view,))
        end = time.monotonic() + 5.0
        assert view.event is not None
        view.event = replace(view.event, message="body \x1b]0;owned\x07 is lost")
        while not all(word in terminal.getvalue() for word in ("owned", "time")) and time.monotonic() < end:
            time.sleep(0.02)
    drawn = terminal.getvalue()
    assert "\\x1b]0;owned\\x07" in drawn and "owned\x07" not in drawn
    assert drawn.startswith(OTHER_SCREEN) and drawn.endswith(OWN_SCREEN)
    assert view.tick is not None and view.tick.state is State.HOLD and "tension" in drawn
