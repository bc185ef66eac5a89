"""Sensor profiles: those that come with gelflow, files of one's own, and wrong ones."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.errors import PeerError, UsageError
from gelflow.perception.sensors.profile import load_sensor_profile, sensor_profile_names
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer


def test_all_profiles_load() -> None:
    assert sensor_profile_names() == ["gelsight-mini", "gelslim-3", "generic"]
    for name in sensor_profile_names():
        assert load_sensor_profile(name).title
    mini = load_sensor_profile("gelsight-mini")
    assert (mini.image.width, mini.image.height, mini.image.reduce) == (3280, 2464, 4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("format = 2\ntitle = 's'", "has format 2; this gelflow reads format 1"),
        ("format = 1", "title is missing"),
        ("format = 1\ntitle = 's'\n[marker]", "unknown key 'marker'; did you mean 'markers'"),
        ("format = 1\ntitle = 's'\n[markers]\nrows = 3", "rows and cols must both be positive"),
        ("format = 1\ntitle = 's'\n[markers]\npitch_mm = -1", "pitch_mm must be within 0 to 1000"),
        ("format = 1\ntitle = 's'\n[image]\nreduce = 3", "reduce must be 1, 2, 4 or 8, got 3"),
        ("format = 1\ntitle = 's'\n[image]\nwidth = 640", "width and height must both be positive"),
        ("format = 1\ntitle = 's'\n[image]\ncrop = [0.5, 0, 0.5, 0]", "leave a part of the image"),
        ("format = 1\ntitle = 's'\n[image]\ncrop = [0.5]", "crop must be 4 finite numbers"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(UsageError, match=message) as caught:
        load_sensor_profile(str(tmp_path / "s.toml"))
    assert "s.toml" in str(caught.value) and "\n" not in str(caught.value)


def test_an_unknown_name_gets_the_known_ones() -> None:
    with pytest.raises(UsageError, match="no sensor profile 'gelsight'; did you mean 'gelsight-mini'"):
        load_sensor_profile("gelsight")


def test_an_image_of_another_size_is_refused() -> None:
    profile = load_sensor_profile("gelsight-mini")
    small = np.zeros((240, 320, 3), dtype=np.uint8)
    message = "for images of 3280 × 2464 px, this one has 80 × 60 px at 1/4 of its size"
    with pytest.raises(PeerError, match=message):
        profile.decode(bytes(cv2.imencode(".jpg", small)[1]))
    with pytest.raises(PeerError, match=message):
        profile.prepare(small)


def test_decoded_and_prepared_images_agree() -> None:
    profile = load_sensor_profile("gelsight-mini")
    noise = np.random.default_rng(0).integers(0, 255, (77, 103, 3), dtype=np.uint8)
    image = np.asarray(cv2.resize(noise, (3280, 2464), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    decoded, prepared = profile.decode(data), profile.prepare(image)
    assert decoded.shape == prepared.shape == (440, 586, 3)
    assert np.abs(decoded.astype(int) - prepared).mean() < 3
    np.testing.assert_array_equal(profile.decode(bytes(cv2.imencode(".png", image)[1])), prepared)


def test_sizes_that_are_no_multiple_of_the_reduction_are_rounded_up(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("format = 1\ntitle = 's'\n[image]\nwidth = 203\nheight = 151\nreduce = 4\n")
    profile, image = load_sensor_profile(str(tmp_path / "s.toml")), np.zeros((151, 203, 3), dtype=np.uint8)
    for suffix in (".jpg", ".png", ".bmp"):
        assert profile.decode(bytes(cv2.imencode(suffix, image)[1])).shape == (38, 51, 3)


def test_a_profile_tracks_and_scales_images_of_its_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same motion in millimetres from the reduced, cropped image as from the rendered one."""
    renderer = FastGelRenderer(GelAppearance(width=320, height=427, noise=0.5))
    (tmp_path / "images").mkdir()
    for number in range(3):
        gel = renderer.render(np.tile([0.2 * number, -0.1 * number], (252, 1)), sequence=number)
        picture = np.full((2 * 427 + 160, 2 * 320 + 80, 3), 90, dtype=np.uint8)
        picture[80:-80, 40:-40] = cv2.resize(gel, (640, 854), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(tmp_path / "images" / f"{number}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
    crop = [40 / 720, 80 / 1014, 40 / 720, 80 / 1014]
    (tmp_path / "s.toml").write_text(
        "format = 1\ntitle = 's'\n[markers]\npitch_mm = 1.4\n"
        f"[image]\nwidth = 720\nheight = 1014\nreduce = 2\ncrop = {crop}\n"
    )
    source, profile = str(tmp_path / "images"), str(tmp_path / "s.toml")
    assert main(["track", source, "--profile", profile, "--json", "--out", str(tmp_path / "t.mcap")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["pixels_per_mm"] == pytest.approx(15.7, rel=0.01)
    assert result["largest_displacement_mm"] == pytest.approx(np.hypot(0.4, 0.2), rel=0.03)
    assert main(["track", source, "--profile", profile, "--json", "--pixels-per-mm", "31.4"]) == 0
    scaled = json.loads(capsys.readouterr().out)  # the option is in pixels of the image as sent, like those of a ruler
    assert scaled["largest_displacement_mm"] == pytest.approx(np.hypot(0.4, 0.2), rel=0.03)
    # The recording holds the part that was tracked.
    assert main(["track", str(tmp_path / "t.mcap"), "--json", "--pixels-per-mm", "15.7"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["largest_displacement_px"] == result["largest_displacement_px"]
    assert main(["calibrate-camera", source, "--profile", profile, "--out", str(tmp_path / "c.json")]) == 0
    assert json.loads((tmp_path / "c.json").read_text())["spacing_mm"] == 1.4
    # The points of a ruler are those of the image as sent, which has twice the scale.
    ruler = [*map(str, (100, 300, 600, 300, 500 / 31.4))]
    assert (
        main(["calibrate-camera", source, "--profile", profile, "--out", str(tmp_path / "r.json"), "--ruler", *ruler])
        == 0
    )
    assert json.loads((tmp_path / "r.json").read_text())["spacing_mm"] == pytest.approx(1.4, rel=3e-3)
    ruler[0] = "20"
    assert (
        main(["calibrate-camera", source, "--profile", profile, "--out", str(tmp_path / "s.json"), "--ruler", *ruler])
        == 2
    )
    assert "in the part of the image that the profile uses" in capsys.readouterr().err
    assert main(["calibrate-camera", source, "--out", str(tmp_path / "d.json")]) == 2
    assert "--spacing-mm is missing" in capsys.readouterr().err
    assert main(["track", source, "--pixels-per-mm", "0"]) == 2
    assert "--pixels-per-mm must be above 0" in capsys.readouterr().err
