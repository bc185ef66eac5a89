"""A headless Chromium of the system, for tests of pages."""

import contextlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")

needs_browser = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None,
    reason="needs Chromium: apt-get install chromium chromium-driver",
)
WAIT = 120.0  # [s] for what a page does within a second on an idle machine


class Browser:
    """One window with one page."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def open(self, url: str) -> None:
        """Open a page and wait until it is connected and has its controls."""
        self.driver.get(url)
        self.wait(lambda: "Connected" in self.text())

    def text(self) -> str:
        return str(self.driver.execute_script("return document.body.innerText"))

    def press(self, label: str) -> None:
        """Press a button."""
        script = "return [...document.querySelectorAll('button')].filter(b => b.innerText.trim() === arguments[0])[0]"
        button: Any = None

        def found() -> bool:
            nonlocal button
            button = self.driver.execute_script(script, label)
            return button is not None

        self.wait(found)
        self.driver.execute_script("arguments[0].click()", button)

    def picture(self) -> NDArray[np.uint8]:
        """A screenshot, BGR (height, width, 3); Chromium gives up after 10 s when the machine is busy."""
        from selenium.common.exceptions import TimeoutException

        png = b""

        def taken() -> bool:
            nonlocal png
            with contextlib.suppress(TimeoutException):
                png = self.driver.get_screenshot_as_png()
            return bool(png)

        self.wait(taken)
        encoded = np.frombuffer(png, dtype=np.uint8)
        return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), dtype=np.uint8)

    def errors(self) -> list[str]:
        """Errors on the console since the last call."""
        return [entry["message"] for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]

    def foreign_requests(self) -> list[str]:
        """Requests to other hosts than 127.0.0.1 since the last call."""
        found = []
        for entry in self.driver.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] in ("Network.requestWillBeSent", "Network.webSocketCreated"):
                parameters = message["params"]
                url = parameters.get("url") or parameters["request"]["url"]
                if urlsplit(url).scheme not in ("data", "blob") and urlsplit(url).hostname != "127.0.0.1":
                    found.append(url)
        return found

    @staticmethod
    def wait(ready: Callable[[], bool]) -> None:
        deadline = time.monotonic() + WAIT
        while not ready():
            assert time.monotonic() < deadline, "the page did not get there in time"
            time.sleep(0.1)


@contextlib.contextmanager
def browser() -> Iterator[Browser]:
    """A headless window of 900 x 700 pixels that draws WebGL on the processor."""
    from selenium import webdriver
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = CHROMIUM or ""
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    flags = ["--headless=new", "--disable-dev-shm-usage", "--window-size=900,700"]
    flags += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-proxy-server"]
    if os.geteuid() == 0:
        flags.append("--no-sandbox")  # Chromium's sandbox does not start as root
    for flag in flags:
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    try:
        yield Browser(driver)
    finally:
        driver.quit()
