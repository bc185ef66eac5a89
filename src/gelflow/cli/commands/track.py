"""`gelflow track`: track the markers of recorded or live tactile images; write tables, recordings and overlays."""

import argparse
import itertools
import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gelflow.cli import options
from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.output import Output, progress_bar
from gelflow.cli.tracking_summary import show_summary
from gelflow.errors import UsageError
from gelflow.gel.gel_file import ElasticGel, load_gel
from gelflow.perception.camera_calibration import CameraCalibration, load_calibration
from gelflow.perception.errors import TrackerInitError
from gelflow.perception.force.image_forces import GridScale, ImageForces, grid_angle
from gelflow.perception.force.recorded_pad import RecordedPad, recorded_pad
from gelflow.perception.grid_detection.grid_part import Polarity
from gelflow.perception.mount_check import (
    VisiblePart,
    check_calibrated_scale,
    check_one_spacing,
    check_uniform_scale,
    find_visible_part,
)
from gelflow.perception.output.forces import SUFFIX
from gelflow.perception.output.init_error import picture_of_init_error
from gelflow.perception.output.summary import TrackingSummary
from gelflow.perception.output.writers import TrackedImage, TrackWriter, check_suffix, open_writer
from gelflow.perception.sensors.profile import SensorProfile, load_sensor_profile
from gelflow.perception.sources import ImageSource, SourceImage, image_source, start_on_image
from gelflow.perception.tracker import MarkerTracker, TrackerConfig, TrackingResult
from gelflow.session.records import software_versions

if TYPE_CHECKING:
    from gelflow.view.tracking.tracking_page import TrackingPage

