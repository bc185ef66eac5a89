"""Decoding of camera images, and conversion of tracking results to tactile frames."""

import json

import cv2
import numpy as np
import pytest

from gelflow.errors import PeerError, UsageError
from gelflow.perception.camera_calibration import CameraCalibration
from gelflow.perception.frames import CameraMount, ImageDecoder, Reduction, decode_image, tactile_frame
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.tracker import MarkerTracker, TrackingResult
from gelflow.session.records import from_plain, to_json

SIZES = {0: (320, 427), 90: (427, 320), 180: (320, 427), 270: (427, 320)}


@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
@pytest.mark.parametrize("mirrored", [True, False])
def test_every_camera_orientation_gives_pad_coordinates(rotation: int, mirrored: bool) -> None:
    width, height = SIZES[rotation]
    appearance = GelAppearance(width=width, height=height, rotation=rotation, mirrored=mirrored)  # type: ignore[arg-type]
    mount = CameraMount(rotation=rotation, mirrored=mirrored, pixels_per_mm=appearance.pixels_per_mm)  # type: ignore[arg-type]
    renderer, tracker = FastGelRenderer(appearance), MarkerTracker(mount.tracker_config())
    x, y = appearance.positions_mm().T
    field = np.stack([0.3 + 0.02 * y, -0.1 + 0.01 * x], axis=1)  # no symmetry, so that wrong signs are detected
    reference = tactile_frame([tracker.start(renderer.render(np.zeros_like(field)))], [mount], stamp=1.0)
    frame = tactile_frame([tracker.track(renderer.render(field, sequence=1))], [mount], stamp=2.0)
    assert frame.unit == "mm" and frame.grid == appearance.grid and frame.stamp == 2.0
    assert frame.valid.all() and np.abs(frame.shear[0] - field).max() < 0.02
    assert np.abs(reference.shear).max() == 0
    assert np.allclose(frame.positions, appearance.positions_mm(), atol=1e-5)


def tracked(rows: int = 18, cols: int = 14) -> TrackingResult:
    n = rows * cols
    valid = np.ones(n, dtype=bool)
    valid[5] = False
    displacement = np.tile([1.0, 2.0], (n, 1))
    displacement[5] = np.nan
    return TrackingResult(np.zeros((n, 2)), displacement, valid, ~valid, valid.astype(float), rows, cols, 22.0)


def test_a_frame_without_scale_is_in_pixels() -> None:
    mounts = [CameraMount(mirrored=False), CameraMount(mirrored=False, pixels_per_mm=10.0)]
    frame = tactile_frame([tracked(), tracked()], mounts, stamp=0.0)
    assert frame.unit == "px"
    assert np.allclose(frame.shear[:, 0], [2.0, 1.0])  # both in px, although one camera has a scale


def test_a_calibration_gives_millimetres_for_a_tilted_camera() -> None:
    # A tilted camera: the scale grows from 12 to 18 px/mm over the image. The fingertip is at the right.
    matrix = ((13.5, 0.0, 0.0), (0.0, 13.5, 0.0), (0.2, 0.0, 1.0))
    calibration = CameraCalibration(427, 320, 14, 18, 1.4, matrix, (), (213.0, 159.5), 0.0, 0.0)
    mount = CameraMount(rotation=270, mirrored=True, calibration=calibration)
    rest_mm = calibration.marker_positions_mm()
    moved = np.tile([0.3, -0.2], (len(rest_mm), 1))
    rest, position = calibration.to_pixels(rest_mm), calibration.to_pixels(rest_mm + moved)
    all_of_them = np.ones(len(rest), dtype=bool)
    seen = TrackingResult(position, position - rest, all_of_them, ~all_of_them, all_of_them.astype(float), 14, 18, 22.0)
    frame = tactile_frame([seen], [mount], stamp=0.0)
    assert frame.unit == "mm" and np.allclose(frame.shear, [0.3, -0.2], atol=1e-6)
    assert from_plain(CameraMount, json.loads(to_json(mount)), what="camera mount") == mount
    with pytest.raises(UsageError, match="not both"):
        CameraMount(rotation=270, calibration=calibration, pixels_per_mm=15.7)
    with pytest.raises(UsageError, match="calibration is for 14 rows of 18 markers"):
        CameraMount(rotation=0, calibration=calibration)


def test_an_invalid_marker_is_nan() -> None:
    frame = tactile_frame([tracked()], [CameraMount(mirrored=False)], stamp=0.0)
    assert np.flatnonzero(~frame.valid[0]).tolist() == [5]
    assert np.isnan(frame.shear[0, 5]).all() and np.isfinite(frame.shear[0][frame.valid[0]]).all()


