"""Track a live stream of large images on one core: an MJPEG stream of a GelSight Mini's size, served by this script."""

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import script

from gelflow.perception.sensors.profile import load_sensor_profile
from gelflow.perception.synthetic.appearance import make_appearance
from gelflow.perception.synthetic.sequences import GelSequence

PROFILE = "gelsight-mini"
LENGTH = 24  # rendered images, which are repeated
NOISE = 2.0  # of the camera at its full size [grey levels]


def rendered_images() -> list[bytes]:
    """JPEG images of the full size, whose part inside the crop shows a moving gel."""
    profile = load_sensor_profile(PROFILE)
    width, height = profile.image.width, profile.image.height
    left, top, right, bottom = profile.crop_pixels(width, height)
    rng, images = np.random.default_rng(0), []
    appearance = make_appearance("typical", markers=63, width=640, height=480)
    for frame in GelSequence(appearance, "shear", frames=LENGTH, period=LENGTH):
        picture = np.full((height, width, 3), 40, dtype=np.float32)
        picture[top:bottom, left:right] = cv2.resize(frame.image, (right - left, bottom - top))
        picture += rng.normal(0, NOISE, picture.shape).astype(np.float32)
        images.append(cv2.imencode(".jpg", picture.clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 85])[1])
    return [image.tobytes() for image in images]


def serve(images: list[bytes], count: int, rate: float) -> ThreadingHTTPServer:
    """A server of an MJPEG stream of `count` images at `rate` [Hz]."""

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            start = time.monotonic()
            for number in range(count):
                time.sleep(max(0.0, start + number / rate - time.monotonic()))
                data = images[number % len(images)]
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                self.wfile.write(head.encode() + data + b"\r\n")

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


def main() -> int:
    parser = argparse.ArgumentParser(description="Track a live stream of 3280 x 2464 px on one core.")
    parser.add_argument("--images", type=int, default=500, metavar="N", help="length of the stream (%(default)s)")
    parser.add_argument("--rate", type=float, default=25.0, metavar="HZ", help="of the stream (%(default)s)")
    args = parser.parse_args()
    images = rendered_images()
    server = serve(images, args.images, args.rate)
    url = f"http://127.0.0.1:{server.server_port}/stream"
    cores = os.sched_getaffinity(0)
    command = [sys.executable, "-m", "gelflow.cli", "track", url, "--profile", PROFILE, "--json"]
    run = subprocess.run(
        command, capture_output=True, text=True, preexec_fn=lambda: os.sched_setaffinity(0, {min(cores)}), check=False
    )
    server.shutdown()
    result = json.loads(run.stdout)
    seconds = os.times().children_user + os.times().children_system
    print(f"{args.images} images of {len(images[0]) / 1e3:.0f} kB at {args.rate:g} Hz, one core")
    print(f"tracked {result['images']}, dropped {result['dropped_images']}, unreadable {result['unreadable_images']}")
    print(f"markers measured: {100 * result['tracked_share']:.1f} %")
    print(f"processor time: {1e3 * seconds / args.images:.1f} ms an image, start of the program included")
    return 0


if __name__ == "__main__":
    sys.exit(script.run(main))
