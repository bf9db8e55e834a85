"""The rules of docs/architecture.md, enforced on the syntax trees of all sources."""
from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'line_slam_ros'
ADAPTERS = sorted((ROOT / 'msg_adapters').rglob('*.py'))
SOURCES = sorted(PACKAGE.rglob('*.py'))

# Who may import whom: a room's modules import from their own layer and the layers before it.
LAYERS = (
    ('types', 'config', 'kernel_cache', 'geometry'),
    ('factors',),
    ('frontend', 'estimation', 'mapping', 'simulation'),
    ('slam', 'warm_up', 'inbox', 'imu_buffer', 'pose_buffer', 'notes', 'calibration', 'shell_config', 'config_file',
     'ros_conventions', 'evaluation', 'experiment', 'benchmark'),
    ('msg_adapters',),
    ('nodes', 'cli'),
)
LAYER_OF = {room: layer for layer, rooms in enumerate(LAYERS) for room in rooms}
SHELLS = LAYERS[-1]

MIDDLEWARE = {'rclpy', 'builtin_interfaces', 'rosgraph_msgs', 'rosidl_runtime_py', 'std_srvs', 'tf2_ros', 'cv_bridge',
              'launch', 'launch_ros', 'ament_index_python', 'rcl_interfaces', 'rosbags', 'mcap'}
MESSAGE_FIELDS = {'header', 'stamp', 'sec', 'nanosec', 'frame_id', 'child_frame_id', 'angular_velocity',
                  'linear_acceleration', 'orientation', 'is_bigendian', 'distortion_model',
                  'point_step', 'row_step', 'transforms', 'hardware_id'}
# What a node says about its own parameters is not a message to anybody.
PARAMETER_RANGES = {'from_value=', 'to_value=', 'description=', 'read_only='}
MATHEMATICS = {'linalg', 'cross', 'dot', 'matmul', 'einsum', 'outer', 'inner', 'tensordot', 'trace', 'svd', 'eigh',
               'inv', 'solve', 'lstsq', 'sin', 'cos', 'tan', 'arctan2', 'atan2', 'hypot', 'interp'}


def room_of(path: Path) -> str:
    """The room a source file stands in: 'slam' for slam.py, 'geometry' for geometry/lie.py."""
    if path in ADAPTERS:
        return 'msg_adapters'
    return path.relative_to(PACKAGE).parts[0].removesuffix('.py')


def imported(path: Path) -> Iterator[str]:
    """Dotted names of all modules that a file imports, at whatever depth of the code."""
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}:{node.lineno}: import by full name'
            yield node.module or ''
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def imported_rooms(path: Path) -> set[str]:
    """Rooms of this project that a file imports from."""
    names = [name.split('.') for name in imported(path)]
    own = {parts[1] for parts in names if parts[0] == 'line_slam_ros' and len(parts) > 1}
    return own | {'msg_adapters' for parts in names if parts[0] == 'msg_adapters'}


def is_middleware(name: str) -> bool:
    top = name.split('.')[0]
    return top in MIDDLEWARE or top.endswith('_msgs')


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


rooms = [p for p in SOURCES if p != PACKAGE / '__init__.py']
core = [p for p in rooms if room_of(p) not in SHELLS]
shells = [p for p in rooms if room_of(p) in SHELLS]


@pytest.mark.parametrize('path', core, ids=relative)
def test_core_knows_neither_ros_nor_bags_nor_adapters(path: Path) -> None:
    assert not {name for name in imported(path) if is_middleware(name)}
    assert 'msg_adapters' not in imported_rooms(path)


@pytest.mark.parametrize('path', ADAPTERS, ids=relative)
def test_adapters_go_by_duck_typing(path: Path) -> None:
    assert not {name for name in imported(path) if is_middleware(name)}


@pytest.mark.parametrize('path', rooms, ids=relative)
def test_only_adapters_touch_message_fields(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding='utf-8'))
    touched = {f'line {node.lineno}: .{node.attr}' for node in ast.walk(tree)
               if isinstance(node, ast.Attribute) and node.attr in MESSAGE_FIELDS}
    assert not touched


def made_messages(tree: ast.AST) -> Iterator[ast.Call]:
    """Calls of imported message classes, and of factories: new('std_msgs/msg/Header')."""
    classes = {alias.asname or alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)
               and (node.module or '').endswith('_msgs.msg') for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            by_name = node.args and isinstance(node.args[0], ast.Constant) and '/msg/' in str(node.args[0].value)
            if by_name or (isinstance(node.func, ast.Name) and node.func.id in classes):
                yield node


@pytest.mark.parametrize('path', shells, ids=relative)
def test_shells_write_no_message_fields(path: Path) -> None:
    """A field given on construction would be written outside the adapters."""
    tree = ast.parse(path.read_text(encoding='utf-8'))
    fields = {f'line {call.lineno}: {keyword.arg}=' for call in made_messages(tree) for keyword in call.keywords}
    assert not {field for field in fields if field.split()[-1] not in PARAMETER_RANGES}


@pytest.mark.parametrize('path', shells, ids=relative)
def test_shells_hold_no_mathematics(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding='utf-8'))
    products = {f'line {node.lineno}: @' for node in ast.walk(tree)
                if isinstance(node, (ast.BinOp, ast.AugAssign)) and isinstance(node.op, ast.MatMult)}
    calls = {f'line {node.lineno}: .{node.attr}' for node in ast.walk(tree)
             if isinstance(node, ast.Attribute) and node.attr in MATHEMATICS}
    modules = {name for name in imported(path) if name.split('.')[0] in ('scipy', 'numba')
               or name.split('.')[-1] in MATHEMATICS}
    assert not products | calls | modules


@pytest.mark.parametrize('path', rooms + ADAPTERS, ids=relative)
def test_no_arrow_back(path: Path) -> None:
    room = room_of(path)
    assert room in LAYER_OF, f'{room} is in no layer: add it to LAYERS and to docs/architecture.md'
    assert not {other for other in imported_rooms(path) if LAYER_OF[other] > LAYER_OF[room]}


@pytest.mark.parametrize('path', [p for p in rooms + ADAPTERS if room_of(p) != 'cli'], ids=relative)
def test_no_print_and_no_exit_outside_the_command_line(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding='utf-8'))
    called = {f'line {node.lineno}: {ast.unparse(node.func)}' for node in ast.walk(tree) if isinstance(node, ast.Call)}
    assert not {call for call in called if call.split(': ')[1] in ('print', 'sys.exit', 'exit')}


def test_architecture_document_names_every_room() -> None:
    text = (ROOT / 'docs' / 'architecture.md').read_text(encoding='utf-8')
    assert not {room for path in rooms for room in [room_of(path)] if room not in text}
