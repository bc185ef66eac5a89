"""The picture of the page of a session in the documentation.

    gelflow demo --out runs/demo
    python -m benchmarks.view.page_picture runs/demo/session.mcap --at 22.66 --out docs/pictures/session_page.png

Needs Chromium, which draws by software.
"""

import argparse
import threading
import time
from pathlib import Path

import cv2
from tests.view.browser import browser

from gelflow.view import RecordedSession, SessionPage

_SIZE = (1280, 960)  # of the window [px]
_HIDE_NOTICE = "document.querySelectorAll('[role=alert]').forEach(notice => notice.remove())"  # of slow drawing
_SETTLE = 20.0  # time for the curves, and for Chromium to draw [s]


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("session", type=Path, help="MCAP file")
    parser.add_argument("--at", type=float, default=0.0, help="time since the start of the recording [s] (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("session_page.png"), help="picture to write (%(default)s)")
    args = parser.parse_args()
    ended = threading.Event()
    with RecordedSession(args.session) as session, SessionPage([session], port=0) as page, browser() as window:
        drawing = threading.Thread(target=page.run, kwargs={"until": ended.is_set}, name="page")
        drawing.start()
        try:
            window.driver.set_window_size(*_SIZE)
            window.open(page.url)
            page.go(args.at)
            time.sleep(_SETTLE)
            window.driver.execute_script(_HIDE_NOTICE)
            cv2.imwrite(str(args.out), window.picture())
        finally:
            ended.set()
            drawing.join()
    print(args.out)


if __name__ == "__main__":
    main()
