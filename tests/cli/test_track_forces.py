"""`gelflow track --gel`: forces in tables, recordings, pictures and the summary."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.common.manual_clock import ManualClock

from gelflow.cli.main import main
from gelflow.gel.gel_file import ElasticGel, load_gel
from gelflow.perception.benchmark.slip import SlippingContact, contact_states
from gelflow.perception.frames import CameraMount
from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer
from gelflow.perception.synthetic.appearance import make_appearance
from gelflow.perception.synthetic.pressed_layer import Press, PressedGel, PressedLayer
from gelflow.perception.synthetic.slipping_layer import RigidObject
from gelflow.protocols import CameraImage
from gelflow.session.reader import SessionReader
from gelflow.session.recorder import SessionRecorder
from gelflow.session.records import describe_session
from gelflow.task import INSERTION

GEL = "format = 1\n[gel]\nyoungs_modulus = 1.5e5\npoisson_ratio = 0.48\nthickness = 0.003\n"
LOOK = make_appearance("clean", width=640, height=480)
PRESS = Press("disc", (1.0, -2.0), 3.0, 0.0, normal=1.0, ratio=0.3, direction=0.0)  # shear down the image


@pytest.fixture(scope="module")
def pressed() -> PressedGel:
    return PressedLayer(ElasticGel(1.5e5, 0.48, 3e-3), LOOK.grid).press(PRESS)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory, pressed: PressedGel) -> Path:
    """Six images: two at rest, then the load grows."""
    folder = tmp_path_factory.mktemp("pressed")
    (folder / "gel.toml").write_text(GEL)
    (folder / "images").mkdir()
    renderer = AccurateGelRenderer(LOOK)
    for number, share in enumerate((0.0, 0.0, 0.25, 0.5, 0.75, 1.0)):
        rendered = renderer.render(share * pressed.displacement_mm, number=number)
        (folder / "images" / f"{number}.jpg").write_bytes(rendered.jpeg)
    return folder


def test_forces_are_written_everywhere(
    images: Path, pressed: PressedGel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / name for name in ("a.forces.csv", "a.mcap", "a.png")]
    outputs = [text for file in files for text in ("--out", str(file))]
    scale = ["--pixels-per-mm", str(LOOK.pixels_per_mm), "--gel", str(images / "gel.toml")]
    assert main(["track", str(images / "images"), *scale, *outputs, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["force"]["normal"] == pytest.approx(pressed.normal, rel=0.1) and summary["force_at"] == "5.jpg"
    with files[0].open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert [row["contact"] for row in rows] == ["0", "0", "1", "1", "1", "1"]
    assert float(rows[-1]["normal_n"]) == pytest.approx(pressed.normal, rel=0.1)
    assert float(rows[-1]["shear_down_n"]) == pytest.approx(pressed.shear[0], abs=0.03)
    assert float(rows[-1]["shear_right_n"]) == pytest.approx(pressed.shear[1], abs=0.03)
    assert float(rows[-1]["centre_down_mm"]) == pytest.approx(pressed.centre_mm[0], abs=0.3)
    assert float(rows[0]["normal_n"]) == 0 and rows[0]["centre_down_mm"] == ""
    with SessionReader(files[1]) as session:
        recorded = [record.value for record in session.records(["/left/force"])]
    assert [value["contact"] for value in recorded] == [False, False, True, True, True, True]
    assert recorded[-1]["normal"] == pytest.approx(float(rows[-1]["normal_n"]), abs=1e-4)
    assert cv2.imread(str(files[2])) is not None


def test_the_scale_is_in_pixels_of_the_image_as_the_camera_sends_it(
    images: Path, pressed: PressedGel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "half.toml").write_text('format = 1\ntitle = "half"\n[image]\nreduce = 2\n[markers]\npitch_mm = 1.4\n')
    words = ["track", str(images / "images"), "--profile", str(tmp_path / "half.toml")]
    words += ["--gel", str(images / "gel.toml"), "--pixels-per-mm"]
    assert main([*words, str(LOOK.pixels_per_mm)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert f"{LOOK.pixels_per_mm / 2:.2f} px/mm everywhere in images at 1/2 of their size" in told and "(5.jpg)" in told
    assert main([*words, str(LOOK.pixels_per_mm), "--json"]) == 0
    force = json.loads(capsys.readouterr().out)["force"]
    assert force["normal"] == pytest.approx(pressed.normal, rel=0.15)
    assert main([*words, str(LOOK.pixels_per_mm / 2)]) == 2
    assert "but the pitch of the profile is 1.4 mm: --pixels-per-mm" in capsys.readouterr().err


def test_markers_far_apart_on_a_thin_gel_give_a_warning(images: Path, tmp_path: Path) -> None:
    (tmp_path / "thin.toml").write_text(GEL.replace("0.003", "0.001"))
    words = ["track", str(images / "images"), "--images", "2", "--pixels-per-mm", str(LOOK.pixels_per_mm)]
    with pytest.warns(UserWarning, match=r"markers 1.4 mm apart .* a gel 1 mm thick: check the scale"):
        assert main([*words, "--gel", str(tmp_path / "thin.toml")]) == 0


@pytest.mark.parametrize("calibrated", [False, True])
def test_a_grid_that_is_rotated_in_the_image_has_the_same_forces(
    calibrated: bool, images: Path, pressed: PressedGel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    renderer = AccurateGelRenderer(replace(LOOK, width=880, height=760))
    folder = tmp_path / "turned"
    folder.mkdir()
    turn = cv2.getRotationMatrix2D((439.5, 379.5), -15.0, 1.0)  # clockwise
    for number, share in enumerate((0.0, 0.5, 1.0)):
        picture = renderer.render(share * pressed.displacement_mm, number=number).image
        turned = cv2.warpAffine(picture, turn, (880, 760), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        cv2.imwrite(str(folder / f"{number}.png"), turned)
    scale = ["--pixels-per-mm", str(LOOK.pixels_per_mm)]
    if calibrated:
        scale = ["--calibration", str(tmp_path / "fit.json")]
        spacing = ["--spacing-mm", str(LOOK.grid.pitch), "--out", scale[1]]
        assert main(["calibrate-camera", str(folder / "0.png"), *spacing]) == 0
        capsys.readouterr()
    assert main(["track", str(folder), *scale, "--gel", str(images / "gel.toml"), "--json"]) == 0
    force = json.loads(capsys.readouterr().out)["force"]
    assert force["normal"] == pytest.approx(pressed.normal, rel=0.1)
    assert abs(force["moment"]) < 8e-5  # [N m]; in the axes of the image it would be 1.8e-4
    np.testing.assert_allclose(force["shear"], turn[:, :2] @ pressed.shear[::-1], atol=0.03)
    np.testing.assert_allclose(force["centre_mm"], turn[:, :2] @ pressed.centre_mm[::-1], atol=0.3)


@pytest.fixture(scope="module")
def slipping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball that is pressed and pulled until it slips, at 25 images a second."""
    folder = tmp_path_factory.mktemp("slipping")
    (folder / "known.toml").write_text(GEL + "friction = 0.4\n")
    (folder / "unknown.toml").write_text(GEL)
    (folder / "images").mkdir()
    gel = ElasticGel(1.5e5, 0.48, 3e-3)
    ball = RigidObject("ball", 0.0, 8.0)
    pull = SlippingContact(ball, "pull", 0.4, (0.0, 0.0), 1.0, (5.0, 0.0), 0.0, 1.0)
    renderer = AccurateGelRenderer(LOOK)
    displacements = [state.displacement_mm for state in contact_states(pull, gel, LOOK.grid, 25.0)]
    for number, displacement in enumerate([np.zeros((130, 2)), *displacements]):
        (folder / "images" / f"{number:03}.jpg").write_bytes(renderer.render(displacement, number=number).jpeg)
    return folder


