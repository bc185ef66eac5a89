"""A recorded session at any time: markers relative to the start of the attempt, heights, events, texts, pictures."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.common.manual_clock import ManualClock
from tests.view.session.made_session import (
    CONTACT,
    GRASP_HEIGHT,
    HOLE_HEIGHT,
    LAB,
    LOOK,
    MOUNT,
    SHEAR,
    joints_at,
    make_session,
)

from gelflow.errors import PeerError, UsageError
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.protocols import CameraImage
from gelflow.real.kinematics import HOME, forward, link_frames
from gelflow.session import SessionRecorder, describe_session
from gelflow.session.decision_replay import Comparison
from gelflow.task import INSERTION
from gelflow.view.session.curves import Curves, read_curves
from gelflow.view.session.pad_pictures import decision_picture, pads_picture
from gelflow.view.session.recorded_session import RecordedSession
from gelflow.view.session.session_page import SessionPage
from gelflow.view.session.snapshot_text import comparison_text, snapshot_text
from gelflow.view.session.timeline import HEIGHT, WIDTH, Timeline


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("session") / "made.mcap"
    make_session(made)
    return made


@pytest.fixture
def session(path: Path) -> Iterator[RecordedSession]:
    with RecordedSession(path) as opened:
        yield opened


def test_events_are_the_attempts_decisions_warnings_and_stops(session: RecordedSession) -> None:
    found = [
        (m.kind, round(m.time - session.start, 2), round(m.end - session.start, 2)) for m in session.timeline_events
    ]
    assert found == [
        ("not inserted", 3.0, 7.0),
        ("warning", 6.0, 6.0),
        ("decision", 7.0, 7.0),
        ("inserted", 8.5, 11.0),
    ]
    assert session.timeline_events[2].text == "decision: x +1.00 mm, y -2.00 mm, yaw +2.9°"


def test_first_view_has_both_images_and_the_arm(session: RecordedSession) -> None:
    snapshot = session.at(session.first_view, markers=False)
    assert all(pad is not None for pad in snapshot.pads) and snapshot.joints is not None
    before = session.at(session.first_view - 1e-3, markers=False)
    assert before.joints is None or any(pad is None for pad in before.pads)


@pytest.mark.parametrize(("seconds", "shear"), [(4.95, 0.0), (5.0, SHEAR), (6.8, SHEAR), (7.5, 0.0), (1.0, 0.0)])
def test_markers_are_relative_to_the_start_of_the_attempt(
    session: RecordedSession, seconds: float, shear: float
) -> None:
    for sensor in range(2):
        assert session.markers.shear(sensor, session.start + seconds + 1e-3) == pytest.approx(shear, abs=5e-3)
    snapshot = session.at(session.start + seconds + 1e-3)
    for pad in snapshot.pads:
        assert pad is not None and pad.tracked is not None
        assert MOUNT.pixels_per_mm is not None
        along = np.nanmean(pad.tracked.displacement[:, 1]) / MOUNT.pixels_per_mm  # the tip is below
        assert along == pytest.approx(shear, abs=5e-3)


def test_a_moment_is_what_was_recorded_last(session: RecordedSession) -> None:
    snapshot = session.at(session.start + 6.55)
    assert (snapshot.phase, snapshot.insertion, snapshot.attempt) == ("descend", 0, 0)
    assert snapshot.part_held and snapshot.decision is None
    assert snapshot.joints is not None and snapshot.flange is not None and session.cell is not None
    seconds = 6.5
    joints = joints_at(seconds)
    np.testing.assert_allclose(snapshot.joints, joints, atol=1e-12)
    position, _ = forward(joints.tolist())
    np.testing.assert_allclose(snapshot.flange.position, position, atol=1e-12)
    assert snapshot.pads[0] is not None
    assert snapshot.pads[0].stamp == pytest.approx(session.start + seconds, abs=1e-6)
    later = session.at(session.start + 7.2)
    assert later.phase == "retreat" and later.attempt is None and later.decision is not None


def test_height_is_that_of_the_lower_face_above_the_floor(session: RecordedSession) -> None:
    snapshot = session.at(session.start + 6.55)
    assert snapshot.flange is not None and session.cell is not None
    gripper = session.cell.gripper(snapshot.flange).position[2]
    assert session.cell.part_height(snapshot.flange) == pytest.approx(gripper - HOLE_HEIGHT - GRASP_HEIGHT)


def test_curves_have_the_values_of_the_records(session: RecordedSession) -> None:
    curves = Curves(session.start, session.end)
    rounds = sum(1 for _ in read_curves(session, curves, samples=60))
    assert rounds == 6
    for curve in curves.shear:
        times, values = curve.ordered()
        seconds = times - session.start
        inside = (seconds > CONTACT[0] + 0.1) & (seconds < CONTACT[1] - 0.1)
        assert inside.sum() > 5
        np.testing.assert_allclose(values[inside], SHEAR, atol=5e-3)
        np.testing.assert_allclose(values[seconds < CONTACT[0] - 0.1], 0.0, atol=5e-3)
    times, force = curves.force.ordered()
    assert set(np.round(force, 6)) == {0.0, 12.0}
    assert (np.diff(times) > 0).all()


def test_text_states_numbers_and_differences(session: RecordedSession) -> None:
    snapshot = session.at(session.start + 7.2)
    text = snapshot_text(snapshot, session)
    for part in ("**7.20 s** of 11.9 s", "phase **retreat**", "35.00 mm, 12.0 N, holding", "x +1.00 mm, y -2.00 mm"):
        assert part in text
    decision = snapshot.decision
    assert decision is not None
    repeated = Comparison(decision, decision.observation, decision.action)
    assert comparison_text(repeated) == "replay: identical"
    moved = Comparison(decision, decision.observation, decision.action + np.array([1e-3, 0.0, 0.0]))
    assert "replay differs" in comparison_text(moved) and "x +2.000 mm" in comparison_text(moved)


def test_pictures_show_displacements_and_the_present(session: RecordedSession) -> None:
    rest, contact = (pads_picture(session.at(session.start + t).pads) for t in (4.0, 6.0))
    assert rest.shape == contact.shape
    assert (np.abs(rest.astype(int) - contact).max(-1) > 60).mean() > 0.01
    line = Timeline(
        Curves(session.start, session.end), session.timeline_events, origin=session.start, topics=session.index.topics()
    )
    early, late = (line.with_present(session.start + t) for t in (1.0, 9.0))
    assert early.shape == (HEIGHT, WIDTH, 3)
    column = [int(np.flatnonzero((a != b).any(axis=(0, 2)))[0]) for a, b in ((early, late), (late, early))]
    assert column[0] == column[1]
    changed = np.flatnonzero((early != late).any(axis=(0, 2)))
    width = changed[-1] - changed[0]
    assert width / WIDTH == pytest.approx(8.0 / 11.9 * 0.88, abs=0.02)  # 0.88 of the picture are the axes
    decision = session.decisions[0].value
    assert decision_picture(Comparison(decision, decision.observation, decision.action), INSERTION.grid).std() > 5


def test_timeline_has_axes_for_what_was_recorded() -> None:
    curves = Curves(0.0, 10.0)
    pictures = {
        topics: Timeline(curves, [], origin=0.0, topics=topics).with_present(5.0)
        for topics in [(), ("/left/force",), ("/arm/pose",), ("/arm/pose", "/gripper/state")]
    }
    # Dark rows are the frames of axes: two for the events and for each of the curves.
    dark = [picture[:, 120:600].mean((1, 2)) < 160 for picture in pictures.values()]
    assert [int((np.diff(rows.astype(int)) == 1).sum()) for rows in dark] == [4, 6, 6, 8]


def test_forces_of_the_pads_are_shown_where_they_are_recorded(tmp_path: Path) -> None:
    clock = ManualClock(100.0)
    with SessionRecorder(tmp_path / "forces.mcap", clock) as recorder:
        recorder.event("insertion", {"number": 0})
        for number in range(20):
            clock.time = 100.0 + 0.1 * number
            force = {
                "contact": number >= 5, "normal": 0.5 * number, "normal_deviation": 0.25,
                "shear": [0.3, 0.4], "shear_deviation": [0.1, 0.1],
                "stick_share": 0.8, "stick_share_deviation": 0.1, "gross_slip": number >= 15,
            }  # fmt: skip
            recorder.force(1, clock.time, force)
        clock.time = 105.0
        recorder.event("insertion ended", {"number": 0})
    with RecordedSession(tmp_path / "forces.mcap") as session:
        texts = [snapshot_text(session.at(time), session) for time in (100.05, 101.05, 101.85, 104.0)]
        assert "right pad: no contact" in texts[0] and "left pad" not in texts[0]
        assert "right pad: normal 5.00 ± 0.25 N, shear 0.50 N, sticks 80 ± 10 %" in texts[1]
        assert "**gross slip**" in texts[2]
        assert "right pad" not in texts[3]  # the last force is old
        curves = Curves(session.start, session.end)
        for _ in read_curves(session, curves):
            pass
        assert not curves.normal[0].samples and not curves.force.samples
        np.testing.assert_allclose(curves.normal[1].ordered()[1], 0.5 * np.arange(20))
        assert len(curves.gross_slip.samples) == 5
        drawn, empty = (
            Timeline(shown, [], origin=session.start, topics=session.index.topics()).with_present(100.0)
            for shown in (curves, Curves(session.start, session.end))
        )
        assert (drawn != empty).any()


def test_forces_that_are_not_finite_are_shown(tmp_path: Path) -> None:
    clock = ManualClock(100.0)
    with SessionRecorder(tmp_path / "forces.mcap", clock) as recorder:
        nan = float("nan")
        force = {
            "contact": True, "normal": nan, "normal_deviation": nan, "shear": [nan, 0.4], "shear_deviation": [nan, nan],
            "stick_share": nan, "stick_share_deviation": nan, "gross_slip": False,
        }  # fmt: skip
        recorder.force(0, clock.time, force)
    with RecordedSession(tmp_path / "forces.mcap") as session:
        assert "left pad: normal nan ± nan N, shear nan N, sticks nan ± nan %" in snapshot_text(
            session.at(session.end), session
        )


def test_an_event_named_state_without_a_phase_is_no_phase(tmp_path: Path) -> None:
    clock = ManualClock(100.0)
    with SessionRecorder(tmp_path / "own.mcap", clock) as recorder:
        recorder.event("state")
        recorder.event("state", {"temperature": 21.0})
        recorder.event("state", {"state": "descend"})
    with RecordedSession(tmp_path / "own.mcap") as session:
        assert session.at(session.end).phase == "descend" and session.timeline_events == []


def test_links_of_the_arm_follow_each_other() -> None:
    rng = np.random.default_rng(0)
    for joints in (list(HOME), *rng.uniform(-1, 1, (5, 6)).tolist()):
        frames = link_frames(joints)
        assert len(frames) == 6
        end, (position, quaternion) = frames[-1], forward(joints)
        np.testing.assert_allclose(end[0], position, atol=1e-12)
        np.testing.assert_allclose(np.abs(np.dot(end[1], quaternion)), 1.0, atol=1e-12)
        np.testing.assert_allclose(frames[0][0], [0, 0, 0.29], atol=1e-12)
        assert np.linalg.norm(np.subtract(frames[1][0], frames[0][0])) == pytest.approx(0.27)


@pytest.mark.parametrize("mounts", [[{}] * 2, None])
def test_what_a_session_lacks_is_stated_and_the_rest_is_shown(tmp_path: Path, mounts: list[dict[str, float]]) -> None:
    clock = ManualClock(5.0)
    path = tmp_path / "poor.mcap"
    with SessionRecorder(path, clock) as recorder:
        described = describe_session(task=INSERTION, trackers=[{"lines": 3}] * 2, mounts=[{}] * 2, lab={"arm": {}})
        recorder.metadata({**described, "mounts": mounts})
        recorder.image(0, CameraImage(b"\xff\xd8no picture\xff\xd9", 5.0, 0))
        clock.time = 6.0
        recorder.event("stopped", {"reason": "test"})
    with RecordedSession(path) as session:
        assert session.cell is None
        snapshot = session.at(session.end)
        assert snapshot.pads[0] is not None and snapshot.pads[0].problem and snapshot.pads[1] is None
        text = snapshot_text(snapshot, session)
        assert "no robot is shown" in text and "no markers are shown" in text
        assert pads_picture(snapshot.pads).ndim == 3
        assert [event.kind for event in session.timeline_events] == ["stop"]


def test_a_recording_of_track_starts_with_its_first_image(tmp_path: Path) -> None:
    clock = ManualClock(0.0)  # its description has no time
    with SessionRecorder(tmp_path / "tracked.mcap", clock) as recorder:
        recorder.metadata({"format": 1, "source": "images"})
        for clock.time in (500.0, 502.0):
            recorder.image(0, CameraImage(b"\xff\xd8no picture\xff\xd9", clock.time, int(clock.time)))
    with RecordedSession(tmp_path / "tracked.mcap") as session:
        assert (session.start, session.end, session.first_view) == (500.0, 502.0, 500.0)
        assert session.cell is None and session.notes == []


def test_recorded_markers_of_an_unknown_camera_give_a_curve_in_pixels(tmp_path: Path) -> None:
    clock = ManualClock(0.0)
    black = cv2.imencode(".jpg", np.zeros((8, 8, 3), dtype=np.uint8))[1].tobytes()
    with SessionRecorder(tmp_path / "tracked.mcap", clock) as recorder:
        recorder.metadata({"format": 1, "source": "images"})
        for clock.time in (500.0, 502.0):
            recorder.image(0, CameraImage(black, clock.time, int(clock.time)))
            moved = np.full((1, 2), 3.0 * (clock.time - 500.0))
            markers = {
                "rows": 1, "cols": 1, "spacing_px": 9.0, "position_px": moved, "displacement_px": moved,
                "valid": [True], "inferred": [False], "quality": [1.0],
            }  # fmt: skip
            recorder.markers(0, clock.time, markers)
    with RecordedSession(tmp_path / "tracked.mcap") as session:
        curves = Curves(session.start, session.end)
        for _ in read_curves(session, curves):
            pass
        assert not curves.shear_in_millimetres
        assert curves.shear[0].ordered()[1][[0, -1]] == pytest.approx([0.0, 6 * np.sqrt(2)])


def test_files_that_are_no_sessions_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("hello")
    with pytest.raises(UsageError, match="not an MCAP file"):
        RecordedSession(tmp_path / "text.mcap")
    with pytest.raises(UsageError, match="cannot open"):
        RecordedSession(tmp_path / "none.mcap")
    with SessionRecorder(tmp_path / "empty.mcap", ManualClock(1.0)):
        pass
    with pytest.raises(PeerError, match="nothing to show"):
        RecordedSession(tmp_path / "empty.mcap")


def test_markers_of_a_growing_session_are_shown_once_an_image_is_readable(tmp_path: Path) -> None:
    clock, path, renderer = ManualClock(5.0), tmp_path / "session.mcap", FastGelRenderer(LOOK)
    black = cv2.imencode(".jpg", np.zeros((480, 640, 3), dtype=np.uint8))[1].tobytes()
    with SessionRecorder(path, clock) as recorder:
        recorder.metadata(
            describe_session(task=INSERTION, trackers=[MOUNT.tracker_config()] * 2, mounts=[MOUNT] * 2, lab=LAB)
        )
        recorder.image(0, CameraImage(black, clock.time, 0))
        recorder.attempt_end()  # stores everything
        with RecordedSession(path) as session:
            pad = session.markers.pad(0, session.end)
            assert pad is not None and pad.tracked is None and pad.problem
            for number in range(1, 40):
                clock.time = 5.0 + 0.1 * number
                if number == 5:
                    recorder.event("state", {"state": "descend"})
                picture = renderer.render(np.zeros_like(LOOK.positions_mm()), sequence=number)
                recorder.image(0, CameraImage(renderer.encode(picture), clock.time, number))
            recorder.attempt_end()
            assert session.refresh()
            pad = session.markers.pad(0, session.end)
            assert pad is not None and pad.problem == ""
            assert pad.tracked is not None and pad.tracked.valid.mean() > 0.9


def test_a_session_that_is_being_recorded_grows(tmp_path: Path) -> None:
    clock = ManualClock(5.0)
    path = tmp_path / "session.mcap"
    with SessionRecorder(path, clock) as recorder:
        recorder.event("state", {"state": "descend"})
        recorder.attempt_end()  # stores everything
        with RecordedSession(path) as session:
            assert session.growing and session.end == pytest.approx(5.0)
            assert not session.refresh()
            clock.time = 7.0
            recorder.attempt_end({"insertion": 0, "attempt": 0, "outcome": "inserted"})
            assert session.refresh()
            assert session.end == pytest.approx(7.0)
            (event,) = session.timeline_events
            assert event.kind == "inserted"
            assert (event.time, event.end) == pytest.approx((5.0, 7.0))
            assert session.at(6.0).phase == "descend"
            recorder.close()
            session.refresh()
            assert not session.growing


class Steps(threading.Event):
    """Ends no reading; each wait of the reader does the next step instead."""

    def __init__(self, *steps: Callable[[], object]) -> None:
        super().__init__()
        self._steps = iter(steps)

    def wait(self, timeout: float | None = None) -> bool:
        next(self._steps, lambda: None)()
        return False


@pytest.mark.parametrize(("seconds", "end"), [(10.0, 15.0), (20.0, 40.0)])
def test_a_range_grows_with_the_session_only_if_it_reaches_its_end(tmp_path: Path, seconds: float, end: float) -> None:
    clock = ManualClock(5.0)
    recorder = SessionRecorder(tmp_path / "session.mcap", clock).open()
    recorder.event("first")
    clock.time = 25.0
    recorder.attempt_end({"insertion": 0, "attempt": 0, "outcome": "inserted"})
    with RecordedSession(recorder.path) as session, SessionPage([session], port=0) as page:

        def add(time: float) -> None:
            clock.time = time
            recorder.attempt_end({"insertion": 0, "attempt": 1, "outcome": "inserted"})
            session.refresh()

        def finish() -> None:
            clock.time = 40.0
            recorder.event("last")
            recorder.close()
            session.refresh()

        (panel,) = page._panels
        panel.show_range(5.0, 5.0 + seconds)
        panel.close()
        # The session ends after a pass of the reader, which therefore takes another one.
        panel._read(panel._curves, Steps(lambda: add(30.0), finish))
        assert not session.growing and panel._curves.end == pytest.approx(end)
