"""Pages in a real browser: nodes appear, the arm follows the mouse, the slider moves a run, a run is seen live."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from PIL import Image

import chromium
from apcc_torch.experiments.recorded_run import recorded
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.env_window import EnvWindow
from apcc_torch.viewing.follower import Follower
from apcc_torch.viewing.live_process import Watched
from apcc_torch.viewing.live_view import LiveView
from apcc_torch.viewing.outline import Outline
from apcc_torch.viewing.page import Page
from apcc_torch.viewing.player import Player
from apcc_torch.viewing.pursuit import Pursuit
from apcc_torch.web_address import WebAddress
from commands import QUICK, simulate
from composed import composed
from fake_runs import builder, fake_run

pytest.importorskip("viser", reason="viser is not installed")
exceptions = pytest.importorskip("selenium.common.exceptions", reason="selenium is not installed")

ANY = WebAddress(port=0)
SOON = 60.0
"""s that a page may take on a busy machine."""
# A coarse loop, whose steps take less than their time without machine code.
FAST = (
    "experiment=setpoint", "controller.rate=20", "controller.K=3", "plant.settle=0.5", "plant.substeps=4",
    "adaptation=none", "compile=off",
)  # fmt: skip
GREEN, ORANGE, BLUE, RED = 160.0, 42.0, 205.0, 350.0
"""Hues of the target, and of the third section; of the second; of the first; of the sensors, degrees."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    started = chromium.started(tmp_path_factory.mktemp("browser"), *chromium.SOFTWARE_GL, size=(900, 640))
    yield started
    started.quit()


def until(what: Callable[[], bool]) -> None:
    """Waits until something is so."""
    end = time.monotonic() + SOON
    while not what():
        assert time.monotonic() < end, "it did not come to that"
        time.sleep(0.05)


@contextmanager
def running(run: Callable[[threading.Event], None]) -> Iterator[None]:
    over = threading.Event()
    thread = threading.Thread(target=run, args=(over,))
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def hues(browser: Any) -> np.ndarray:
    """How many strongly coloured pixels of the scene have each hue, by degrees."""
    try:
        picture = Image.open(io.BytesIO(browser.get_screenshot_as_png()))
    except exceptions.TimeoutException:  # without a graphics card, on a busy machine
        return np.zeros(360)
    pixels = np.asarray(picture.convert("HSV")).astype(float)
    scene = pixels[:, :560].reshape(-1, 3)
    strong = scene[(scene[:, 1] > 100) & (scene[:, 2] > 60)]
    return np.histogram(strong[:, 0] * 360.0 / 255.0, bins=360, range=(0.0, 360.0))[0]


def has(counts: np.ndarray, hue: float, within: int = 12) -> bool:
    return bool(counts[[int(hue + k) % 360 for k in range(-within, within)]].sum() > 60)


def visit(browser: Any, url: str) -> None:
    browser.get("about:blank")  # the page before ends, and with it its calls for a server that is gone
    browser.get_log("browser")
    browser.get(f"{url}/?fixedDpr=0.5")


def complaints(browser: Any, url: str) -> list[str]:
    """The console's errors, without those of the page before: they name another server, and may come late."""
    own = url.removeprefix("http://")
    return [error for error in chromium.errors(browser) if "ws://" not in error or own in error.split("ws://")[1]]


def opened(browser: Any, page: Page, *seen: float) -> None:
    visit(browser, page.address.url)
    until(lambda: all(has(hues(browser), hue) for hue in seen))
    assert complaints(browser, page.address.url) == []


def text(browser: Any) -> str:
    return str(browser.execute_script("return document.body.innerText"))


def pixel(browser: Any, page: Page, place: np.ndarray) -> tuple[int, int]:
    """Where a place (3,) m is in the only client's picture."""
    camera = next(iter(page.server.get_clients().values())).camera
    w, x, y, z = camera.wxyz
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    right, down, ahead = R.T @ (place - camera.position)
    width, height = browser.execute_script(
        "const box = document.querySelector('canvas').getBoundingClientRect(); return [box.width, box.height]"
    )
    scale = 0.5 * height / np.tan(0.5 * camera.fov)
    return round(0.5 * width + scale * right / ahead), round(0.5 * height + scale * down / ahead)


