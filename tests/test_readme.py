"""What the README tells its readers is so: files, commands, parameters and topics."""
from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from line_slam_ros.config import Config, leaves
from line_slam_ros.config_file import NODE_NAME
from line_slam_ros.shell_config import ShellConfig

ROOT = Path(__file__).parents[1]
README = (ROOT / 'README.md').read_text(encoding='utf-8')
DOCUMENTS = [ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md')), ROOT / 'bags' / 'README.md']
PARAMETERS = {name: value for part in (Config(), ShellConfig()) for name, _, value in leaves(part)}


def commands(text: str) -> list[list[str]]:
    """The lines of the indented code blocks, split into words, without comments."""
    joined = text.replace('\\\n', ' ')
    return [shlex.split(line, comments=True) for line in re.findall(r'^    (\S.*)$', joined, re.MULTILINE)]


def table(heading: str, text: str = README) -> list[list[str]]:
    """Cells of the rows of the first table after a heading or sentence."""
    rows = re.search(r'^\|.*?(?=\n\n|\Z)', text[text.index(heading):], re.MULTILINE | re.DOTALL)
    assert rows is not None, f'no table after {heading!r}'
    return [[cell.strip() for cell in row.strip('|').split('|')] for row in rows.group().splitlines()[2:]]


def quoted(cell: str) -> list[str]:
    return re.findall(r'`([^`]+)`', cell)


@pytest.mark.parametrize('document', DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_linked_files_exist(document: Path) -> None:
    links = [link.split('#')[0] for link in re.findall(r'\]\(([^)]+)\)', document.read_text(encoding='utf-8'))
             if '://' not in link]
    assert not [link for link in links if link and not (document.parent / link).exists()]


def test_named_files_of_the_repository_exist() -> None:
    named = re.findall(r'(?<![\w/<])((?:scripts|config|docs|launch|rviz|bags|tests)/[\w./-]*\w)', README)
    assert named
    assert not [name for name in named if not (ROOT / name).exists()]


def test_the_two_commands_are_executable_scripts() -> None:
    alone = [words[0] for words in commands(README) if len(words) == 1]
    assert alone == ['./scripts/demo.sh', './scripts/test.sh']
    assert all(os.access(ROOT / name, os.X_OK) for name in alone)


def test_the_check_of_the_project_is_the_test_command() -> None:
    assert (ROOT / '.ci' / 'run').read_text().rstrip().endswith('scripts/test.sh"')
    assert os.access(ROOT / '.ci' / 'run', os.X_OK)


@pytest.mark.parametrize('words', [w for w in commands(README) if w[0] == 'line_slam'], ids=lambda w: w[1])
def test_command_line_examples_name_real_subcommands_and_options(words: list[str]) -> None:
    shown = subprocess.run([sys.executable, '-m', 'line_slam_ros.cli.main', words[1], '--help'], text=True,
                           capture_output=True, check=False, cwd=ROOT, timeout=120)
    assert shown.returncode == 0, shown.stderr
    assert not [word for word in words if word.startswith('-') and word not in shown.stdout]


def test_parameters_given_in_examples_exist() -> None:
    given = [word.split(':=')[0] for words in commands(README) for option, word in pairwise(words) if option == '-p']
    assert given
    assert not set(given) - PARAMETERS.keys()


def test_parameter_table_has_real_names_and_defaults() -> None:
    for names, default, _ in table('### Parameters'):
        for name in quoted(names):
            assert name in PARAMETERS, name
            if default:
                assert quoted(default)[0].strip("'") == str(PARAMETERS[name]).lower(), name


def test_parameters_named_in_the_text_exist() -> None:
    sections = '|'.join({name.split('.')[0] for name in PARAMETERS if '.' in name})
    named = set(re.findall(rf'\b(?:{sections})\.[a-z_]{{4,}}', README))
    assert named
    assert not named - PARAMETERS.keys()


def type_name(message: type) -> str:
    return f'{message.__module__.split(".")[0]}/{message.__name__}'


def qos_words(profile: object) -> str:
    words = [profile.reliability.name.lower(), str(profile.depth)]
    return ', '.join(words + ['transient local'] * (profile.durability.name == 'TRANSIENT_LOCAL'))


def test_table_of_published_topics_agrees_with_the_node(ros: None) -> None:
    from line_slam_ros.nodes.line_slam_node import LineSlamNode
    node = LineSlamNode()
    stated = {quoted(topic)[0].replace('~', f'/{NODE_NAME}'): (quoted(kind)[0], qos)
              for topic, kind, qos, *_ in table('Published')}
    real = {p.topic_name: (type_name(p.msg_type), qos_words(p.qos_profile)) for p in node.publishers
            if p.topic_name not in ('/rosout', '/parameter_events')}
    triggers = {node.resolve_service_name(s.srv_name) for s in node.services
                if type_name(s.srv_type) == 'std_srvs/Trigger'}
    node.destroy_node()
    if '/tf' not in real:  # without tf2_msgs
        del stated['/tf']
    assert real == stated
    paragraph = README[README.index('Services'):].split('\n\n')[0]
    assert triggers == {name.replace('~', f'/{NODE_NAME}') for name in quoted(paragraph) if name.startswith('~')}


def test_table_of_subscribed_topics_agrees_with_the_node(ros: None) -> None:
    from rclpy.node import Node

    from line_slam_ros.nodes.inputs import Inputs
    real = set()
    for transport in ('raw', 'compressed'):
        for poses in ('imu', 'topic'):
            node = Node('subscribes')
            shell = ShellConfig(image_transport=transport, pose_source=poses,
                                T_body_camera=tuple(1.0 * (i % 5 == 0) for i in range(16)))
            Inputs(node, shell, lambda calibration: None).subscribe()
            real |= {(s.topic_name, type_name(s.msg_type)) for s in node.subscriptions}
            node.destroy_node()
    stated = {(f'/{topic}', kind) for topics, kinds, *_ in table('Subscribed')
              for topic, kind in zip(quoted(topics), quoted(kinds), strict=True)}
    assert {pair for pair in real if pair[0] not in ('/parameter_events', '/clock')} == stated
