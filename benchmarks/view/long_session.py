"""Time to open and to jump in a long recorded session: repeats a recording until it lasts as long as wanted.

    gelflow demo --out demo && python benchmarks/view/long_session.py demo/session.mcap --minutes 30

Prints the times without a browser: opening until the first moment is there, then jumps to random times with tracked
markers, and the largest memory of the process.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from gelflow.session import SessionReader
from gelflow.view.session.pad_pictures import pads_picture
from gelflow.view.session.recorded_session import RecordedSession

CHUNK = 64 * 1024  # [bytes], as the recorder's


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("session", type=Path, help="a recorded session (.mcap)")
    parser.add_argument("--minutes", type=float, default=30.0, help="length of the long session")
    parser.add_argument("--jumps", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--measure", action="store_true", help="measure the given session as it is")
    args = parser.parse_args()
    if args.measure:
        measure(args.session, args.jumps, np.random.default_rng(args.seed))
        return
    with tempfile.TemporaryDirectory() as folder:
        long = Path(folder) / "long.mcap"
        repeat(args.session, long, 60 * args.minutes)
        print(f"{long.stat().st_size / 1e9:.2f} GB, {args.minutes:g} minutes", flush=True)
        # A process of its own, so that its memory is that of the viewer alone.
        options = ["--measure", "--jumps", str(args.jumps), "--seed", str(args.seed)]
        subprocess.run([sys.executable, __file__, str(long), *options], check=True)


def repeat(source: Path, target: Path, seconds: float) -> None:
    """Copy the messages of a session again and again, later each time."""
    with SessionReader(source) as session:
        summary = session.summary
        assert summary is not None and summary.statistics is not None
        length = summary.statistics.message_end_time - summary.statistics.message_start_time
    with target.open("wb") as out:
        writer = Writer(out, chunk_size=CHUNK, compression=CompressionType.ZSTD)
        writer.start()
        channels: dict[int, int] = {}
        for round_ in range(int(np.ceil(seconds * 1e9 / length))):
            with source.open("rb") as stream:
                reader = make_reader(stream)
                if round_ == 0:
                    for metadata in reader.iter_metadata():
                        writer.add_metadata(metadata.name, metadata.metadata)
                for schema, channel, message in reader.iter_messages():
                    if round_ and channel.topic == "/session":
                        continue
                    if channel.id not in channels:
                        assert schema is not None
                        number = writer.register_schema(schema.name, schema.encoding, schema.data)
                        channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
                    shift = round_ * length
                    writer.add_message(
                        channels[channel.id], message.log_time + shift, message.data, message.publish_time + shift,
                        message.sequence,
                    )  # fmt: skip
        writer.finish()


def measure(path: Path, jumps: int, rng: np.random.Generator) -> None:
    """Print the times of a session."""
    before = time.perf_counter()
    with RecordedSession(path) as session:
        session.at(session.start, markers=False)
        print(f"open: {time.perf_counter() - before:.2f} s, {len(session.timeline_events)} events")
        taken = []
        for target in rng.uniform(session.start, session.end, jumps):
            before = time.perf_counter()
            pads_picture(session.at(float(target)).pads)
            taken.append(time.perf_counter() - before)
    low, high = np.percentile(taken, [50, 95])
    print(f"jump with markers: median {1e3 * low:.0f} ms, 95 % {1e3 * high:.0f} ms, longest {1e3 * max(taken):.0f} ms")
    print(f"memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
