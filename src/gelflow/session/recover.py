"""Salvages what a killed recorder, or a damaged disk, has left of a session: every whole record, into a new file."""

import contextlib
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, Writer

from gelflow import __version__
from gelflow.errors import PeerError, UsageError
from gelflow.session.reader import DAMAGE, SessionReader, is_being_recorded, open_recording
from gelflow.session.recorder import CHUNK


@dataclass(frozen=True)
class Salvage:
    """What was found in an unfinished or damaged session."""

    path: Path  # of the new file
    messages: int
    duration: float  # from the first to the last salvaged message [s]
    lost_bytes: int  # at the end of the file, in a record that was cut off
    damaged_chunks: int  # whole by length, but with wrong contents: left out


def recover(source: str | Path, target: str | Path) -> Salvage:
    """Copy every whole record of `source` into the finished session `target`, which must not exist.

    Raises UsageError when `source` is finished and whole (nothing to salvage) or a path is wrong, and PeerError when
    not one message is whole.
    """
    source, target = Path(source), Path(target)
    if target.exists():
        raise UsageError(f"{target} exists; name another file with --output")
    partial = target.with_name(target.name + ".part")
    _refuse_whole(source)
    with open_recording(source) as stream:
        if is_being_recorded(stream):
            raise UsageError(f"{source} is still being recorded; wait until the recorder has closed it")
        try:
            with partial.open("wb") as out:
                copy = _Copy(out)
                for opcode, data in _whole_records(stream, copy):
                    copy.take(opcode, data)
                copy.finish(source)
            if copy.messages == 0:
                raise PeerError(f"{source} holds not one whole message; there is nothing to salvage")
            partial.replace(target)
        except OSError as error:
            raise UsageError(f"cannot write {target}: {error.strerror}; name a file one can write") from error
        finally:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
    span = (copy.last - copy.first) / 1e9
    return Salvage(target, copy.messages, span, copy.lost, copy.damaged)


def _refuse_whole(source: Path) -> None:
    try:
        with SessionReader(source) as session:
            for _ in session.records():
                pass
    except PeerError:
        return
    raise UsageError(f"{source} is finished and whole; there is nothing to salvage, read it as it is")


class _Copy:
    """Writes salvaged records to a new file, under new channel numbers."""

    def __init__(self, out: BinaryIO) -> None:
        self._out = out
        self._writer = Writer(out, chunk_size=CHUNK)
        self._writer.start(library=f"gelflow {__version__} recover")
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}
        self.messages = self.damaged = self.lost = 0
        self.first = self.last = 0

    def take(self, opcode: int, data: bytes) -> None:
        """One top-level record. What cannot be read is counted as damaged."""
        stream = ReadDataStream(BytesIO(data))
        records: list[McapRecord] = []
        try:
            if opcode == Opcode.CHUNK:
                records = breakup_chunk(Chunk.read(stream), validate_crc=True)
            elif opcode == Opcode.SCHEMA:
                records = [Schema.read(stream)]
            elif opcode == Opcode.CHANNEL:
                records = [Channel.read(stream)]
            elif opcode == Opcode.MESSAGE:
                records = [Message.read(stream, len(data))]
            elif opcode == Opcode.METADATA:
                metadata = Metadata.read(stream)
                self._writer.add_metadata(metadata.name, metadata.metadata)
            for record in records:
                self._put(record)
        except DAMAGE:
            self.damaged += 1

    def _put(self, record: McapRecord) -> None:
        if isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels:
            self._channels[record.id] = self._writer.register_channel(
                record.topic, record.message_encoding, self._schemas[record.schema_id], record.metadata
            )
        elif isinstance(record, Message):
            channel = self._channels[record.channel_id]
            self._writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
            self.first = record.log_time if self.messages == 0 else min(self.first, record.log_time)
            self.last = max(self.last, record.log_time)
            self.messages += 1

    def finish(self, source: Path) -> None:
        lost = {"source": source.name, "lost_bytes": str(self.lost), "damaged_chunks": str(self.damaged)}
        self._writer.add_metadata("gelflow recovered", lost)
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._out.flush()
        os.fsync(self._out.fileno())


def _whole_records(stream: BinaryIO, copy: _Copy) -> Iterator[tuple[int, bytes]]:
    """Top-level records (opcode, contents) up to the first that is cut off.

    The lengths are checked here because the library's own reader takes a short read for a short record.
    """
    size = stream.seek(0, 2)
    position = stream.seek(len(MCAP0_MAGIC))
    while position + 9 <= size:
        opcode, length = struct.unpack("<BQ", stream.read(9))
        if length > size - position - 9:
            break
        yield opcode, stream.read(length)
        position += 9 + length
        if opcode == Opcode.FOOTER:
            break
    else:
        copy.lost = size - position
        return
    copy.lost = 0 if opcode == Opcode.FOOTER else size - position
