"""Which topics of a bag to use: as named by the user, else by their type."""
from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from os.path import commonprefix

RAW, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
IMU, CAMERA_INFO = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/CameraInfo'
POSES = ('nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/PoseWithCovarianceStamped')
IMAGES = {'raw': (RAW,), 'compressed': (COMPRESSED,), 'auto': (RAW, COMPRESSED)}


@dataclass(frozen=True)
class Topics:
    """Names; '' for what the bag does not have and the mode does not need."""

    image: str
    motion: str  # IMU, or poses with pose_source: topic
    camera_info: str
    compressed: bool
    notes: tuple[str, ...] = ()


def choose_topics(types: Mapping[str, str], named: Mapping[str, str], transport: str, pose_source: str) -> Topics:
    """Topics for a run; ``named`` holds the user's choice for image, imu, pose, camera_info ('' for none).

    Raises ValueError that names what is missing and lists what the bag has.
    """
    notes: list[str] = []
    image = _choose(types, IMAGES[transport], named['image'], '--image-topic', notes)
    kind, wanted = (('pose', POSES) if pose_source == 'topic' else ('imu', (IMU,)))
    motion = _choose(types, wanted, named[kind], f'--{kind}-topic', notes)
    infos = [name for name in types if types[name] == CAMERA_INFO]
    if named['camera_info']:
        info = _choose(types, (CAMERA_INFO,), named['camera_info'], '--camera-info-topic', notes)
    else:
        info = max(sorted(infos), key=lambda name: len(commonprefix([name, image])), default='')
    return Topics(image, motion, info, types[image] == COMPRESSED, tuple(notes))


def _choose(types: Mapping[str, str], wanted: Collection[str], named: str, option: str, notes: list[str]) -> str:
    """The named topic if it has a wanted type, else the first of the first wanted type that the bag has."""
    if named:
        if types.get(named) not in wanted:
            raise ValueError(f'{option} {named}: the bag has no such topic of type {" or ".join(wanted)}; '
                             f'{_listing(types)}')
        return named
    found = [name for kind in wanted for name in sorted(types) if types[name] == kind]
    if not found:
        raise ValueError(f'the bag has no topic of type {" or ".join(wanted)}; {_listing(types)}')
    if len(found) > 1:
        notes.append(f'using {found[0]}, not {", ".join(found[1:])}; choose with {option}')
    return found[0]


def _listing(types: Mapping[str, str]) -> str:
    return 'it has ' + (', '.join(f'{name} ({kind})' for name, kind in sorted(types.items())) or 'no topics at all')