def test_results_that_do_not_match_their_mounts_are_rejected() -> None:
    with pytest.raises(UsageError, match="expects 14 rows of 18"):
        tactile_frame([tracked()], [CameraMount(rotation=90)], stamp=0.0)
    with pytest.raises(UsageError, match="one tracking result per mount"):
        tactile_frame([tracked()], [CameraMount(), CameraMount()], stamp=0.0)
    with pytest.raises(UsageError, match="same grid"):
        tactile_frame([tracked(), tracked()], [CameraMount(), CameraMount(pitch=1.5)], stamp=0.0)


@pytest.mark.parametrize("settings", [{"rotation": 45}, {"pixels_per_mm": 0.0}, {"rows": 0}, {"pitch": -1.0}])
def test_invalid_mounts_are_rejected(settings: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        CameraMount(**settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("data", [b"", b"no image at all", b"\xff\xd8\xff\xe0 cut off"])
def test_bytes_that_are_not_an_image_are_rejected(data: bytes) -> None:
    with pytest.raises(PeerError, match="expected a JPEG or PNG image"):
        decode_image(data)


def test_a_truncated_image_is_reported_as_truncated() -> None:
    renderer = FastGelRenderer()
    data = renderer.encode(renderer.render(np.zeros((252, 2))))
    with pytest.raises(PeerError, match="truncated or damaged"):
        decode_image(data[: len(data) // 2])


def test_a_damaged_header_with_too_many_pixels_is_an_unreadable_image() -> None:
    renderer = FastGelRenderer()
    data = bytearray(renderer.encode(renderer.render(np.zeros((252, 2)))))
    size = data.find(b"\xff\xc0") + 5
    data[size] |= 0x80
    data[size + 2] |= 0x80
    with pytest.raises(PeerError, match="truncated or damaged"):
        decode_image(bytes(data))


@pytest.mark.parametrize(("bits", "suffix"), [(10, ".png"), (12, ".png"), (12, ".tiff"), (12, ".pgm"), (16, ".png")])
def test_images_of_16_bits_are_reduced_by_the_bits_that_the_first_one_uses(bits: int, suffix: str) -> None:
    bright = np.linspace(0, (1 << bits) - 1, 3072).reshape(48, 64)
    decoder = ImageDecoder()
    for share, expected in ((1.0, 255), (0.5, 127), (1.0, 255)):
        data = bytes(cv2.imencode(suffix, (share * bright).astype(np.uint16))[1])
        decoded = decoder(data)
        assert decoded.dtype == np.uint8 and decoded.shape == (48, 64, 3) and decoded.max() == expected
    assert decode_image(data).max() == 255
    if bits < 16:
        assert decoder(bytes(cv2.imencode(suffix, np.full((48, 64), 60000, np.uint16))[1])).min() == 255


@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3)])
def test_an_image_of_another_number_type_names_its_type(shape: tuple[int, ...]) -> None:
    data = bytes(cv2.imencode(".tiff", np.ones(shape, np.float32))[1])
    with pytest.raises(PeerError, match="values of type float32: convert it to 8 or 16 bits"):
        decode_image(data)


def test_decoding_is_repeatable() -> None:
    renderer = FastGelRenderer()
    data = renderer.encode(renderer.render(np.zeros((252, 2))))
    assert decode_image(data).shape == (427, 320, 3) and (decode_image(data) == decode_image(data)).all()


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("reduce", [2, 4, 8])
def test_a_reduced_image_of_any_size_keeps_positions(reduce: Reduction, suffix: str) -> None:
    picture = np.zeros((1049, 701), np.uint8)  # no multiples of `reduce`
    cv2.circle(picture, (660, 1010), 24, 200, cv2.FILLED, cv2.LINE_AA)  # near the border
    reduced = decode_image(bytes(cv2.imencode(suffix, picture)[1]), reduce=reduce)[..., 0]
    assert reduced.shape == (-(-1049 // reduce), -(-701 // reduce))
    weights = np.where(reduced > 20, reduced, 0).astype(float)
    down, right = (float((weights * at).sum() / weights.sum()) for at in np.indices(reduced.shape))
    exact = [(at + 0.5) / reduce - 0.5 for at in (660, 1010)]
    assert [right, down] == pytest.approx(exact, abs=0.02)


@pytest.mark.parametrize("encoding", ["jpg", "png"])
def test_a_damaged_size_is_refused_without_decoding(encoding: str) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    data = bytearray(cv2.imencode(f".{encoding}", picture)[1].tobytes())
    if encoding == "jpg":
        start = data.find(b"\xff\xc0")
        data[start + 5 : start + 9] = (20_000).to_bytes(2) * 2
    else:
        data[16:24] = (20_000).to_bytes(4) * 2
    with pytest.raises(PeerError, match="states a size of 20000 × 20000 pixels"):
        decode_image(bytes(data))
