"""The command line itself: exit codes and one-line messages."""
from __future__ import annotations

import re

import pytest
from bag_samples import line_slam

from line_slam_ros.cli import main as command_line


def test_every_command_has_help(capsys):
    with pytest.raises(SystemExit) as done:
        command_line.main(['--help'])
    assert done.value.code == 0
    listed = capsys.readouterr().out
    assert all(re.search(rf'^    {name}\s', listed, re.MULTILINE) for name in command_line.COMMANDS)


@pytest.mark.parametrize('arguments', [[], ['reply'], ['replay']])
def test_wrong_usage_is_explained(arguments, capsys):
    with pytest.raises(SystemExit) as done:
        command_line.main(arguments)
    assert done.value.code == 2 and 'usage: line_slam' in capsys.readouterr().err


def test_bad_input_is_one_line_and_exit_code_2(tmp_path):
    assert line_slam('replay', tmp_path / 'none') == (2, '', f'line_slam replay: {tmp_path / "none"} does not exist\n')
