"""Reader of a session while it is being recorded: finds the chunks that the recorder has written so far."""

import os
import struct
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from gelflow.errors import PeerError, UsageError
from gelflow.session.messages import READ_ERRORS
from gelflow.session.reader import SessionReader, open_recording

_HEAD = struct.Struct("<BQ")  # opcode and length of a record


class LiveReader(SessionReader):
    """Reads the session at `path` while another program records it; `update` finds what has been added.

    The recorder does not know of its readers. Use it as a context manager, or call `open` and `close`.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        self._found = Summary()
        self._position = len(MCAP0_MAGIC)
        self.finished = False  # the recorder has closed the file

    def open(self) -> "LiveReader":
        """Open the file. Raises UsageError when it is missing or the recorder has not written its start yet."""
        self._stream = open_recording(self.path)
        self.update()
        return self

    @property
    def summary(self) -> Summary:
        """The chunks and channels that have been found so far."""
        return self._found

    def update(self) -> list[ChunkIndex]:
        """Find the chunks that were written since the last call.

        Raises UsageError for a newer format, and PeerError when the file is damaged outside its chunks.
        """
        if self._stream is None:
            raise UsageError(f"{self.path}: the reader is not open")
        before = len(self._found.chunk_indexes)
        number = self._stream.fileno()  # read by position: other threads read chunks at the same time
        size = os.fstat(number).st_size
        while not self.finished and self._position + _HEAD.size <= size:
            opcode, length = _HEAD.unpack(os.pread(number, _HEAD.size, self._position))
            if self._position + _HEAD.size + length > size:
                break  # the recorder is writing it
            try:
                self._take(opcode, os.pread(number, length, self._position + _HEAD.size))
            except UsageError:
                raise
            except READ_ERRORS as error:
                raise self._damaged(error) from error
            self._position += _HEAD.size + length
        return self._found.chunk_indexes[before:]

    def _take(self, opcode: int, data: bytes) -> None:
        stream = ReadDataStream(BytesIO(data))
        if opcode == Opcode.CHUNK:
            self._take_chunk(data)
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._found.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self._found.channels[channel.id] = channel
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            if metadata.name == "gelflow":
                self._take_metadata(metadata.metadata)
        elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
            self.finished = True

    def _take_chunk(self, data: bytes) -> None:
        """Add a chunk to the index; a damaged one is omitted."""
        try:
            chunk = Chunk.read(ReadDataStream(BytesIO(data)))
            records = breakup_chunk(chunk, validate_crc=True)
        except READ_ERRORS:
            return
        for record in records:
            if isinstance(record, Schema):
                self._found.schemas[record.id] = record
            elif isinstance(record, Channel):
                self._found.channels[record.id] = record
        channels = {record.channel_id for record in records if isinstance(record, Message)}
        if channels:
            index = ChunkIndex(
                chunk_length=_HEAD.size + len(data),
                chunk_start_offset=self._position,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=0,
                message_index_offsets=dict.fromkeys(channels, 0),  # which channels; their offsets are not used
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
            self._found.chunk_indexes.append(index)

    def _opened(self) -> SeekingReader:
        state = "was recorded while it was read" if self.finished else "is still being recorded"
        raise PeerError(f"{self.path} {state}; only its records by time can be read here")
