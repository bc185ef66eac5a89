"""Recovery of unfinished or damaged sessions: copies every complete record into a new file."""

import contextlib
import json
import os
import struct
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC, Writer

from gelflow import __version__
from gelflow.errors import PeerError, UsageError
from gelflow.session.messages import DECODE_ERRORS, READ_ERRORS
from gelflow.session.reader import (
    RECOVERED,
    NotASession,
    SessionReader,
    is_being_recorded,
    is_finished,
    open_recording,
)
from gelflow.session.recorder import CHUNK_BYTES

_HEAD = struct.Struct("<BQ")  # opcode and length of a record


@dataclass(frozen=True)
class RecoveryReport:
    """Result of a recovery."""

    path: Path  # the new file
    messages: int  # number of recovered messages
    duration: float  # from the first to the last recovered message [s]
    lost_bytes: int  # of incomplete records, and of damage outside the chunks
    damaged_chunks: int  # of complete length but with invalid contents; not copied


def recover(source: str | Path, target: str | Path) -> RecoveryReport:
    """Copy every complete record of `source` into the finished session `target`, which must not exist.

    Raises UsageError when `source` is finished and undamaged, is no session or a path is wrong, and PeerError when
    `source` contains no complete message.
    """
    source, target = Path(source), Path(target)
    _check_new(target)
    _check_not_whole(source)
    with open_recording(source) as stream:
        if is_being_recorded(stream):
            raise UsageError(f"{source} is still being recorded; wait until the recorder has closed it")
        try:
            copy = _copied(stream, source, target)
        except OSError as error:
            raise UsageError(f"cannot write {target}: {error.strerror}; use a writable folder") from error
    span = (copy.last - copy.first) / 1e9
    return RecoveryReport(target, copy.messages, span, copy.lost, copy.damaged)


def _check_new(target: Path) -> None:
    if os.path.lexists(target):
        raise UsageError(f"{target} exists; name another file with --out")


def _copied(stream: BinaryIO, source: Path, target: Path) -> "_Copy":
    """Write `target` by way of a file beside it, so that the name belongs to a complete file only."""
    partial = target.with_name(target.name + ".part")
    try:
        out = partial.open("xb")
    except FileExistsError:
        raise UsageError(
            f"{partial} exists: another recovery writes it, or was killed; name another file with --out, or delete it"
        ) from None
    try:
        with out:
            copy, summary = _Copy(out), _summary(stream)
            copy.take_summary(summary)
            for opcode, data in _complete_records(stream, _chunk_starts(stream, summary), copy):
                copy.take(opcode, data)
            copy.finish(source)
        if copy.messages == 0:
            raise PeerError(f"{source} contains no complete message that can be found; there is nothing to recover")
        if not copy.described:
            raise UsageError(
                f"{source} contains neither the metadata nor the description of a gelflow session; name a session "
                "recorded by gelflow"
            )
        _check_new(target)
        partial.replace(target)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
    return copy


def _check_not_whole(source: Path) -> None:
    try:
        with SessionReader(source) as session:
            for _ in session.records():
                pass
    except (PeerError, NotASession):  # the metadata may be damaged
        return
    raise UsageError(f"{source} is finished and undamaged; there is nothing to recover")


class _Copy:
    """Writes recovered records to a new file, under new channel numbers."""

    def __init__(self, out: BinaryIO) -> None:
        self._out = out
        self._writer = Writer(out, chunk_size=CHUNK_BYTES)
        self._writer.start(library=f"gelflow {__version__} recover")
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}
        self._topics: dict[int, str] = {}  # by the channel numbers of the source
        self.described = False  # format and epoch of the session are known
        self.messages = self.damaged = self.lost = 0
        self.first = self.last = 0

    def take_summary(self, summary: Summary) -> None:
        """Copy the schemas and channels at the end of a finished file: those in its first chunk may be damaged."""
        with contextlib.suppress(*READ_ERRORS):
            for record in [*summary.schemas.values(), *summary.channels.values()]:
                self._put(record)

    def take(self, opcode: int, data: bytes) -> None:
        """Copy one top-level record; an unreadable one is counted as damaged."""
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
                self._put_metadata(Metadata.read(stream))
            for record in records:
                self._put(record)
        except DECODE_ERRORS:
            self.damaged += 1

    def _put_metadata(self, record: Metadata) -> None:
        """Copy metadata. Raises one of `DECODE_ERRORS` when those of the session are damaged."""
        if record.name == "gelflow":
            int(record.metadata["format"]), int(record.metadata.get("epoch_ns", "0"))
            if self.described:
                return
            self.described = True
        self._writer.add_metadata(record.name, record.metadata)

    def _describe(self, message: Message) -> None:
        """Write the metadata of the session, which are damaged, from its description in `message`."""
        with contextlib.suppress(*DECODE_ERRORS, TypeError):
            description = dict(json.loads(message.data))
            date = round(1e9 * float(description.get("epoch", 0.0)))
            self._put_metadata(Metadata("gelflow", {"format": str(description["format"]), "epoch_ns": str(date)}))

    def _put(self, record: McapRecord) -> None:
        if isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels:
            self._channels[record.id] = self._writer.register_channel(
                record.topic, record.message_encoding, self._schemas[record.schema_id], record.metadata
            )
            self._topics[record.id] = record.topic
        elif isinstance(record, Message):
            if not self.described and self._topics[record.channel_id] == "/session":
                self._describe(record)
            channel = self._channels[record.channel_id]
            self._writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
            self.first = record.log_time if self.messages == 0 else min(self.first, record.log_time)
            self.last = max(self.last, record.log_time)
            self.messages += 1

    def finish(self, source: Path) -> None:
        lost = {"source": source.name, "lost_bytes": str(self.lost), "damaged_chunks": str(self.damaged)}
        self._writer.add_metadata(RECOVERED, lost)
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._out.flush()
        os.fsync(self._out.fileno())


def _summary(stream: BinaryIO) -> Summary:
    """The index at the end of a finished file; empty where there is none that can be read."""
    if is_finished(stream):
        with contextlib.suppress(*READ_ERRORS):
            return SeekingReader(stream, validate_crcs=True).get_summary() or Summary()
    return Summary()


def _chunk_starts(stream: BinaryIO, summary: Summary) -> list[int]:
    """Positions of the chunks in the index of the file, in order, without entries that do not point to a chunk."""
    starts = []
    for index in summary.chunk_indexes:
        with contextlib.suppress(*READ_ERRORS):
            stream.seek(index.chunk_start_offset)
            if _HEAD.unpack(stream.read(_HEAD.size)) == (Opcode.CHUNK, index.chunk_length - _HEAD.size):
                starts.append(index.chunk_start_offset)
    return sorted(starts)


def _complete_records(stream: BinaryIO, starts: list[int], copy: _Copy) -> Iterator[tuple[int, bytes]]:
    """Top-level records (opcode, contents). After damage they continue at the next of the chunk positions `starts`.

    Lengths are checked here because the library's reader takes a short read for a short record.
    """
    size = stream.seek(0, 2)
    position = len(MCAP0_MAGIC)
    while position + _HEAD.size <= size:
        stream.seek(position)
        opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
        following = bisect_right(starts, position)
        limit = starts[following] if following < len(starts) else size
        end = position + _HEAD.size + length
        if opcode == 0 or end > limit:  # no record has opcode 0: zeros would be records of length 0
            copy.lost += limit - position
            position = limit
            continue
        yield opcode, stream.read(length)
        position = end
        if opcode == Opcode.FOOTER:
            return
    copy.lost += size - position