def test_the_arm_follows_a_target_that_the_mouse_drags(browser: Any) -> None:
    actions = pytest.importorskip("selenium.webdriver.common.action_chains", reason="selenium is not installed")
    pursuit = Pursuit(composed(*FAST))
    size = DrawnSize.of(pursuit.arm)
    with Page(ANY, "arm_1", size.length, size.upward) as page:
        follower = Follower(page, pursuit)
        opened(browser, page, GREEN, ORANGE, BLUE, RED)
        assert "payload" in text(browser) and "error of the tip" in text(browser)
        first = pursuit.target
        handle = first + np.array([0.13 * size.length, 0.0, 0.0])  # on the arrow of x
        (x, y), (to_x, to_y) = pixel(browser, page, handle), pixel(browser, page, handle + np.array([0.08, 0.0, 0.0]))
        mouse = actions.ActionChains(browser, duration=100)
        mouse.w3c_actions.pointer_action.move_to_location(x, y).pointer_down()
        mouse.w3c_actions.pointer_action.move_to_location((x + to_x) // 2, (y + to_y) // 2)
        mouse.w3c_actions.pointer_action.move_to_location(to_x, to_y).pointer_up()
        mouse.perform()
        until(lambda: pursuit.target[0] > first[0] + 0.04)
        assert np.abs(pursuit.target - first)[1:].max() < 1e-6, "along x alone"
        with running(follower.run):
            until(lambda: pursuit.error < 1e-3)
        assert np.linalg.norm(pursuit.moment().tip - pursuit.target) < 1e-3


def test_the_slider_moves_a_run_and_a_number_chooses_its_row(browser: Any, tmp_path: Path) -> None:
    keys = pytest.importorskip("selenium.webdriver.common.keys", reason="selenium is not installed").Keys
    done = simulate(tmp_path, *QUICK, "experiment.start_errors=1", "hydra.run.dir=run", "compile=off")
    assert done.returncode == 0, done.stderr
    run = recorded(tmp_path / "run")
    assert len(run.rows) == 2 and run.moment(0, 0).sections.shape[0] == 3
    with Page(ANY, run.name, *run.size[::2]) as page:
        player = Player(page, run)
        opened(browser, page, GREEN, ORANGE)
        with running(player.run):
            for label, value in (("time (s)", "0.1"), ("row", "1")):
                script = (
                    "return [...document.querySelectorAll('label')].find((l) => l.innerText === arguments[0]).htmlFor"
                )
                field = browser.find_element("id", browser.execute_script(script, label))
                if field.get_attribute("type") != "text":
                    field = field.find_element("xpath", "following::input[1]")
                field.send_keys(keys.CONTROL, "a")
                field.send_keys(value, keys.ENTER)
            until(lambda: player.row == 1 and player.time > 0.09)
            until(lambda: run.rows[1] in text(browser) and "0.10 of 0.10 s" in text(browser))
        last = run.moment(len(run.time) - 1, 1)
        middle = player.scene.nodes["arm/2"].vertices[-1]
        assert np.abs(middle - last.tip).max() < 1e-6, "the middle of the tube's end is the tip of that row then"


def test_a_run_on_an_arm_is_seen_live_and_is_the_same_as_unseen(browser: Any) -> None:
    build = builder()
    outline = Outline(build.backbone(), build.n_sections, build.routing())
    watched = Watched("a run", DrawnSize.of(build.arm), outline, build.sensors_at().shape[-1])
    with LiveView(watched, ANY) as view:
        run = fake_run(observers=(view,))
        visit(browser, view.address.url)
        until(lambda: has(hues(browser), ORANGE) and has(hues(browser), GREEN) and "disarmed" in text(browser))
        assert "173.2 mm" in text(browser) and "0, 150, -500 mm" in text(browser)
        assert complaints(browser, view.address.url) == []
    assert view.copies > 0 and not view.process.is_alive()
    unseen = fake_run()
    for one, other in zip(run.witness.ticks, unseen.witness.ticks, strict=True):
        assert one.time == other.time and (one.sent == other.sent).all() and one.overruns == other.overruns


def test_an_environment_is_shown_to_a_person(browser: Any) -> None:
    env = gymnasium.make("apcc_torch.envs:apcc/Reach-v0", render_mode="human")
    env.reset(seed=0)
    env.render()
    batch: Any = env.unwrapped
    window = batch.batch.window()
    assert isinstance(window, EnvWindow) and window.page is not None
    opened(browser, window.page, GREEN, ORANGE)
    before = window.scene.nodes["arm/2"].vertices.copy()
    for _ in range(6):
        env.step(np.ones(9, dtype=np.float32))
    assert np.abs(window.scene.nodes["arm/2"].vertices - before).max() > 1e-3
    until(lambda: "0.0" in text(browser) and "error" in text(browser))
    env.close()
    assert window.page is None
