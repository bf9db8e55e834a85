"""Messages of a recording in the order they were recorded: rosbag2 (MCAP, SQLite), ROS 1 bags, and what is left of a
truncated MCAP file."""
from __future__ import annotations

import struct
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from line_slam_ros.cli.bag_topics import IMU
from msg_adapters import sensors

Decoder = Callable[[Any], Any]
_BROKEN = (AnyReaderError, SerdeError, struct.error, ValueError, IndexError, KeyError, UnicodeDecodeError)


class Bag(AbstractContextManager['Bag']):
    """An open recording; ``types`` and ``counts`` by topic, ``note`` for the human ('' if all is well)."""

    types: dict[str, str]
    counts: Counter[str]
    note = ''

    def __init__(self) -> None:
        self.undecodable: Counter[str] = Counter()  # topic -> messages that could not be read
        self._resources = ExitStack()

    def messages(self, topics: Collection[str], imu: str = '') -> Iterator[tuple[str, Any]]:
        """(topic, message) of the chosen topics; messages that cannot be decoded are counted and left out.

        Of the topic ``imu`` come the fields (sensors.imu_fields) instead of the messages, ten times as fast.
        """
        for topic, data, decode in self._raw(topics, imu):
            try:
                message = decode(data)
            except _BROKEN:
                self.undecodable[topic] += 1
            else:
                yield topic, message

    @abstractmethod
    def log(self) -> Iterator[tuple[str, int, bytes]]:
        """(topic, log time ns, message in CDR) of everything as it was recorded; ValueError for a ROS 1 bag."""

    def __exit__(self, *_: object) -> None:
        self._resources.close()

    @abstractmethod
    def _raw(self, topics: Collection[str], imu: str) -> Iterator[tuple[str, Any, Decoder]]:
        """(topic, serialised message, what decodes it)."""


class IndexedBag(Bag):
    """A complete recording, read by rosbags."""

    def __init__(self, paths: list[Path]) -> None:
        super().__init__()
        reader = AnyReader(paths, default_typestore=get_typestore(Stores.ROS2_JAZZY))
        self._reader = self._resources.enter_context(reader)
        self.types = {c.topic: c.msgtype for c in reader.connections}
        self.counts = Counter()
        for c in reader.connections:
            self.counts[c.topic] += c.msgcount

    def _raw(self, topics: Collection[str], imu: str) -> Iterator[tuple[str, Any, Decoder]]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        decoders = {c.msgtype: partial(self._reader.deserialize, typ=c.msgtype) for c in connections}
        of_imu = sensors.imu_of_cdr if self._reader.is2 else self._imu_of_ros1
        for connection, _, data in self._reader.messages(connections):
            topic = connection.topic
            yield topic, data, of_imu if topic == imu else decoders[connection.msgtype]

    def _imu_of_ros1(self, data: bytes) -> Any:
        return sensors.imu_fields(self._reader.deserialize(data, IMU))

    def log(self) -> Iterator[tuple[str, int, bytes]]:
        if not self._reader.is2:
            raise ValueError('ROS 1 bags cannot be played as they are: convert with rosbags-convert first')
        for connection, t_ns, data in self._reader.messages():
            yield connection.topic, t_ns, data


class SalvagedBag(Bag):
    """MCAP files without their end (power cut, full disk): everything up to the break, in the order written."""

    def __init__(self, paths: list[Path]) -> None:
        super().__init__()
        self._paths, self.types, self.counts = paths, {}, Counter()
        self._typestore = get_typestore(Stores.EMPTY)
        for schema, channel, _ in self._records(None):
            if channel.topic not in self.types:
                self.types[channel.topic] = schema.name
                self._register(schema)
            self.counts[channel.topic] += 1
        self.note = f'{paths[0]} is truncated: using the {self.counts.total()} messages before the break'

    def _register(self, schema: Any) -> None:
        text = schema.data.decode()
        self._typestore.register(get_types_from_msg(text, schema.name) if schema.encoding == 'ros2msg'
                                 else get_types_from_idl(text))

    def _records(self, topics: Collection[str] | None) -> Iterator[tuple[Any, Any, Any]]:
        for path in self._paths:
            with path.open('rb') as stream:
                try:
                    yield from NonSeekingReader(stream).iter_messages(topics, log_time_order=False)
                except McapError:  # the break
                    continue

    def _raw(self, topics: Collection[str], imu: str) -> Iterator[tuple[str, Any, Decoder]]:
        for schema, channel, message in self._records(topics):
            yield channel.topic, message.data, (sensors.imu_of_cdr if channel.topic == imu else
                                                partial(self._typestore.deserialize_cdr, typename=schema.name))

    def log(self) -> Iterator[tuple[str, int, bytes]]:
        for _, channel, message in self._records(None):
            yield channel.topic, message.log_time, message.data


def open_bag(path: Path | str) -> Bag:
    """The recording at ``path``: rosbag2 directory, .mcap, .db3 or .bag file; OSError or ValueError if it is none."""
    path = Path(path)
    files = _storage_files(path)
    try:
        return IndexedBag(files)
    except AnyReaderError as error:
        mcaps = sorted(path.glob('*.mcap')) if path.is_dir() else [path] if path.suffix == '.mcap' else []
        salvaged = SalvagedBag(mcaps) if mcaps else None
        if salvaged is None or not salvaged.types:
            raise ValueError(f'{path} is not a readable bag ({error}); expected a rosbag2 directory, or a .mcap, '
                             '.db3 or .bag file') from None
        return salvaged


def _storage_files(path: Path) -> list[Path]:
    """What rosbags is to open: the path itself, or the storage files of a directory that lost its metadata.yaml."""
    if not path.exists():
        raise FileNotFoundError(f'{path} does not exist')
    if not path.is_dir() or (path / 'metadata.yaml').exists():
        return [path]
    files = sorted([*path.glob('*.mcap'), *path.glob('*.db3')])
    if not files:
        raise ValueError(f'{path} is not a bag: it holds neither metadata.yaml nor .mcap or .db3 files')
    return files