@pytest.mark.parametrize("known", [True, False])
def test_slip_is_written_everywhere(
    known: bool, slipping: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / name for name in ("a.forces.csv", "a.mcap", "a.png")]
    outputs = [text for file in files for text in ("--out", str(file))]
    gel = slipping / ("known.toml" if known else "unknown.toml")
    scale = ["--pixels-per-mm", str(LOOK.pixels_per_mm), "--gel", str(gel)]
    assert main(["track", str(slipping / "images"), *scale, *outputs]) == 0
    assert "gross slip, first at" in capsys.readouterr().out
    with files[0].open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert rows[-1]["gross_slip"] == "1" and float(rows[-1]["stick_share"]) == 0.0
    assert float(rows[-1]["friction"]) == pytest.approx(0.4, rel=0.1)
    pressed = rows[6]
    assert pressed["gross_slip"] == "0" and (pressed["stick_share"] != "") == known
    with SessionReader(files[1]) as session:
        recorded = [record.value for record in session.records(["/left/force"])]
    assert [value["gross_slip"] for value in recorded] == [row["gross_slip"] == "1" for row in rows]
    assert recorded[-1]["friction_observed"] is not known
    assert cv2.imread(str(files[2])) is not None


def test_the_guess_of_a_profile_is_uncertain(images: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (images / "mine.toml").write_text(
        'format = 1\ntitle = "mine"\n[markers]\npitch_mm = 1.5\n'
        "[gel]\nyoungs_modulus = 1.5e5\nyoungs_modulus_deviation = 0.5\npoisson_ratio = 0.48\nthickness = 0.003\n"
    )
    profile = ["--profile", str(images / "mine.toml"), "--gel", "guess", "--json"]
    assert main(["track", str(images / "images"), *profile]) == 0
    force = json.loads(capsys.readouterr().out)["force"]
    assert 0.5 < force["normal_deviation"] / force["normal"] < 0.55


def test_the_summary_names_the_largest_force(images: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scale = ["--pixels-per-mm", str(LOOK.pixels_per_mm), "--gel", str(images / "gel.toml")]
    assert main(["track", str(images / "images"), *scale]) == 0
    printed = capsys.readouterr().out
    assert "largest force" in printed and "normal" in printed and "N mm" in printed


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--gel", "gel.toml"], "millimetres"),
        (["--gel", "guess"], "no guess"),
        (["--out", "x.forces.csv"], "--gel"),
        (["--gel", "none.toml", "--pixels-per-mm", "20"], "none.toml"),
    ],
)
def test_forces_without_scale_or_gel_are_refused(
    arguments: list[str],
    named: str,
    images: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "gel.toml").write_text(GEL)
    assert main(["track", str(images / "images"), *arguments]) == 2
    assert named in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["gel.toml"]


