"""`gelflow render-scene SCENE`: a picture or a film of a scene with bodies, contact forces and pads."""

import argparse
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_out, add_preset, picture_size
from gelflow.cli.output import Output, progress_bar
from gelflow.errors import UsageError

if TYPE_CHECKING:
    from gelflow.sim.scene import Scene

_FILM_SECONDS = 2.0
_MAX_FRAMES = 100_000


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("scene", metavar="SCENE", help="name of an included scene, or a TOML, MJCF or URDF file")
    add_out(parser, "film (.mp4, .mkv, .avi), or picture (.png, .jpg) of the last state", default=Path("scene.mp4"))
    parser.add_argument(
        "--controls",
        type=Path,
        metavar="FILE",
        help="controls of each step, one row per step: .npy, or .csv without a header (default: those of the "
        "model's keyframe; without them position servos hold the start, others are 0)",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        metavar="S",
        help=f"simulated time (default: that of --controls; without, {_FILM_SECONDS:g} for a film, 0 for a picture)",
    )
    parser.add_argument(
        "--fps", type=float, default=25.0, metavar="N", help="pictures per second (default %(default)g)"
    )
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="of the film; 0.1 is ten times slower")
    parser.add_argument("--size", default="640x480", metavar="WxH", help="picture size [px] (default %(default)s)")
    parser.add_argument("--camera", default="oblique", metavar="VIEW", help="oblique, front, side or top")
    add_preset(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Simulate the scene and write the pictures."""
    from gelflow.perception.output.writers import PICTURE_SUFFIXES, VIDEO_CODECS

    suffix, size = args.out.suffix.lower(), picture_size(args.size)
    if suffix not in (*PICTURE_SUFFIXES, *VIDEO_CODECS):
        raise UsageError(f"--out must end in {', '.join((*PICTURE_SUFFIXES, *VIDEO_CODECS))}; got {args.out}")
    from gelflow.perception.output.writers import VIDEO_RATES

    if not VIDEO_RATES[0] <= args.fps <= VIDEO_RATES[1]:
        raise UsageError(f"--fps must be within {VIDEO_RATES[0]:g} to {VIDEO_RATES[1]:g}, got {args.fps:g}")
    if not (np.isfinite(args.speed) and args.speed > 0):
        raise UsageError(f"--speed must be above 0, got {args.speed:g}")
    if not args.out.parent.is_dir():
        raise UsageError(f"--out: there is no folder {args.out.parent}")
    from gelflow.sim.drawing.film import film_pictures, record_rollout
    from gelflow.sim.scene import load_scene
    from gelflow.sim.simulator import Simulator

    scene = load_scene(args.scene, preset=args.preset)
    sim = Simulator(scene)
    controls = _controls(scene, args.controls)
    frames = _frames(args, len(controls) if args.controls else 0, scene.step, film=suffix in VIDEO_CODECS)
    drawings = record_rollout(sim, controls, frames)
    pictures = film_pictures(sim, drawings, [scene.step * frame for frame in frames], size=size, view=args.camera)
    with progress_bar(count=True) as bar:
        shown = bar.track(pictures, total=len(frames), description="pictures")
        if suffix in VIDEO_CODECS:
            _write_film(args.out, shown, size, args.fps, VIDEO_CODECS[suffix])
        else:
            _write_picture(args.out, next(iter(shown)))
    output = Output(args.json)
    output.text(f"wrote {args.out}: {len(frames)} picture{'s' if len(frames) > 1 else ''}")
    output.result({"out": str(args.out), "pictures": len(frames), "seconds": scene.step * frames[-1]})
    return SUCCESS


def _controls(scene: "Scene", file: Path | None) -> NDArray[np.float64]:
    """Controls (steps, nu) of a file, or those of the start in one row. Raises UsageError for a wrong file."""
    if file is None:
        from gelflow.sim.scene.start_controls import start_controls

        return start_controls(scene)[None]
    try:
        if file.suffix == ".npy":
            read = np.load(file, allow_pickle=False)
        else:
            with warnings.catch_warnings(category=UserWarning, action="ignore"):  # of an empty file
                read = np.loadtxt(file, delimiter=",", ndmin=2, encoding="utf-8-sig")
        if np.iscomplexobj(read):
            raise ValueError("the numbers are complex")
        controls = np.asarray(read, dtype=np.float64)
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"--controls: cannot read {file}: {' '.join(str(error).split())}") from None
    if controls.ndim != 2 or controls.shape[1] != scene.nu or not len(controls):
        names = ", ".join(actuator.name for actuator in scene.actuators)
        raise UsageError(f"--controls: {file} must be (steps, {scene.nu}): {names}; got {controls.shape}")
    return controls


def _frames(args: argparse.Namespace, steps: int, step: float, *, film: bool) -> list[int]:
    """Numbers of steps after which pictures are drawn; of a picture the last one only."""
    seconds = args.seconds
    if seconds is None:
        seconds = steps * step if steps else _FILM_SECONDS if film else 0.0
    if not (np.isfinite(seconds) and seconds >= 0):
        raise UsageError(f"--seconds must be at least 0, got {seconds:g}")
    if not film:
        return [round(seconds / step)]
    count = int(seconds * args.fps / args.speed + 1e-9) + 1
    if count > _MAX_FRAMES:
        raise UsageError(f"the film would have {count} pictures, more than {_MAX_FRAMES}; reduce --seconds or --fps")
    return [round(i * args.speed / args.fps / step) for i in range(count)]


def _write_film(path: Path, pictures: Any, size: tuple[int, int], fps: float, codec: str) -> None:
    """Write a film by way of a file beside it: an error while drawing leaves an earlier film as it is."""
    import cv2

    from gelflow.perception.errors import name_for_opencv
    from gelflow.perception.output.writers import check_complete, video_rate

    name_for_opencv(path)
    partial, count = path.with_name(f"{path.stem}.part{path.suffix}").absolute(), 0
    try:
        video = cv2.VideoWriter(str(partial), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), video_rate(fps), size)
        if not video.isOpened():
            raise UsageError(f"cannot write the film {path}; is its folder writable?")
        for picture in pictures:
            video.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
            count += 1
        video.release()
        check_complete(partial, count)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    import cv2

    from gelflow.perception.overlay import write_picture

    write_picture(path, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
