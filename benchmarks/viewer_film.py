"""The film of the viewer: `python benchmarks/viewer_film.py`, a few minutes, writes docs/images/viewer.gif.

A Chromium without a window opens the page of python -m apcc_torch.view arm_1. Its target is moved as a mouse would move
it, a load is hung on the arm on the way, and each picture is taken once the page shows that moment: the film runs at
the speed of the arm, however slow the machine is. It needs selenium, Chromium and its driver.
"""

from __future__ import annotations

import argparse
import io
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from selenium import webdriver

from apcc_torch.composed import compose
from apcc_torch.files import write_atomically
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.follower import Follower
from apcc_torch.viewing.page import Page
from apcc_torch.viewing.pursuit import Pursuit
from apcc_torch.web_address import WebAddress

FILM = Path(__file__).resolve().parent.parent / "docs" / "images" / "viewer.gif"
WORDS = ("experiment=setpoint", "arm=arm_1", "controller.K=3", "compile=auto")
SIZE, RATE = (1000, 620), 10
"""Pixels of the page, and pictures in a second."""
COLORS = 255
PLAN = (
    *((0.0, (0.0, 0.15, -0.5)), (0.5, (0.0, 0.15, -0.5)), (1.7, (0.28, 0.05, -0.42)), (3.7, (0.28, 0.05, -0.42))),
    *((4.9, (-0.18, -0.22, -0.46)), (7.0, (-0.18, -0.22, -0.46)), (8.2, (0.0, 0.15, -0.5)), (10.0, (0.0, 0.15, -0.5))),
)
"""Where the target is, m, at what time, s; in between it is drawn along."""
LOADED, LOAD = 2.6, 0.3
"""When the load is hung on the tip, s, and its mass, kg."""
FLAGS = (
    *("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars"),
    *("--ignore-gpu-blocklist", "--disable-background-networking", "--no-first-run"),
)
WAIT = 120.0
"""Longest that a page may take to show a moment, s."""


def browser() -> Any:
    """Chromium without a window."""
    options = webdriver.ChromeOptions()
    binary = shutil.which("chromium") or shutil.which("google-chrome")
    if binary is not None:
        options.binary_location = binary
    for flag in (*FLAGS, f"--window-size={SIZE[0]},{SIZE[1]}", f"--user-data-dir={tempfile.mkdtemp()}"):
        options.add_argument(flag)
    return webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))


def target(at: float) -> np.ndarray:
    """(3,) m."""
    times, places = zip(*PLAN, strict=True)
    k = int(np.searchsorted(times, at, side="right").clip(1, len(times) - 1))
    share = min(max((at - times[k - 1]) / (times[k] - times[k - 1]), 0.0), 1.0)
    share = share * share * (3.0 - 2.0 * share)  # it starts and stops gently
    return (1.0 - share) * np.array(places[k - 1]) + share * np.array(places[k])


def shown(driver: Any, text: str) -> None:
    """Waits until the page says something, and has drawn it."""
    end = time.monotonic() + WAIT
    while text not in str(driver.execute_script("return document.body.innerText")):
        if time.monotonic() > end:
            raise TimeoutError(f"the page does not show {text!r}")
        time.sleep(0.02)
    script = "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(done))"
    driver.execute_async_script(script)
    driver.execute_async_script(script)


def pictures(driver: Any, follower: Follower) -> Iterator[Image.Image]:
    """The film's pictures."""
    pursuit = follower.pursuit
    steps = round(1.0 / (RATE * pursuit.period))
    for k in range(round(PLAN[-1][0] * RATE) + 1):
        at = k / RATE
        follower.aim(target(at))
        if at >= LOADED and follower.payload.value != LOAD:
            follower.payload.value = LOAD
        if k:
            follower.advance(steps)
        follower.show()
        shown(driver, f"{pursuit.time:.1f} s\n")
        yield Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")


def colored(taken: list[Image.Image]) -> list[Image.Image]:
    """The pictures in one palette, made of where the arm is, which is a small part of them."""
    width, height = taken[0].size
    parts = [picture.crop((0, 0, round(0.68 * width), round(0.75 * height))) for picture in taken[::6]]
    sheet = np.concatenate([np.asarray(part).reshape(-1, 3) for part in parts])
    sheet = sheet[sheet.max(-1) - sheet.min(-1) > 24]  # what is coloured
    sheet = np.concatenate((sheet, np.asarray(taken[-1]).reshape(-1, 3)))
    palette = Image.fromarray(sheet[None]).quantize(COLORS, method=Image.Quantize.MAXCOVERAGE)
    return [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in taken]


def main() -> None:
    """Writes the film."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=FILM, help="where to; docs/images/viewer.gif if not given")
    out = parser.parse_args().out
    pursuit = Pursuit(compose(*WORDS).settings)
    size = DrawnSize.of(pursuit.arm)
    driver = browser()
    driver.set_script_timeout(WAIT)
    with Page(WebAddress(port=0), "arm_1", size.length, size.upward) as page:
        follower = Follower(page, pursuit)
        driver.get(f"{page.address.url}/?fixedDpr=1")
        shown(driver, "What is shown")
        time.sleep(2.0)  # fonts and shaders
        for mark in driver.find_elements("css selector", ".mantine-Notification-closeButton"):
            mark.click()  # that there is no graphics card
        time.sleep(1.0)
        taken = list(pictures(driver, follower))
    driver.quit()
    film = colored(taken)
    content = io.BytesIO()
    film[0].save(content, "GIF", save_all=True, append_images=film[1:], duration=1000 // RATE, loop=0, optimize=True)
    write_atomically(out, content.getvalue())
    print(f"{out}: {len(film)} pictures, {len(content.getvalue()) / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
