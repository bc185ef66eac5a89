"""`gelflow render`: written files contain the rendered sequence; nothing is overwritten."""

import errno
from pathlib import Path

import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.perception.sources import image_source
from gelflow.perception.synthetic.appearance import make_appearance
from gelflow.perception.synthetic.sequence_files import read_truth, write_sequence
from gelflow.perception.synthetic.sequences import GelSequence


def test_folder_and_video_contain_the_sequence(tmp_path: Path) -> None:
    command = "--flaws hard --set contrast=0.4 --set bridges=3 --set cut_row=yes --field twist --frames 6 --peak 0.8"
    folder, video = tmp_path / "images", tmp_path / "images.mjpeg"
    for out in (folder, video):
        assert main(["render", "--out", str(out), *command.split(), "--markers", "63", "--seed", "4"]) == 0
    look = make_appearance("hard", markers=63, seed=4, contrast=0.4, bridges=3, cut_row=True)
    drawn = list(GelSequence(look, "twist", frames=6, peak=0.8))
    for file in (folder / "truth.npz", tmp_path / "images.npz"):
        truth = read_truth(file)
        np.testing.assert_allclose(truth.position, [frame.position for frame in drawn], atol=1e-4)
        np.testing.assert_array_equal(truth.visible, [frame.visible for frame in drawn])
        assert (truth.rows, truth.cols) == (7, 9) and truth.made_from["appearance"]["bridges"] == 3
    assert b"".join(file.read_bytes() for file in sorted(folder.glob("*.jpg"))) == video.read_bytes()
    for source in (folder, video):
        images = [frame.image for frame in image_source(str(source))]
        assert len(images) == 6
        for image, frame in zip(images, drawn, strict=True):  # decoders differ slightly at colour edges
            assert np.abs(image.astype(int) - frame.image).mean() < 1.0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["--set", "blurr=1"], "--set takes NAME=VALUE, names are radius"),
        (["--set", "dust=1.5"], "--set dust must be a whole number, got '1.5'"),
        (["--set", "bright=1"], "--set bright must be yes or no, got '1'"),
        (["--set", "oval=9"], "oval of a gel appearance must be within 1.0 to 3.0, got 9.0"),
        (["--size", "320"], "--size must be width x height in pixels, as 640x480; got '320'"),
        (["--peak", "9"], "a peak of 0 to 2 spacings, got 64, 60 and 9.0"),
    ],
)
def test_wrong_input_is_an_error_of_one_line(
    wrong: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["render", "--out", str(tmp_path / "out"), *wrong]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["images", "images.mjpeg"])
def test_a_full_disk_leaves_no_images(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: object, **values: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("numpy.savez_compressed", full)
        assert main(["render", "--out", str(tmp_path / name), "--frames", "3"]) == 2
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == []
    assert main(["render", "--out", str(tmp_path / name), "--frames", "3"]) == 0


@pytest.mark.parametrize("name", ["images", "images.MJPEG"])
def test_an_interrupted_rendering_leaves_no_images(name: str, tmp_path: Path) -> None:
    written = write_sequence(GelSequence(make_appearance("clean", markers=63), "press", frames=3), tmp_path / name)
    assert [next(written), next(written)] == [1, 2]
    with pytest.raises(KeyboardInterrupt):
        written.throw(KeyboardInterrupt)
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == []


def test_existing_folders_are_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["render", "--out", str(tmp_path), "--frames", "1"]) == 2
    assert "exists and would be overwritten" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("name", ["images", "images.mjpeg"])
def test_two_processes_cannot_write_the_same_images(name: str, tmp_path: Path) -> None:
    first, second = (
        write_sequence(GelSequence(make_appearance("clean", markers=63, seed=seed), "press", frames=3), tmp_path / name)
        for seed in (0, 1)
    )
    with pytest.raises(UsageError, match="exists and would be overwritten"):
        for written, _ in zip(first, second, strict=True):
            assert written == 1
    assert list(first) == [2, 3]
    assert len(read_truth(tmp_path / ("images.npz" if name.endswith("jpeg") else "images/truth.npz")).position) == 3


def test_a_suffix_of_another_kind_of_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "--out", str(tmp_path / "film.mp4"), "--frames", "1"]) == 2
    assert "give a folder, or a video with the suffix .mjpeg" in capsys.readouterr().err
    assert not (tmp_path / "film.mp4").exists()


def test_files_of_a_newer_or_other_format_are_rejected(tmp_path: Path) -> None:
    np.savez(tmp_path / "newer.npz", format=2)
    with pytest.raises(UsageError, match="has format 2, this gelflow reads up to 1"):
        read_truth(tmp_path / "newer.npz")
    (tmp_path / "other.npz").write_bytes(b"not an archive")
    with pytest.raises(UsageError, match="is not the ground truth of a rendered sequence"):
        read_truth(tmp_path / "other.npz")