def test_forces_of_a_grid_with_two_spacings_are_refused(
    images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wide = tmp_path / "wide.png"
    image = cv2.imread(str(images / "images" / "0.jpg"))
    assert image is not None
    cv2.imwrite(str(wide), cv2.resize(image, (int(1.2 * image.shape[1]), image.shape[0])))
    command = ["track", str(wide), "--pixels-per-mm", str(1.1 * LOOK.pixels_per_mm)]
    assert main(command) == 0
    assert main([*command, "--gel", str(images / "gel.toml")]) == 2
    assert "forces need markers with one spacing" in capsys.readouterr().err


@pytest.fixture(scope="module")
def session(images: Path) -> Path:
    """A recorded run with those images of the left pad; its lab has a gel for this pad."""
    path = images / "session.mcap"
    clock = ManualClock(50.0)
    mount = CameraMount(13, 10, 1.5, pixels_per_mm=LOOK.pixels_per_mm)
    with SessionRecorder(path, clock) as recorder:
        gels = [load_gel(images / "gel.toml"), None]
        trackers = [mount.tracker_config()] * 2
        recorder.metadata(describe_session(task=INSERTION, trackers=trackers, mounts=[mount] * 2, gels=gels))
        for number in range(6):
            clock.time += 0.1
            for sensor in range(2):
                data = (images / "images" / f"{number}.jpg").read_bytes()
                recorder.image(sensor, CameraImage(data, clock.time, number))
    return path


def test_gel_and_scale_of_a_recorded_lab_are_used(
    session: Path, images: Path, pressed: PressedGel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.forces.csv"
    assert main(["track", str(session), "--out", str(out), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["gel"] == "of the left pad in the session's lab, 150000 Pa, 3 mm thick"
    assert summary["force"]["normal"] == pytest.approx(pressed.normal, rel=0.1)
    assert out.exists()
    (images / "stiff.toml").write_text(GEL.replace("1.5e5", "3e5"))
    assert main(["track", str(session), "--gel", str(images / "stiff.toml"), "--pixels-per-mm", "20", "--json"]) == 0
    explicit = json.loads(capsys.readouterr().out)
    assert explicit["gel"] == str(images / "stiff.toml")
    assert explicit["force"]["normal"] > 1.5 * summary["force"]["normal"]
    assert main(["track", str(session), "--sensor", "right", "--json"]) == 0
    without = json.loads(capsys.readouterr().out)
    assert without["gel"] is None and without["force"] is None


def test_the_scale_of_a_recorded_lab_holds_for_reduced_images(
    session: Path, images: Path, pressed: PressedGel, capsys: pytest.CaptureFixture[str]
) -> None:
    half = images / "half.toml"
    half.write_text('format = 1\ntitle = "half"\n[image]\nreduce = 2\n')
    assert main(["track", str(session), "--profile", str(half), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["pixels_per_mm"] == pytest.approx(LOOK.pixels_per_mm / 2)
    assert summary["force"]["normal"] == pytest.approx(pressed.normal, rel=0.15)


def test_a_stated_gel_of_a_session_needs_no_scale(
    session: Path, images: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["track", str(session), "--gel", str(images / "gel.toml")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "gel.toml" in printed and "largest force" in printed
