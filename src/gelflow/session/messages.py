"""Messages of a finished session file in the order of recording, optionally past damaged chunks."""

import heapq
import itertools
import os
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO

import zstandard
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, ChunkIndex, Message
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary

# Exceptions of the libraries that decode a damaged file.
DECODE_ERRORS = (
    McapError,
    DecodeError,
    struct.error,
    zlib.error,
    zstandard.ZstdError,
    ValueError,
    KeyError,
    IndexError,
    EOFError,
    MemoryError,
    OverflowError,
)
# The same, and those of an invalid position in the file or a faulty disk.
READ_ERRORS = (*DECODE_ERRORS, OSError)
_RECORD_HEAD = 9  # opcode and length of a record [bytes]


@dataclass
class Damage:
    """Counts what a reader passes over; each reading adds to it."""

    chunks: int = 0  # with damaged contents
    records: int = 0  # lost with them, or not decodable

    def __bool__(self) -> bool:
        return self.chunks + self.records > 0


def ordered_messages(
    stream: BinaryIO, summary: Summary, topics: Collection[str] | None, damage: Damage | None
) -> Iterator[tuple[Channel, Message]]:
    """Messages of `topics` (None: all) in the order of their log times.

    A damaged chunk is counted in `damage`; without `damage` it raises one of `READ_ERRORS`.
    """
    chunks = [chunk for chunk in summary.chunk_indexes if has_topic(chunk, summary, topics)]
    chunks.sort(key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
    # Chunks overlap in time by a little: messages wait until no later chunk can contain an earlier one.
    waiting: list[tuple[int, int, int, Channel, Message]] = []
    for chunk, following in itertools.zip_longest(chunks, chunks[1:]):
        try:
            found = chunk_messages(stream, chunk, summary)
        except READ_ERRORS:
            if damage is None:
                raise
            damage.chunks += 1
            found = []
        for position, (channel, message) in enumerate(found):
            if topics is None or channel.topic in topics:
                heapq.heappush(waiting, (message.log_time, chunk.chunk_start_offset, position, channel, message))
        while waiting and (following is None or waiting[0][0] < following.message_start_time):
            yield heapq.heappop(waiting)[3:]


def expected_records(summary: Summary, topics: Collection[str] | None) -> int:
    """Number of messages of `topics` (None: all) that the recorder wrote."""
    if summary.statistics is None:
        return 0
    counts = summary.statistics.channel_message_counts
    channels = summary.channels.values()
    return sum(counts.get(channel.id, 0) for channel in channels if topics is None or channel.topic in topics)


def has_topic(chunk: ChunkIndex, summary: Summary, topics: Collection[str] | None) -> bool:
    """Whether a chunk contains messages of `topics`, or its index does not show it."""
    return topics is None or any(topic in topics for topic in chunk_topics(chunk, summary))


def chunk_topics(chunk: ChunkIndex, summary: Summary) -> list[str]:
    """The topics of a chunk; all of the file where the index of the chunk is missing or damaged."""
    channels = chunk.message_index_offsets
    if not channels or not channels.keys() <= summary.channels.keys():
        return list(dict.fromkeys(channel.topic for channel in summary.channels.values()))
    return list(dict.fromkeys(summary.channels[key].topic for key in channels))


def chunk_messages(stream: BinaryIO, index: ChunkIndex, summary: Summary) -> list[tuple[Channel, Message]]:
    """All messages of a chunk, for any thread. Raises one of `READ_ERRORS` when it is damaged."""
    # Not seek and read: another thread would move the position between the two.
    data = os.pread(stream.fileno(), index.chunk_length - _RECORD_HEAD, index.chunk_start_offset + _RECORD_HEAD)
    records = breakup_chunk(Chunk.read(ReadDataStream(BytesIO(data))), validate_crc=True)
    return [(summary.channels[record.channel_id], record) for record in records if isinstance(record, Message)]
