"""Writes MCAP bags as ROS 2 Jazzy records them (ros2msg schemas, CDR), stamped with sensor time."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from msg_adapters.factories import bag_messages


class BagWriter(AbstractContextManager['BagWriter']):
    """A new rosbag2 directory; ``new`` makes messages for it."""

    def __init__(self, directory: Path) -> None:
        """ValueError if the directory exists."""
        if directory.exists():
            raise ValueError(f'{directory} exists already; remove it or choose another place')
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Any] = {}
        self._writer = Writer(directory, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self.new = bag_messages(self._typestore)

    def serialise(self, message: Any) -> memoryview:
        """CDR of a message made by ``new``."""
        return self._typestore.serialize_cdr(message, message.__msgtype__)

    def write(self, topic: str, t_ns: int, message: Any) -> None:
        """Append a message made by ``new``."""
        self.write_serialised(topic, t_ns, message.__msgtype__, self.serialise(message))

    def write_serialised(self, topic: str, t_ns: int, type_name: str, data: bytes | memoryview,
                         latched: bool = False) -> None:
        """Append a message that is CDR already; latched topics are offered transient local."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, type_name, typestore=self._typestore, offered_qos_profiles=[_qos(latched)])
        self._writer.write(self._connections[topic], t_ns, data)

    def __exit__(self, *_: object) -> None:
        self._writer.close()


@contextmanager
def mcap_file(path: Path) -> Iterator[BagWriter]:
    """A writer of the single file ``path``, replaced if it exists; what was written is kept if the body fails."""
    with TemporaryDirectory(dir=path.parent, prefix='.recording-') as scratch:
        directory = Path(scratch) / path.stem
        try:
            with BagWriter(directory) as writer:
                yield writer
        finally:
            next(directory.glob('*.mcap')).replace(path)


def _qos(latched: bool) -> Qos:
    forever = QosTime(sec=9223372036, nsec=854775807)  # what rosbag2 writes for an infinite duration
    return Qos(QosHistory.KEEP_LAST, 1 if latched else 10, QosReliability.RELIABLE,
               QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
               forever, forever, QosLiveliness.AUTOMATIC, forever, False)