_LARGEST_MAGNIFICATION = 1e6  # of the overlay's arrows


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "source", help="folder of images, image, video, session (.mcap), stream URL, or number of a camera"
    )
    parser.add_argument("--rows", type=int, metavar="N", help="printed rows of markers (default: detected)")
    parser.add_argument(
        "--cols",
        type=int,
        metavar="N",
        help="printed markers in a row (default: detected); rows and cols may be swapped, and partly outside the image",
    )
    polarity = parser.add_mutually_exclusive_group()
    polarity.add_argument("--dark", action="store_true", help="dots are darker than the gel (default: detected)")
    polarity.add_argument("--bright", action="store_true", help="dots are brighter than the gel (default: detected)")
    options.add_profile(parser)
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument(
        "--calibration", type=Path, metavar="FILE", help="result of gelflow calibrate-camera: adds millimetres"
    )
    scale.add_argument(
        "--pixels-per-mm",
        type=float,
        metavar="X",
        help="scale, in pixels of the image as the camera sends it, without a calibration (default: pitch of the "
        "profile)",
    )
    parser.add_argument(
        "--gel",
        metavar="FILE",
        help="gel file (TOML), or guess: that of the profile; adds forces in newtons, needs a scale or calibration "
        "(default: the gel and the scale in the lab of a recorded session)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="new file, repeatable; the suffix selects the content: .csv table, .forces.csv table of forces, .mcap "
        "recording, .mkv, .avi, .mp4 overlay video, .png, .jpg last overlay",
    )
    parser.add_argument("--images", type=int, metavar="N", help="stop after N images (default: at the end, or Ctrl-C)")
    parser.add_argument(
        "--rate", type=float, default=25.0, metavar="HZ", help="rate of a folder's images (%(default)s)"
    )
    parser.add_argument("--sensor", default="left", help="sensor of a session: left or right (%(default)s)")
    parser.add_argument(
        "--magnify", type=float, default=3.0, metavar="X", help="length of the overlay's arrows (%(default)s times)"
    )
    parser.add_argument(
        "--show", action="store_true", help="show markers and forces in the browser, with a key for a new zero"
    )
    options.add_page_address(parser, of=" of --show")
    options.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Track all images, write the requested files and print a summary."""
    _check(args)
    output = Output(args.json)
    profile = load_sensor_profile(args.profile)
    if args.rows is None and args.cols is None and profile.markers.rows:
        args.rows, args.cols = profile.markers.rows, profile.markers.cols
    source = image_source(args.source, sensor=args.sensor, rate=args.rate, profile=profile)
    calibration = load_calibration(args.calibration) if args.calibration else None
    pad = recorded_pad(source.text, args.sensor) if source.kind == "session" else None
    gel = _gel(args, profile, pad)
    if gel is not None and pad is not None and calibration is None and args.pixels_per_mm is None:
        calibration, args.pixels_per_mm = _pad_scale(pad, profile)
    args.gel = None if gel is None else gel.gel
    for file in args.out:
        if file.name.lower().endswith(SUFFIX) and args.gel is None:
            raise UsageError(f"--out {file} needs the gel: give --gel FILE")
    summary, begin = TrackingSummary(), time.perf_counter()
    try:
        with _page(args, output, live=source.live) as page:
            _track(source, calibration, summary, args, page)
        summary.complete = True
    except KeyboardInterrupt:
        if not source.live or not summary.images:
            raise
        summary.complete = True
    finally:
        # An error or Ctrl-C keeps the results of the images before it.
        files = options.delete_empty(args.out)
        if summary.images:
            seconds, name = time.perf_counter() - begin, None if gel is None else gel.text
            show_summary(output, summary, source, seconds, files, name)
    return SUCCESS


def _check(args: argparse.Namespace) -> None:
    options.check_at_least(args, images=1)
    options.check_page_address(args, "show")
    if args.pixels_per_mm is not None and not 0 < args.pixels_per_mm < float("inf"):
        raise UsageError(f"--pixels-per-mm must be above 0, got {args.pixels_per_mm:g}")
    if not 0 < args.magnify <= _LARGEST_MAGNIFICATION:
        raise UsageError(f"--magnify must be above 0 and at most {_LARGEST_MAGNIFICATION:g}, got {args.magnify:g}")
    for number, file in enumerate(args.out):
        check_suffix(file)
        options.check_new_file(file)
        if file.resolve() in (other.resolve() for other in args.out[:number]):
            raise UsageError(f"--out names {file} twice")


@contextmanager
def _page(args: argparse.Namespace, output: Output, *, live: bool) -> "Iterator[TrackingPage | None]":
    """The page of `--show`, or None without it."""
    if not args.show:
        yield None
        return
    from gelflow.view.tracking.tracking_page import TrackingPage  # deferred: optional

    page = TrackingPage(
        args.source, magnify=args.magnify, forces=args.gel is not None, paced=not live, host=args.host, port=args.port
    )
    with closing(page):
        output.text(f"open {page.url} in a browser; Ctrl-C ends")
        yield page


def _track(
    source: ImageSource,
    calibration: CameraCalibration | None,
    summary: TrackingSummary,
    args: argparse.Namespace,
    page: "TrackingPage | None",
) -> None:
    total = source.count()
    if args.images is not None:
        total = args.images if total is None else min(total, args.images)
    with ExitStack() as open_files, progress_bar(count=True) as progress:
        bar = progress.add_task("tracking", total=total)
        images = iter(source)
        with picture_of_init_error((args.out or [Path("track")])[0]):
            first, started = start_on_image(source, images, lambda image: _start(image, calibration, args))
        tracker, tracked, summary.visible, seconds = started
        summary.pixels_per_mm = _scale(tracked, source, calibration, args)
        # Files are created after the first image: a failed start leaves no empty files.
        forces = _forces(tracked, calibration, summary.pixels_per_mm, args)
        with options.removed_on_error(*args.out), ExitStack() as created:
            writers = [created.enter_context(closing(writer)) for writer in _writers(args, calibration, summary)]
            open_files.enter_context(created.pop_all())
        writers += [] if page is None else [page]
        for number, frame in enumerate(itertools.islice(itertools.chain([first], images), args.images)):
            if number:
                begin = time.perf_counter()
                tracked = tracker.track(frame.image)
                seconds = time.perf_counter() - begin
                if page is not None and page.take_zero_request() and (zero := _zeroed(tracker, tracked, frame, page)):
                    tracker, tracked = zero
                    if forces is not None:
                        forces.reset()
            step = _tracked_image(number, frame, tracked, calibration, summary.pixels_per_mm)
            if forces is not None and step.displacement_mm is not None:
                force = forces.estimate(step.displacement_mm, tracked.valid, frame.stamp)
                step = replace(step, force=force, slip=forces.slip)
            for writer in writers:
                writer.add(step)
            summary.add(step, seconds)
            progress.advance(bar)


def _start(
    image: NDArray[np.uint8], calibration: CameraCalibration | None, args: argparse.Namespace
) -> tuple[MarkerTracker, TrackingResult, list[VisiblePart], float]:
    """A tracker started on the first image, its result, the possible visible parts of a partly visible grid, and the
    duration of the start [s].
    """
    begin = time.perf_counter()
    if calibration is not None:
        calibration.check_size(image)
    polarity: Polarity = "dark" if args.dark else "bright" if args.bright else "auto"
    parts: list[VisiblePart] = []
    config = TrackerConfig(rows=args.rows, cols=args.cols, polarity=polarity)
    if calibration is not None and any(calibration.skipped):
        parts = [VisiblePart.of_calibration(calibration)]
        config = parts[0].tracker_config(polarity)
    tracker = MarkerTracker(config)
    try:
        first = tracker.start(image)
    except TrackerInitError:
        if parts or args.rows is None or args.cols is None:
            raise
        parts = find_visible_part(image, args.rows, args.cols, polarity=polarity)
        if not parts:
            raise
        tracker = MarkerTracker(parts[0].tracker_config(polarity))
        first = tracker.start(image)
    if calibration is not None:
        check_calibrated_scale(calibration, first)
    return tracker, first, parts, time.perf_counter() - begin


def _zeroed(
    tracker: MarkerTracker, tracked: TrackingResult, frame: SourceImage, page: "TrackingPage"
) -> tuple[MarkerTracker, TrackingResult] | None:
    """A tracker for which the present image is the state of rest; None if it does not show the same grid clearly."""
    fresh = MarkerTracker(tracker.config)
    try:
        first = fresh.start(frame.image)
    except TrackerInitError:
        first = None
    same = first is not None and (first.rows, first.cols) == (tracked.rows, tracked.cols)
    page.zeroed(done=same)
    return (fresh, first) if first is not None and same else None


def _scale(
    first: TrackingResult, source: ImageSource, calibration: CameraCalibration | None, args: argparse.Namespace
) -> float | None:
    """The uniform scale of the tracked images [px/mm] where there is no calibration; None if it is not known.

    Raises UsageError when `--pixels-per-mm`, in pixels of the image as sent, does not fit the spacing of the markers.
    """
    pitch, reduce = source.profile.markers.pitch_mm, source.profile.image.reduce
    if calibration is not None:
        return None
    if args.pixels_per_mm is None:
        return first.spacing / pitch if pitch else None
    check_uniform_scale(args.pixels_per_mm, reduce * first.spacing, pitch)
    return float(args.pixels_per_mm) / reduce


@dataclass(frozen=True)
class _Gel:
    """The gel of the forces, and its origin in words."""

    gel: ElasticGel
    text: str


def _gel(args: argparse.Namespace, profile: SensorProfile, pad: RecordedPad | None) -> _Gel | None:
    """The gel of a file, the first guess of the profile, or that of a recorded pad; None without any."""
    if args.gel == "guess":
        if profile.gel is None:
            raise UsageError(f"the profile {profile.title!r} has no guess of the gel: give a gel file")
        return _Gel(profile.gel, f"guess of the profile {profile.title}")
    if args.gel:
        return _Gel(load_gel(Path(args.gel)), str(args.gel))
    if pad is None or pad.gel is None:
        return None
    values = f"{pad.gel.youngs_modulus:g} Pa, {1e3 * pad.gel.thickness:g} mm thick"
    return _Gel(pad.gel, f"of the {args.sensor} pad in the session's lab, {values}")


def _pad_scale(pad: RecordedPad, profile: SensorProfile) -> tuple[CameraCalibration | None, float | None]:
    """The calibration or the scale of a recorded pad, in pixels of its whole images [px/mm]."""
    calibration = pad.mount.calibration
    if calibration is not None and not profile.image.is_plain:
        raise UsageError(
            f"the calibration in the session's lab is for whole images, and the profile {profile.title!r} crops or "
            "reduces them: leave --profile out, or give --calibration"
        )
    return calibration, pad.mount.pixels_per_mm


def _forces(
    first: TrackingResult, calibration: CameraCalibration | None, scale: float | None, args: argparse.Namespace
) -> ImageForces | None:
    """The estimator of forces, if there is a gel."""
    if args.gel is None:
        return None
    if calibration is not None:
        grid = GridScale(calibration.spacing_mm, first.spacing / calibration.spacing_mm, along_grid=True)
    elif scale is not None:
        check_one_spacing(first)
        grid = GridScale(first.spacing / scale, scale)
    else:
        raise UsageError("--gel needs millimetres: give --calibration, --pixels-per-mm or a --profile with a pitch")
    thickness = 1e3 * args.gel.thickness
    if grid.pitch_mm > thickness:
        warnings.warn(
            f"markers {grid.pitch_mm:.3g} mm apart are too far from each other for forces on a gel {thickness:.3g} mm "
            "thick: check the scale and the thickness",
            stacklevel=2,
        )
    angle = grid_angle(first.position, first.rows, first.cols)
    return ImageForces(args.gel, first.rows, first.cols, grid, angle)


def _writers(
    args: argparse.Namespace, calibration: CameraCalibration | None, summary: TrackingSummary
) -> Iterator[TrackWriter]:
    """Opens the files of `--out` one after the other, so that each can be closed where the next one fails."""
    description = {
        "source": args.source,
        "profile": args.profile,
        "calibration": calibration,
        "pixels_per_mm": summary.pixels_per_mm,
        "gel": None if args.gel is None else asdict(args.gel),
        "versions": software_versions(),
    }
    for file in args.out:
        yield open_writer(
            file,
            sensor=args.sensor,
            magnify=args.magnify,
            forces=args.gel is not None,
            millimetres=calibration is not None or summary.pixels_per_mm is not None,
            description=description,
        )


def _tracked_image(
    number: int, frame: SourceImage, tracked: TrackingResult, calibration: CameraCalibration | None, scale: float | None
) -> TrackedImage:
    """The result in millimetres too: by the calibration, or by `scale` [px/mm] from the centre of the image."""
    if calibration is not None:
        displacement = calibration.displacement_mm(tracked.position, tracked.displacement)
        return TrackedImage(number, frame, tracked, calibration.to_mm(tracked.position), displacement)
    if scale is not None:
        centre = (np.array(frame.image.shape[1::-1]) - 1) / 2
        return TrackedImage(number, frame, tracked, (tracked.position - centre) / scale, tracked.displacement / scale)
    return TrackedImage(number, frame, tracked)
