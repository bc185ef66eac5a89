"""The page of sessions in a real browser and without one, and the errors of its command."""

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.view.browser import Browser, browser, needs_browser
from tests.view.session.made_session import make_session

from gelflow.cli.main import main
from gelflow.session.decision_replay import Comparison
from gelflow.view.session.recorded_session import RecordedSession
from gelflow.view.session.session_page import SessionPage


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("sessions")
    made = [folder / "first.mcap", folder / "second.mcap"]
    make_session(made[0])
    make_session(made[1], shift=0.5, start=900.0)
    return made


@pytest.fixture
def window() -> Iterator[Browser]:
    with browser() as opened:
        opened.driver.set_window_size(1500, 950)
        yield opened


def serve(page: SessionPage, ended: threading.Event) -> threading.Thread:
    loop = threading.Thread(target=lambda: page.run(until=ended.is_set))
    loop.start()
    return loop


@needs_browser
def test_a_drag_on_the_timeline_changes_images_and_poses(paths: list[Path], window: Browser) -> None:
    ended = threading.Event()
    with RecordedSession(paths[0]) as session:
        decision = session.decisions[0].value
        moved = Comparison(decision, decision.observation, decision.action + 1e-3)
        with SessionPage([session], comparisons=[moved], port=0) as page:
            loop = serve(page, ended)
            try:
                window.open(page.url)
                window.wait(lambda: "0.00 s of 11.9 s" in window.text())
                window.wait(lambda: "markers: displacement since" in window.text())
                before = window.picture()
                drag(window, 0.55)
                window.wait(lambda: page.time > 6.0)
                window.wait(lambda: f"{page.time:.2f} s of" in window.text())
                assert 6.0 < page.time < 7.0
                after = window.picture()
                changed = (np.abs(before.astype(int) - after).max(-1) > 40).sum(axis=0)
                middle = changed.shape[0] // 2
                assert changed[:540].sum() > 1000  # images and timeline
                assert changed[560 : middle + 350].sum() > 100  # the arm
                for expected in ("7.00 s of", "8.50 s of", "11.90 s of"):
                    window.press("Next")
                    wait_for(window, expected)
                for expected in ("8.50 s of", "7.00 s of"):
                    window.press("Previous")
                    wait_for(window, expected)
                window.wait(lambda: "replay differs" in window.text())
                window.press("Play")
                window.wait(lambda: page.time > 7.5)
                window.press("Pause")
                assert window.errors() == []
                assert window.foreign_requests() == []
            finally:
                ended.set()
                loop.join()


def wait_for(window: Browser, text: str) -> None:
    window.wait(lambda: text in window.text())


def drag(window: Browser, fraction: float) -> None:
    """Drag the handle of the time slider to a fraction of its length."""
    from selenium.webdriver.common.action_chains import ActionChains

    script = """
        const thumb = document.querySelector('.mantine-Slider-thumb');
        const box = document.querySelector('.mantine-Slider-track').getBoundingClientRect();
        return [thumb, box.width];
    """
    thumb, width = window.driver.execute_script(script)
    ActionChains(window.driver).drag_and_drop_by_offset(thumb, round(fraction * width), 0).perform()


@needs_browser
def test_two_sessions_side_by_side_can_be_aligned_at_an_attempt(paths: list[Path], window: Browser) -> None:
    ended = threading.Event()
    with (
        RecordedSession(paths[0]) as first,
        RecordedSession(paths[1]) as second,
        SessionPage([first, second], port=0) as page,
    ):
        loop = serve(page, ended)
        try:
            window.open(page.url)
            window.wait(lambda: "first.mcap" in window.text() and "second.mcap" in window.text())
            window.wait(lambda: window.text().count("0.00 s of 11.9 s") == 2)
            page._post(page._align, "insertion 0, attempt 1")
            page.go(8.5)
            window.wait(lambda: "8.50 s of" in window.text() and "9.00 s of" in window.text())
            assert window.text().count("insertion 0, attempt 1") >= 2
            assert window.errors() == []
        finally:
            ended.set()
            loop.join()


def test_playing_stops_at_the_end_of_the_range(paths: list[Path]) -> None:
    with RecordedSession(paths[0]) as session, SessionPage([session], port=0) as page:
        for start in (6.99, 0.0, 7.5):  # the attempt lasts from 3 to 7 s
            page._go(start)
            page._show_range("this attempt")
            page._toggle()
            page._before -= 60.0  # as if the last update were long ago
            page.update()
            assert page.time == pytest.approx(7.0) and not page.playing
            assert page._range == pytest.approx((3.0, 7.0))


def test_two_aligned_sessions_are_shown_to_the_end_of_the_later_one(paths: list[Path]) -> None:
    with (
        RecordedSession(paths[1]) as first,
        RecordedSession(paths[0]) as second,
        SessionPage([first, second], port=0) as page,
    ):
        page._align("insertion 0, attempt 1")  # half a second earlier in the second session
        page._go(100.0)
        assert page._show_if_moved()
        assert page.time == pytest.approx(12.4)
        assert page._snapshots[1].time == pytest.approx(second.end)
        page._align("starts of the recordings")
        assert page.time == pytest.approx(11.9)


def test_wrong_arguments_end_with_one_line(
    paths: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = str(paths[0])
    (tmp_path / "BAD.MCAP").write_bytes(paths[0].read_bytes()[:-100])
    (tmp_path / "bad.mcap").write_bytes(paths[0].read_bytes()[:-100])
    for arguments, expected in (
        ([first, "rolling"], "one session or two"),
        ([first, first, first], "one session or two"),
        (["rolling", "pushing"], "name one scene"),
        ([first, "--num-envs", "3"], "--num-envs is for scenes"),
        (["rolling", "--replay"], "--replay needs one session"),
        ([first, "--checkpoint", "a"], "add --replay"),
        ([str(tmp_path / "none.mcap")], "cannot open"),
        ([str(tmp_path / "bad.mcap")], "gelflow recover"),
        ([str(tmp_path / "BAD.MCAP")], "gelflow recover"),
        ([first, "--replay"], "names no checkpoint"),
    ):
        assert main(["view", *arguments, "--port", "0"]) == 2, arguments
        output = capsys.readouterr()
        assert expected in output.err and output.err.count("\n") == 1, output.err
